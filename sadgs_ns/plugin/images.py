"""Images that are decoded whenever they are asked for, and images that travel to the device ahead of their step."""

from __future__ import annotations

import copy
import io
import os
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.datamanagers.full_images_datamanager import _undistort_image
from nerfstudio.data.datasets.base_dataset import InputDataset
from numpy.typing import NDArray
from torch import Tensor

from sadgs_ns.errors import InputError, reason
from sadgs_ns.plugin.processes import processes_on_this_machine

_MOST_THREADS = 16
"""Threads that decode images on a machine of at least as many cores."""


def thread_count(asked: int | None) -> int:
    """Return the number of threads that decode images in this process.

    It is what was asked for, or one for each core, up to 16; several processes of a machine share its cores.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return asked or min(max(cores // processes_on_this_machine(), 1), _MOST_THREADS)


@dataclass(frozen=True)
class _Lens:
    """A camera whose images nerfstudio undistorts, as it was before that."""

    camera: Cameras
    """Camera without batch dimension."""
    K: NDArray[np.float32]
    """Intrinsics in px. [3, 3]"""
    distortion: NDArray[np.float32]
    """Coefficients in nerfstudio's order. [6], or [12] for FISHEYE624"""

    def undistort(
        self, data: dict[str, Any], image: NDArray[Any]
    ) -> tuple[NDArray[np.float32], NDArray[Any], Tensor | None]:
        """Return what nerfstudio's function returns for an image [H, W] or [H, W, C] of the camera.

        This is K [3, 3], the image and the mask [H, W, 1], if it has one, after undistortion.
        """
        return _undistort_image(self.camera, self.distortion, data, image, self.K.copy())


class ImagesOnDemand(Sequence[dict[str, Any]]):
    """Images of a dataset as nerfstudio's FullImageDatamanager loads and undistorts them, decoded at each access.

    The dataset's cameras become those of the undistorted images at once, for which no image is opened. Several threads
    may ask for images at the same time.

    Args:
        dataset: The images, with their cameras and masks. It must be given to one such object only.
        keep_files: Whether to keep the bytes of files in memory once they have been read. Otherwise a file is read at
            each access, from the operating system's cache of files where that has room.
    """

    def __init__(self, dataset: InputDataset, keep_files: bool = False) -> None:
        self._names = dataset.image_filenames
        self._sizes = torch.cat([dataset.cameras.width, dataset.cameras.height], dim=-1).tolist()  # [C][2] px
        self._lenses = _undistort_cameras(dataset.cameras)
        outputs, kept = copy.copy(dataset._dataparser_outputs), {} if keep_files else None
        outputs.image_filenames = _Files(outputs.image_filenames, kept)  # type: ignore[assignment]
        if outputs.mask_filenames is not None:
            outputs.mask_filenames = _Files(outputs.mask_filenames, kept)  # type: ignore[assignment]
        self._dataset = copy.copy(dataset)
        self._dataset._dataparser_outputs = outputs
        self._opencv_agrees: bool | None = None  # It is known once a JPEG has been decoded.
        if dataset.scale_factor == 1 and type(dataset).get_numpy_image is InputDataset.get_numpy_image:
            self._dataset.get_numpy_image = self._decode

    def __len__(self) -> int:
        return len(self._names)

    def __getitem__(self, index: Any) -> Any:
        """Decode an image and undistort it.

        Returns:
            `image` uint8 [H, W, 3 or 4], contiguous and on the CPU, boolean `mask` [H, W, 1] if the image has one, and
            what else the dataset adds.

        Raises:
            InputError: If the image or its mask cannot be read any more, or has another size than its camera.
        """
        name, size, lens = self._names[index], tuple(self._sizes[index]), self._lenses[index]
        try:
            data = self._dataset.get_data(index, image_type="uint8")
        except MemoryError:
            raise
        except Exception as error:  # Decoders raise OSError, SyntaxError, struct.error, …
            masks = self._dataset._dataparser_outputs.mask_filenames is not None
            raise InputError(
                f"{name}{' or its mask' if masks else ''} cannot be read as an image ({reason(error)}): copy it again, "
                "or leave it out of the reconstruction."
            ) from error
        image: Tensor = data["image"]
        if (width_and_height := (image.shape[1], image.shape[0])) != size:
            sizes = "{} × {} px, but its camera {} × {}".format(*width_and_height, *size)
            raise InputError(f"{name} has {sizes}: use the images that the poses were computed from.")
        if lens is not None:
            _, undistorted, mask = lens.undistort(data, image.numpy())
            # nerfstudio's crop is a view of the larger image.
            image = torch.from_numpy(np.ascontiguousarray(undistorted))
            if mask is not None:
                data["mask"] = mask.contiguous()
        return {**data, "image": image}

    def _decode(self, image_idx: int) -> NDArray[np.uint8]:
        """Decode an image as nerfstudio's `get_numpy_image`, a whole JPEG with OpenCV instead of Pillow.

        Of 2 megapixels Pillow keeps other threads from running Python for 5 ms in all, and the training loop is such
        a thread. Both libraries decode with libjpeg-turbo, but with versions of their own: the first JPEG is decoded
        with both, and OpenCV is used only if their pixels are equal.

        Returns:
            [H, W, 3 or 4]
        """
        content = self._dataset.image_filenames[image_idx].getbuffer()  # type: ignore[attr-defined]
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


def _undistort_cameras(cameras: Cameras) -> list[_Lens | None]:
    """Give C cameras the intrinsics and sizes that they have once nerfstudio has undistorted their images.

    Cameras that are alike, which most are, are computed once. Returns what each was before, or None where nothing is to
    undo.
    """
    lenses: list[_Lens | None] = [None] * len(cameras)
    distortion = cameras.distortion_params  # [C, D]
    if distortion is None or not distortion.any():
        return lenses
    fields = [cameras.camera_type, cameras.fx, cameras.fy, cameras.cx, cameras.cy, cameras.width, cameras.height]
    rows = torch.cat([field.double() for field in (*fields, distortion)], dim=-1).numpy()  # [C, 7 + D]
    _, firsts, numbers = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    for number, first in enumerate(firsts.tolist()):
        if not distortion[first].any():
            continue
        camera = copy.deepcopy(cameras[first].reshape(()))
        lens = _Lens(camera, camera.get_intrinsics_matrices().numpy(), distortion[first].clone().numpy())
        # The new intrinsics do not depend on the pixels.
        blank = np.zeros((int(camera.height.item()), int(camera.width.item())), np.uint8)
        K, image, _ = lens.undistort({}, blank)
        for index in np.flatnonzero(numbers.reshape(-1) == number).tolist():
            lenses[index] = lens
            cameras.fx[index], cameras.fy[index] = float(K[0, 0]), float(K[1, 1])
            cameras.cx[index], cameras.cy[index] = float(K[0, 2]), float(K[1, 2])
            cameras.width[index], cameras.height[index] = image.shape[1], image.shape[0]
    return lenses


class _Files(Sequence[io.BytesIO]):
    """The content of files in the place of their paths, since Pillow opens both; `kept` keeps what has been read."""

    def __init__(self, paths: Sequence[Path], kept: dict[Path, bytes] | None) -> None:
        self._paths, self._kept = paths, kept

    def __len__(self) -> int:
        return len(self._paths)

    def __getitem__(self, index: Any) -> Any:
        path, kept = self._paths[index], self._kept
        content = path.read_bytes() if kept is None or path not in kept else kept[path]
        if kept is not None:
            kept[path] = content
        return io.BytesIO(content)


class ImagesAhead:
    """Brings images from the host to the device ahead of the step that needs them, on a stream of their own.

    What is not in pinned memory is decoded, or copied, into pinned memory by threads. torch keeps pinned memory that is
    no longer used for the next images, so that it takes as much as the images that are under way. Without CUDA the
    images stay where they are, and only decoding runs ahead.

    Args:
        images: All images, on the host: a list of decoded ones, or `ImagesOnDemand`.
        device: Device of training.
        threads: Number of threads that decode.
    """

    def __init__(self, images: Sequence[Mapping[str, Any]], device: torch.device, threads: int) -> None:
        self.images = images
        self.device = device
        self.threads = threads
        on_cuda = device.type == "cuda"
        self._ready = isinstance(images, list) and all(not on_cuda or data["image"].is_pinned() for data in images)
        """Whether all images can be copied as they are, without a thread's help."""
        self._stream = torch.cuda.Stream(device) if on_cuda else None
        self._pool: ThreadPoolExecutor | None = None
        self._loading: dict[int, Future[dict[str, Any]]] = {}
        self._sent: dict[int, tuple[dict[str, Any], torch.cuda.Event | None]] = {}
        self._kept: dict[int, torch.cuda.Event | None] = {}
        """Views of which the codes of S̄ are kept on the host, with the end of their copy."""

    def load(self, indices: Iterable[int]) -> None:
        """Have threads load images, in this order, and forget what was under way and is not among them."""
        wanted = dict.fromkeys(indices)
        for index in self._loading.keys() - wanted.keys():
            self._loading.pop(index).cancel()
        for index in self._sent.keys() - wanted.keys():
            del self._sent[index]
        if not self._ready:
            for index in wanted:
                if index not in self._loading and index not in self._sent:
                    self._loading[index] = self._submit(index)

    def send(self, indices: Iterable[int], with_codes: bool) -> None:
        """Start copying the next step's images that threads have loaded to the device; this waits for nothing.

        `with_codes` says whether that step needs the codes of S̄, too.
        """
        for index in dict.fromkeys(indices):
            if index not in self._sent and (self._ready or (index in self._loading and self._loading[index].done())):
                self._sent[index] = self._copied(index, with_codes)

    def take(self, index: int, with_codes: bool) -> dict[str, Any]:
        """Return a view's data on the device, and wait only where its image is not decoded yet.

        Returns:
            `image` [H, W, 3 or 4], boolean `mask` [H, W, 1] if there is one, what else the dataset added and, with
            `with_codes`, `codes` uint8 [H, W, 3] of S̄ where they are known. The present stream may use it.

        Raises:
            InputError: As `ImagesOnDemand.__getitem__`.
        """
        data, copied = self._sent.pop(index, None) or self._copied(index, with_codes)
        if copied is not None:
            stream = torch.cuda.current_stream(self.device)
            stream.wait_event(copied)
            for value in data.values():
                if isinstance(value, Tensor) and value.is_cuda:
                    value.record_stream(stream)  # Its memory belongs to the stream of the copies.
        return data

    def keep_codes(self, index: int, codes: Tensor) -> None:
        """Keep a view's codes of S̄, uint8 [H, W, 3], on the host, if its image is there decoded and pinned.

        Beside images that are not decoded, codes would take more memory than the images; they are computed again.
        """
        if not self._ready:
            return
        self._codes[index].copy_(codes, non_blocking=True)
        written = None
        if self._stream is not None:
            written = torch.cuda.Event()
            written.record(torch.cuda.current_stream(self.device))
        self._kept[index] = written

    def kept_codes(self, index: int) -> Tensor | None:
        """Return the codes of S̄ of a view on the device, if they are kept. uint8 [H, W, 3]"""
        # They were written by the stream that now reads them.
        return self._codes[index].to(self.device, non_blocking=True) if index in self._kept else None

    def close(self) -> None:
        """End the threads; they start again where another image is asked for."""
        pool, self._pool = self._pool, None
        self._loading.clear()
        self._sent.clear()
        if pool is not None:
            pool.shutdown(cancel_futures=True)

    @cached_property
    def _codes(self) -> list[Tensor]:
        """Room for the codes of S̄ of all views on the host. uint8 [H, W, 3] each

        It is made at once, because the host waits for the device whenever pinned memory is new.
        """
        pinned = self._stream is not None
        shapes = [(*data["image"].shape[:2], 3) for data in self.images]
        return [torch.empty(shape, dtype=torch.uint8, pin_memory=pinned) for shape in shapes]

    def _submit(self, index: int) -> Future[dict[str, Any]]:
        if self._pool is None:
            on_cuda = {"initializer": torch.cuda.set_device, "initargs": (self.device,)}
            self._pool = ThreadPoolExecutor(self.threads, "images", **(on_cuda if self._stream is not None else {}))  # type: ignore[arg-type]
        return self._pool.submit(self._load, index)

    def _load(self, index: int) -> dict[str, Any]:
        """Return a view's data on the host, in pinned memory where there is CUDA; this runs in a thread."""
        data = dict(self.images[index])
        if self._stream is not None:
            data = {name: v.pin_memory() if isinstance(v, Tensor) else v for name, v in data.items()}
        return data

    def _copied(self, index: int, with_codes: bool) -> tuple[dict[str, Any], torch.cuda.Event | None]:
        """Return a view's data on the device, and the event that says when they are there; None without CUDA."""
        if self._ready:
            data = dict(self.images[index])
        else:
            data = (self._loading.pop(index, None) or self._submit(index)).result()
        with_codes = with_codes and index in self._kept
        if with_codes:
            data["codes"] = self._codes[index]
        if self._stream is None:
            return data, None
        with torch.cuda.stream(self._stream):
            if with_codes and (written := self._kept[index]) is not None:
                self._stream.wait_event(written)
            data = {
                name: v.to(self.device, non_blocking=True) if isinstance(v, Tensor) else v for name, v in data.items()
            }
            copied = torch.cuda.Event()
            copied.record(self._stream)
        return data, copied
