"""nerfstudio's loader of whole images, behind checks of the images' names, and with a faster reader of SfM points."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager, FullImageDatamanagerConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParser, ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import Nerfstudio
from nerfstudio.data.datasets.base_dataset import InputDataset
from numpy.typing import NDArray
from torch import Tensor
from tyro.conf import Suppress

from sadgs_ns.data import colmap, ply
from sadgs_ns.data.validation import names
from sadgs_ns.errors import InputError


@dataclass
class SadgsDatamanagerConfig(FullImageDatamanagerConfig):
    """nerfstudio's; what its loader of whole images does not read is no option of the command line."""

    _target: type = field(default_factory=lambda: SadgsDatamanager)
    data: Suppress[Path | None] = None
    """Folder of the data; `--data` sets it."""
    masks_on_gpu: Suppress[bool] = False
    """Not read where whole images are cached."""
    images_on_gpu: Suppress[bool] = False
    """Not read where whole images are cached."""
    eval_num_images_to_sample_from: Suppress[int] = -1
    """Not read where whole images are cached."""
    eval_num_times_to_repeat_images: Suppress[int] = -1
    """Not read where whole images are cached."""
    eval_image_indices: Suppress[tuple[int, ...] | None] = (0,)
    """Not read where whole images are cached."""
    camera_res_scale_factor: float = 1.0
    """Factor by which images and cameras are scaled when they are loaded; 0.5 trains at half the resolution."""
    cache_images: Literal["cpu", "gpu"] = "gpu"
    """Where the images are kept: "gpu" is the device of training, whatever it is."""
    cache_images_type: Literal["uint8", "float32"] = "uint8"
    """Type in which the images are kept; "uint8" takes a quarter of the memory."""
    max_thread_workers: Suppress[int | None] = None
    """Threads that load images; None leaves their number to Python."""
    train_cameras_sampling_strategy: Literal["random", "fps"] = "random"
    """Order of the training views: "random" takes each once a round; "fps" takes views far from each other first."""
    train_cameras_sampling_seed: int = 42
    """Seed of the order of the training views."""
    fps_reset_every: Suppress[int] = 100
    """Views after which "fps" starts again; it draws no more than there are."""


def check_options(config: FullImageDatamanagerConfig) -> None:
    """Check whether the options of a datamanager and of its parser of data make sense.

    Raises:
        InputError: If one is out of its range.
    """
    parser: Any = config.dataparser
    ranges = {
        "scale_factor": (lambda value: 0 < value < math.inf, "positive and finite"),
        "train_split_fraction": (lambda value: 0 < value <= 1, "in (0, 1]"),
        "eval_interval": (lambda value: value >= 2, "at least 2"),
    }
    for name, (fits, allowed) in ranges.items():
        if hasattr(parser, name) and not fits(value := getattr(parser, name)):
            raise InputError(f"{name}, an option of the data's parser, must be {allowed}, got {value:g}.")
    if not 0 < config.camera_res_scale_factor <= 1:
        raise InputError(
            f"pipeline.datamanager.camera_res_scale_factor must be in (0, 1], got {config.camera_res_scale_factor:g}."
        )


class SadgsDatamanager(FullImageDatamanager[InputDataset]):
    """Checks what the data's images are called, and where they lie, and reads SfM points once, faster, without open3d.

    The checks are here rather than in the pipeline, because `ns-render dataset` makes a datamanager of its own.

    Raises:
        InputError: If an image is too small; as `colmap.read_poses`, `ply.read_points`, `names.check_names` and
            `names.check_paths`.
    """

    def __init__(self, config: FullImageDatamanagerConfig, *args: Any, **kwargs: Any) -> None:
        parser = copy.copy(config.dataparser)  # changed below; the one that was given belongs to the run's config.yml
        self._points: Path | None = None
        """COLMAP's points, where nerfstudio does not read them itself."""
        if isinstance(parser, ColmapDataParserConfig):  # before it offers to make smaller images
            model = (config.data or parser.data) / parser.colmap_path
            kind = "txt" if (model / "cameras.txt").exists() else "bin"
            if (source := model / f"images.{kind}").is_file():
                names.check_names((name for name, _, _ in colmap.read_poses(source)), source)
            plain = parser._target is ColmapDataParser and parser.max_2D_matches_per_3D_point == 0
            if plain and parser.load_3D_points:
                self._points = colmap.points_file(model)
                parser.load_3D_points = self._points is None
        if parser._target is Nerfstudio:
            parser._target = _Nerfstudio
        config = copy.copy(config)
        config.dataparser = parser
        super().__init__(config, *args, **kwargs)  # type: ignore[arg-type]
        for dataset in (self.train_dataset, self.eval_dataset):
            names.check_paths(dataset.image_filenames)
            _check_sizes(dataset)

    def create_train_dataset(self) -> InputDataset:
        """Add COLMAP's points to what nerfstudio makes; it would read the same ones in ten times the time."""
        if self._points is not None:
            outputs = self.train_dataparser_outputs
            points = colmap.read_points(self._points)
            outputs.metadata |= _points_in_the_run(*points, outputs.dataparser_transform, outputs.dataparser_scale)
        return super().create_train_dataset()

    def create_eval_dataset(self) -> InputDataset:
        """Make the dataset without reading the points a second time: nothing looks for them here."""
        parser: Any = self.config.dataparser
        if hasattr(parser, "load_3D_points"):
            parser.load_3D_points = False
        return super().create_eval_dataset()


def _check_sizes(dataset: InputDataset) -> None:
    """Check whether images are large enough for the loss.

    Raises:
        InputError: If one is less than 2 px high or wide.
    """
    sizes = torch.cat([dataset.cameras.width, dataset.cameras.height], dim=-1)  # [C, 2] px
    for index in (sizes < 2).any(dim=-1).nonzero().flatten().tolist():
        width, height = sizes[index].tolist()
        raise InputError(
            f"{dataset.image_filenames[index]} would be trained on with {width} × {height} px, and at least 2 × 2 are "
            "needed: take a larger image, or scale it down less with pipeline.datamanager.camera-res-scale-factor or "
            "the parser's downscale-factor."
        )


class _Nerfstudio(Nerfstudio):
    """nerfstudio's parser, which would read points with open3d."""

    def _load_3D_points(
        self, ply_file_path: Path, transform_matrix: Tensor, scale_factor: float
    ) -> dict[str, Tensor] | None:
        positions, colors = ply.read_points(ply_file_path)
        return _points_in_the_run(positions, colors, transform_matrix, scale_factor) if len(positions) else None


def _points_in_the_run(
    positions: NDArray[np.floating], colors: NDArray[np.uint8], transform: Tensor, scale: float
) -> dict[str, Tensor]:
    """Points as nerfstudio's metadata hold them.

    Args:
        positions: In the data's frame. [P, 3]
        colors: In 0 … 255. [P, 3]
        transform: From the data's frame to the run's. [3, 4]
        scale: Factor after the transform.
    """
    with np.errstate(over="ignore"):  # numbers beyond float32 become infinite, and the model leaves them out
        positions = positions.astype(np.float32)
    homogeneous = torch.from_numpy(np.pad(positions, ((0, 0), (0, 1)), constant_values=1))
    return {"points3D_xyz": homogeneous @ transform.T * scale, "points3D_rgb": torch.from_numpy(colors)}
