"""nerfstudio's loader of whole images, with checks of their names and more threads."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager, FullImageDatamanagerConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.datasets.base_dataset import InputDataset
from rich.progress import track

from sadgs_ns.data import colmap
from sadgs_ns.data.cameras import mark_training_views
from sadgs_ns.data.checks import splits
from sadgs_ns.data.images import NO_MASK
from sadgs_ns.data.own_parsers import OWN
from sadgs_ns.data.parsers import choose_parser
from sadgs_ns.errors import InputError
from sadgs_ns.training.step.images import LazyImages, thread_count

NUM_PIXELS = "num_pixels"
"""Key of the number of all training images' pixels in the metadata that the model gets."""


class MaskedDataset(InputDataset):
    """nerfstudio's dataset, in which images without mask have one that hides nothing, beside others with masks."""

    def get_data(self, image_idx: int, image_type: Literal["uint8", "float32"] = "float32") -> dict[str, Any]:
        """Return `image` [H, W, 3 or 4] and the data that nerfstudio gives beside it, as `mask` bool [H, W, 1]."""
        outputs = self._dataparser_outputs
        if outputs.mask_filenames is None or outputs.mask_filenames[image_idx] != NO_MASK:
            return super().get_data(image_idx, image_type)
        plain = copy.copy(self)
        plain._dataparser_outputs = dataclasses.replace(outputs, mask_filenames=None)
        plain.mask_color = None
        data = InputDataset.get_data(plain, image_idx, image_type)
        height, width = data["image"].shape[:2]
        return data | {"mask": torch.ones((height, width, 1), dtype=torch.bool)}


class SadgsDatamanager(FullImageDatamanager[InputDataset]):
    """Loads images in threads or on demand. Raises InputError for wrong names or sizes."""

    @cached_property
    def dataset_type(self) -> type[InputDataset]:
        """The dataset of training and of held-out views."""
        return MaskedDataset

    def __init__(self, config: FullImageDatamanagerConfig, *args: Any, **kwargs: Any) -> None:
        config = copy.copy(config)  # The original is written to config.yml.
        choose_parser(config)
        parser = copy.copy(config.dataparser)
        if isinstance(parser, ColmapDataParserConfig):
            _check_names(config, parser)  # This precedes the making of smaller images.
        parser._target = OWN.get(parser._target, parser._target)
        config.dataparser = parser
        # nerfstudio would keep more than 500 images on the host, whatever their size.
        requested = config.cache_images
        config.cache_images = "cpu"
        super().__init__(config, *args, **kwargs)  # type: ignore[arg-type]
        self.config.cache_images = requested
        cameras = self.train_dataset.cameras
        self.train_dataset.metadata[NUM_PIXELS] = int((cameras.width * cameras.height).sum())
        for dataset in (self.train_dataset, self.eval_dataset):
            _make_paths(dataset)
            splits.check_paths(dataset.image_filenames)
            mark_training_views(dataset.cameras, dataset.image_filenames, self.train_dataset.image_filenames)
            _check_sizes(dataset)
            if type(self).setup_train.__module__ == "nerfstudio.scripts.render":  # `ns-render dataset` replaces it.
                _check_stems(dataset.image_filenames)

    def create_eval_dataset(self) -> InputDataset:
        """Make the dataset without reading the points again; nothing uses them."""
        parser: Any = self.config.dataparser
        if hasattr(parser, "load_3D_points"):
            parser.load_3D_points = False
        return super().create_eval_dataset()

    def _load_images(self, split: Literal["train", "eval"], cache_images_device: str) -> Any:
        """Load the images of a split on the device or on the host, or return `LazyImages` if they stay compressed."""
        device = torch.device(self.device)
        dataset = self.eval_dataset
        if split == "train":
            dataset = self.train_dataset
        images = LazyImages(dataset)
        self.train_cameras = self.train_dataset.cameras
        if cache_images_device == "compressed":
            return images
        loaded = []
        with ThreadPoolExecutor(thread_count(self.config.max_thread_workers)) as pool:
            decoded = pool.map(images.__getitem__, range(len(images)))
            try:
                for data in track(decoded, f"Loading the {split} images", total=len(images), transient=True):
                    loaded.append(_place(data, cache_images_device, device))
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
        if cache_images_device == "gpu":
            self.train_cameras = self.train_cameras.to(device)
        return loaded

    @property
    def fixed_indices_eval_dataloader(self) -> Any:
        """Cameras [1] and data of the held-out views, copied to the device one by one."""
        return _HeldOutViews(self)

    def get_train_rays_per_batch(self) -> int:
        """Return the number of pixels of the first training image; nerfstudio's trainer asks in each step."""
        cameras = self.train_dataset.cameras
        return int(cameras.height[0]) * int(cameras.width[0])


def _check_names(config: FullImageDatamanagerConfig, parser: ColmapDataParserConfig) -> None:
    """Raise InputError if the names of a COLMAP model's images are wrong."""
    model = (config.data or parser.data) / parser.colmap_path
    source = model / f"images.{colmap.model_kind(model)}"
    if source.is_file():
        names = (name for name, _, _ in colmap.read_poses(source))
        splits.check_names(names, source)


def _make_paths(dataset: InputDataset) -> None:
    """Make paths of the names of images and masks, which some parsers give as texts."""
    outputs = dataset._dataparser_outputs
    outputs.image_filenames = [Path(name) for name in outputs.image_filenames]
    if outputs.mask_filenames is not None:
        outputs.mask_filenames = [Path(name) for name in outputs.mask_filenames]


def _check_stems(names: Sequence[Path]) -> None:
    """Raise InputError for images that differ in their suffix alone: `ns-render` would write one file for both."""
    first_of: dict[Path, Path] = {}
    for name in names:
        first = first_of.setdefault(name.with_suffix(""), name)
        if first != name:
            raise InputError(
                f"{first} and {name} differ in their suffix alone, so that `ns-render dataset` would write one over "
                "the other: give one another name, there and in its poses."
            )


def _place(data: dict[str, Any], where: str, device: torch.device) -> dict[str, Any]:
    """Return an image's data with `image` and `mask` on the training device ("gpu"), or on the host for fast copies."""
    placed = dict(data)
    for name in ("image", "mask"):
        if name not in data:
            continue
        if where == "gpu":
            placed[name] = data[name].to(device)
        elif device.type == "cuda":
            placed[name] = data[name].pin_memory()
    return placed


@dataclass
class _HeldOutViews(Sequence[tuple[Cameras, dict[str, Any]]]):
    """Camera [1] and data of each held-out view, which are copied to the device when they are read."""

    datamanager: SadgsDatamanager

    def __len__(self) -> int:
        return len(self.datamanager.eval_dataset)

    def __getitem__(self, index: Any) -> Any:
        device = self.datamanager.device
        data = self.datamanager.cached_eval[index]
        camera = self.datamanager.eval_dataset.cameras[index : index + 1].to(device)
        return camera, {**data, "image": data["image"].to(device)}


def _check_sizes(dataset: InputDataset) -> None:
    """Raise InputError if an image is less than 2 px high or wide, too small for the loss."""
    sizes = torch.cat([dataset.cameras.width, dataset.cameras.height], dim=-1)  # [C, 2] px
    for index in (sizes < 2).any(dim=-1).nonzero().flatten().tolist():
        width, height = sizes[index].tolist()
        raise InputError(
            f"{dataset.image_filenames[index]} would be trained on with {width} × {height} px, and at least 2 × 2 are "
            "needed: take a larger image, or scale it down less with pipeline.datamanager.camera-res-scale-factor or "
            "the parser's downscale-factor."
        )
