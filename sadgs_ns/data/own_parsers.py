"""This package's parsers in the place of nerfstudio's, which they extend."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch
from nerfstudio.data.dataparsers import blender_dataparser, nerfstudio_dataparser
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.dataparsers.blender_dataparser import Blender
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParser
from nerfstudio.data.dataparsers.nerfstudio_dataparser import Nerfstudio
from nerfstudio.data.dataparsers.scannet_dataparser import ScanNet
from numpy.typing import NDArray
from torch import Tensor

from sadgs_ns.data import colmap, ply
from sadgs_ns.data.images import mask_name
from sadgs_ns.data.layouts import COLMAP_FOLDERS
from sadgs_ns.data.run_frame import centre_poses, move_to_fixed_frame, points_in_the_run, undo_centring
from sadgs_ns.data.transforms import read_blender, read_transforms


class _PointsOfPly:
    """Reads a PLY's points for nerfstudio's parsers, which need open3d for it."""

    config: Any
    _middle: NDArray[np.float64] = np.zeros(3)  # By which poses were moved; `centre_poses`

    def _load_3D_points(self, path: Path, transform: Any = None, scale: Any = None, *_: Any) -> dict[str, Tensor]:
        positions, colors = ply.read_points(path)
        if transform is None:  # Blender's parser gives neither.
            transform, scale = torch.eye(4)[:3], self.config.scale_factor
        return points_in_the_run(positions - self._middle, colors, transform, scale) if len(positions) else {}


class BlenderParser(_PointsOfPly, Blender):
    def _generate_dataparser_outputs(self, split: str = "train") -> DataparserOutputs:
        with mock.patch.object(blender_dataparser, "load_from_json", read_blender):
            return super()._generate_dataparser_outputs(split)


class ScanNetParser(_PointsOfPly, ScanNet):
    def _load_3D_points(self, path: Path, *settings: Any) -> dict[str, Tensor]:
        return super()._load_3D_points(path, *settings) if path.is_file() else {}  # By default there is none.


class TransformsParser(_PointsOfPly, Nerfstudio):
    """nerfstudio's parser of transforms.json, which moves cameras and points to the frame that a file may fix."""

    def _generate_dataparser_outputs(self, split: str = "train") -> DataparserOutputs:
        path = self.config.data if self.config.data.suffix == ".json" else self.config.data / "transforms.json"
        if (model := path.parent / COLMAP_FOLDERS[0]).exists():
            self.prompted_user, self.create_pc = True, False  # The answer no; the points are read below.
        meta = read_transforms(path)
        self._middle, middle = centre_poses(meta, self.config.center_method)
        with mock.patch.object(nerfstudio_dataparser, "load_from_json", lambda _: meta):
            outputs = super()._generate_dataparser_outputs(split)
        source = colmap.points_file(model)
        if self.config.load_3D_points and "points3D_xyz" not in outputs.metadata and source is not None:
            positions, colors = colmap.read_points(source)
            placed = outputs.dataparser_transform, outputs.dataparser_scale
            outputs.metadata |= points_in_the_run(positions - middle, colors, *placed)
        move_to_fixed_frame(undo_centring(outputs, middle), meta, path)
        return outputs


class ColmapParser(ColmapDataParser):
    """nerfstudio's parser of COLMAP's files, which reads points in a tenth of the time and finds masks by all names."""

    def _generate_dataparser_outputs(self, split: str = "train", **options: Any) -> DataparserOutputs:
        return undo_centring(super()._generate_dataparser_outputs(split, **options), self._middle)

    def _get_all_images_and_cameras(self, recon_dir: Path) -> dict[str, Any]:
        described, config = super()._get_all_images_and_cameras(recon_dir), self.config
        if config.masks_path is not None:
            masks, images = config.data / config.masks_path, (config.data / config.images_path).as_posix()
            for frame in described["frames"]:
                frame["mask_path"] = (masks / mask_name(masks, os.path.relpath(frame["file_path"], images))).as_posix()
        self._middle = centre_poses(described, config.center_method)[1]
        return described

    def _load_3D_points(self, colmap_path: Path, transform_matrix: Tensor, scale_factor: float) -> dict[str, Tensor]:
        matches = self.config.max_2D_matches_per_3D_point
        found = super()._load_3D_points(colmap_path, transform_matrix, scale_factor) if matches else {}
        positions, colors = colmap.read_points(colmap.points_file(colmap_path) or colmap_path / "points3D.bin")
        return found | points_in_the_run(positions - self._middle, colors, transform_matrix, scale_factor)


OWN: dict[type, type] = {
    Blender: BlenderParser,
    ColmapDataParser: ColmapParser,
    ScanNet: ScanNetParser,
    Nerfstudio: TransformsParser,
}
"""This package's parser in the place of each of nerfstudio's."""
