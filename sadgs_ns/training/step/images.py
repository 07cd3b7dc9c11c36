"""Images that are decoded and undistorted when they are needed, or copied to the device ahead of their step."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.datasets.base_dataset import InputDataset
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from sadgs_ns.data.images import NO_MASK, valid_pixels
from sadgs_ns.errors import InputError, reason
from sadgs_ns.host import num_cores
from sadgs_ns.training.run.processes import processes_on_this_machine
from sadgs_ns.training.step.undistortion import Undistortion

_KEPT_WARPS = 4  # Cameras whose warps are kept, at 8 bytes a pixel; each image may have a camera of its own


def thread_count(requested: int | None) -> int:
    """Return the number of threads that decode images in this process; by default one per core, up to 16."""
    return requested or min(max(num_cores() // processes_on_this_machine(), 1), 16)


def stack(tensors: Sequence[Tensor]) -> Tensor:
    """Stack tensors as `torch.stack` does, but do not copy a single one."""
    if len(tensors) == 1:
        return tensors[0][None]
    return torch.stack(list(tensors))


def stack_masks(data: Sequence[Mapping[str, Any]], size: Sequence[int], device: torch.device) -> Tensor | None:
    """Return masks of views of one size (H, W), ones where a view has none; None if no view has. bool [V, H, W, 1]"""
    if not any("mask" in view for view in data):
        return None
    everything = torch.ones((*size, 1), dtype=torch.bool, device=device)
    return stack([view.get("mask", everything).to(device, non_blocking=True) for view in data])


class LazyImages(Sequence[dict[str, Any]]):
    """Images of a dataset as nerfstudio's FullImageDatamanager loads them, decoded and undistorted at each access.

    Several threads may access images. The dataset's cameras become those of the undistorted images, none opened.
    """

    def __init__(self, dataset: InputDataset) -> None:
        self._names = dataset.image_filenames
        self._sizes = torch.cat([dataset.cameras.width, dataset.cameras.height], dim=-1).tolist()  # [C][2] px
        self._undistortions = _undistort_cameras(dataset.cameras)
        self._warp_of = lru_cache(_KEPT_WARPS)(Undistortion.warp)
        outputs = dataset._dataparser_outputs
        self._masks = outputs.mask_filenames
        self._mask_color = dataset.mask_color
        self._dataset = copy.copy(dataset)
        # nerfstudio hides only the pixels of a mask that are 0.
        self._dataset._dataparser_outputs = dataclasses.replace(outputs, mask_filenames=None)
        self._dataset.mask_color = None
        self._opencv_agrees: bool | None = None  # None until a JPEG has been decoded
        if dataset.scale_factor == 1 and type(dataset).get_numpy_image is InputDataset.get_numpy_image:
            self._dataset.get_numpy_image = self._decode

    def __len__(self) -> int:
        return len(self._names)

    def __getitem__(self, index: Any) -> Any:
        """Return `image` uint8 [H, W, 3 or 4], undistorted and on the CPU, and perhaps a boolean `mask` [H, W, 1].

        A view without mask has none, as where nothing is hidden.

        Raises InputError if image or mask cannot be read, or has another size than its camera.
        """
        name = self._names[index]
        size = tuple(self._sizes[index])
        undistortion = self._undistortions[index]
        try:
            data = self._load(index)
        except MemoryError:
            raise
        except Exception as error:  # Decoders raise OSError, SyntaxError, struct.error, …
            broken = name
            if self._masks is not None:
                broken = f"{name} or its mask"
            raise InputError(
                f"{broken} cannot be read as an image ({reason(error)}): copy it again, or leave it out of the "
                "reconstruction."
            ) from error
        image: Tensor = data["image"]
        width_and_height = (image.shape[1], image.shape[0])
        if width_and_height != size:
            sizes = "{} × {} px, but its camera {} × {}".format(*width_and_height, *size)
            raise InputError(f"{name} has {sizes}: use the images that the poses were computed from.")
        if undistortion is not None:
            undistorted, mask = undistortion(data, image.numpy(), self._warp_of(undistortion))
            image = torch.from_numpy(np.ascontiguousarray(undistorted))  # The crop is a view of the larger image.
            if mask is not None:
                data["mask"] = mask.contiguous()
        return {**data, "image": image}

    def _load(self, index: int) -> dict[str, Any]:
        """Return an image as nerfstudio loads it, and its boolean `mask` [H, W, 1] if the dataset has masks."""
        data = self._dataset.get_data(index, image_type="uint8")
        if self._masks is None or self._masks[index] == NO_MASK:
            return data
        image: Tensor = data["image"]
        with Image.open(self._masks[index]) as file:
            mask = Image.fromarray(valid_pixels(file))
        if self._dataset.scale_factor != 1:
            mask = mask.resize((image.shape[1], image.shape[0]), Image.Resampling.NEAREST)
        valid = torch.from_numpy(np.array(mask))[..., None]
        if valid.shape[:2] != image.shape[:2]:
            raise ValueError(
                f"the mask has {mask.width} × {mask.height} px, the image {image.shape[1]} × {image.shape[0]}"
            )
        data["mask"] = valid
        if self._mask_color:
            color = torch.ones_like(image) * torch.tensor(self._mask_color)
            data["image"] = torch.where(valid, image, color)
        return data

    def _decode(self, image_idx: int) -> NDArray[np.uint8]:
        """Decode an image as nerfstudio does, or a JPEG with OpenCV if that gives the same pixels. [H, W, 3 or 4]

        For 2 megapixels, Pillow blocks Python in other threads, such as the training loop, for 5 ms.
        """
        content = self._names[image_idx].read_bytes()
        image = None
        if self._opencv_agrees is not False and content[:2] == b"\xff\xd8" and content[-2:] == b"\xff\xd9":
            image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        if image is not None:
            image = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
            if self._opencv_agrees:
                return image  # type: ignore[return-value]
        expected = InputDataset.get_numpy_image(self._dataset, image_idx)
        if image is not None:
            self._opencv_agrees = np.array_equal(image, expected)
        return expected


def _undistort_cameras(cameras: Cameras) -> list[Undistortion | None]:
    """Set the cameras' intrinsics and sizes, in place, to those of their undistorted images.

    Returns:
        The undistortion of each camera's image, or None for a camera without distortion.
    """
    undistortions: list[Undistortion | None] = [None] * len(cameras)
    distortion = cameras.distortion_params  # [C, D]
    if distortion is None or not distortion.any():
        return undistortions
    fields = [cameras.camera_type, cameras.fx, cameras.fy, cameras.cx, cameras.cy, cameras.width, cameras.height]
    rows = torch.cat([field.double() for field in (*fields, distortion)], dim=-1).numpy()  # [C, 7 + D]
    by_camera: dict[bytes, Undistortion] = {}  # Cameras with equal rows share one
    for index in distortion.any(dim=-1).nonzero().flatten().tolist():
        key = rows[index].tobytes()
        if key not in by_camera:
            by_camera[key] = Undistortion(cameras[index].reshape(()))
        undistortion = by_camera[key]
        undistortions[index] = undistortion
        cameras.fx[index] = float(undistortion.K[0, 0])
        cameras.fy[index] = float(undistortion.K[1, 1])
        cameras.cx[index] = float(undistortion.K[0, 2])
        cameras.cy[index] = float(undistortion.K[1, 2])
        cameras.width[index] = undistortion.width
        cameras.height[index] = undistortion.height
    return undistortions


class ImagePrefetcher:
    """Copies images from the host to the device ahead of the step that needs them, on its own stream.

    Threads decode `LazyImages` and pin them. If all images are decoded, and with CUDA pinned, no threads are needed.
    Without CUDA only decoding runs ahead.
    """

    def __init__(self, images: Sequence[Mapping[str, Any]], device: torch.device, threads: int) -> None:
        self.images = images
        self.device = device
        self.threads = threads
        on_cuda = device.type == "cuda"
        self.decoded = isinstance(images, list)
        if self.decoded and on_cuda:
            self.decoded = all(data["image"].is_pinned() for data in images)
        self._stream = None
        if on_cuda:
            self._stream = torch.cuda.Stream(device)
        self._pool: ThreadPoolExecutor | None = None
        self._loading: dict[int, Future[dict[str, Any]]] = {}
        self._sent: dict[int, tuple[dict[str, Any], torch.cuda.Event | None]] = {}  # What `_copy` returned, by view

    def take(self, indices: Sequence[int]) -> dict[int, dict[str, Any]]:
        """Return the data of a step's views by index, on the device.

        The host waits for images to be decoded only. The present stream waits for their copies.
        """
        self._load(indices)
        data_by_view = {}
        for index in indices:
            sent = self._sent.pop(index, None)
            if sent is None:
                sent = self._copy(index)
            data, copied = sent
            data_by_view[index] = data
            if copied is None:
                continue
            stream = torch.cuda.current_stream(self.device)
            stream.wait_event(copied)
            for value in data.values():
                if isinstance(value, Tensor) and value.is_cuda:
                    value.record_stream(stream)  # Its memory belongs to the copying stream.
        return data_by_view

    def prefetch(self, upcoming: Sequence[int], following: Sequence[int]) -> None:
        """Load the images of upcoming views, drop all others, and start copies of loaded ones of the following step."""
        for index in self._loading.keys() - set(upcoming):
            self._loading.pop(index).cancel()
        for index in self._sent.keys() - set(upcoming):
            del self._sent[index]
        self._load(upcoming)
        for index in following:
            if index not in self._sent and (self.decoded or self._loading[index].done()):
                self._sent[index] = self._copy(index)

    def close(self) -> None:
        """End the threads; they start again if another image is needed."""
        pool = self._pool
        self._pool = None
        self._loading.clear()
        self._sent.clear()
        if pool is not None:
            pool.shutdown(cancel_futures=True)

    def _load(self, indices: Iterable[int]) -> None:
        """Let threads load images in this order, unless they are being loaded."""
        if self.decoded:
            return
        for index in indices:
            if index in self._loading or index in self._sent:
                continue
            if self._pool is None:
                if self._stream is None:
                    self._pool = ThreadPoolExecutor(self.threads, "images")
                else:
                    self._pool = ThreadPoolExecutor(self.threads, "images", torch.cuda.set_device, (self.device,))
            self._loading[index] = self._pool.submit(self._pinned, index)

    def _pinned(self, index: int) -> dict[str, Any]:
        """Return a view's data on the host, with CUDA in pinned memory; this runs in a thread."""
        data = dict(self.images[index])
        if self._stream is None:
            return data
        return _map_tensors(data, lambda tensor: tensor.pin_memory())

    def _copy(self, index: int) -> tuple[dict[str, Any], torch.cuda.Event | None]:
        """Begin to copy a view's data to the device; return them, and with CUDA an event that follows the copies."""
        if self.decoded:
            data = dict(self.images[index])
        else:
            data = self._loading.pop(index).result()
        if self._stream is None:
            return data, None
        with torch.cuda.stream(self._stream):
            data = _map_tensors(data, lambda tensor: tensor.to(self.device, non_blocking=True))
            copied = torch.cuda.Event()
            copied.record(self._stream)
        return data, copied


def _map_tensors(data: Mapping[str, Any], function: Callable[[Tensor], Tensor]) -> dict[str, Any]:
    """Return a view's data with a function applied to its tensors; other values stay."""
    mapped = dict(data)
    for name, value in data.items():
        if isinstance(value, Tensor):
            mapped[name] = function(value)
    return mapped
