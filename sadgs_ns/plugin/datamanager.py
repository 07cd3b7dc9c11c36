"""nerfstudio's loader of whole images, behind checks of the images' names, and with a faster reader of SfM points."""

from __future__ import annotations

import copy
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager, FullImageDatamanagerConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParser, ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import Nerfstudio
from nerfstudio.data.datasets.base_dataset import InputDataset
from numpy.typing import NDArray
from torch import Tensor

from sadgs_ns.data import colmap, ply
from sadgs_ns.data.validation import names


@dataclass
class SadgsDatamanagerConfig(FullImageDatamanagerConfig):
    """nerfstudio's."""

    _target: type = field(default_factory=lambda: SadgsDatamanager)


class SadgsDatamanager(FullImageDatamanager[InputDataset]):
    """Checks what the data's images are called, and where they lie, and reads SfM points once, faster, without open3d.

    The checks are here rather than in the pipeline, because `ns-render dataset` makes a datamanager of its own.

    Raises:
        InputError: As `colmap.read_poses`, `ply.read_points`, `names.check_names` and `names.check_paths`.
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
