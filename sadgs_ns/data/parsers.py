"""nerfstudio's parsers: which one fits a capture, and the changes that this package makes."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from unittest import mock

import numpy as np
import torch
import tyro
from nerfstudio.configs.dataparser_configs import all_dataparsers
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
from nerfstudio.data.dataparsers import blender_dataparser, nerfstudio_dataparser
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig, DataparserOutputs
from nerfstudio.data.dataparsers.blender_dataparser import Blender, BlenderDataParserConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParser, ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import Nerfstudio, NerfstudioDataParserConfig
from nerfstudio.data.dataparsers.scannet_dataparser import ScanNet
from numpy.typing import NDArray
from torch import Tensor

from sadgs_ns.data import colmap, ply
from sadgs_ns.data.coordinates import FRAME_KEYS, Similarity, fixed_frame
from sadgs_ns.data.images import mask_name
from sadgs_ns.data.layouts import COLMAP_FOLDERS, automatic_options, layout_of, unreadable
from sadgs_ns.data.transforms import read_blender, read_transforms
from sadgs_ns.errors import InputError

_FAR = 10.0  # Distance of cameras from the origin, in their extents, from which `_centre` moves them


@dataclass
class AutomaticDataParserConfig(DataParserConfig):
    """The parser that fits what the folder holds: transforms.json, a COLMAP reconstruction or a Blender scene."""


PARSERS: dict[str, DataParserConfig] = {
    "automatic": AutomaticDataParserConfig(),
    **all_dataparsers,
    "nerfstudio-data": NerfstudioDataParserConfig(load_3D_points=True),
}
"""Parsers by their names on the command line: ours, then nerfstudio's."""

if TYPE_CHECKING:
    AnyParserConfig = DataParserConfig
else:
    AnyParserConfig = tyro.conf.OmitSubcommandPrefixes[
        tyro.extras.subcommand_type_from_defaults(PARSERS, prefix_names=False)
    ]
    """The union that tyro turns into subcommands, as nerfstudio does with its own parsers."""


def choose_parser(config: FullImageDatamanagerConfig) -> None:
    """Replace the automatic parser by one that fits, which `config.yml` names; raise InputError for unreadable data."""
    if not isinstance(config.dataparser, AutomaticDataParserConfig):
        return
    data = Path(config.data or config.dataparser.data)
    try:
        layout = layout_of(data)
    except OSError as error:
        raise InputError(unreadable(error)) from error
    if layout == "blender":
        config.dataparser = BlenderDataParserConfig(data=data)
    elif layout == "colmap":
        options = vars(automatic_options(data))
        chosen = ("colmap_path", "images_path", "downscale_factor", "downscale_rounding_mode")
        config.dataparser = ColmapDataParserConfig(data=data, **{name: options[name] for name in chosen})
    else:
        config.dataparser = NerfstudioDataParserConfig(data=data, load_3D_points=True)


class _PointsOfPly:
    """Reads a PLY's points for nerfstudio's parsers, which need open3d for it."""

    config: Any
    _middle: NDArray[np.float64] = np.zeros(3)  # By which poses were moved; `_centre`

    def _load_3D_points(self, path: Path, transform: Any = None, scale: Any = None, *_: Any) -> dict[str, Tensor]:
        positions, colors = ply.read_points(path)
        if transform is None:  # Blender's parser gives neither.
            transform, scale = torch.eye(4)[:3], self.config.scale_factor
        return points_in_the_run(positions - self._middle, colors, transform, scale) if len(positions) else {}


class _Blender(_PointsOfPly, Blender):
    def _generate_dataparser_outputs(self, split: str = "train") -> DataparserOutputs:
        with mock.patch.object(blender_dataparser, "load_from_json", read_blender):
            return super()._generate_dataparser_outputs(split)


class _ScanNet(_PointsOfPly, ScanNet):
    def _load_3D_points(self, path: Path, *settings: Any) -> dict[str, Tensor]:
        return super()._load_3D_points(path, *settings) if path.is_file() else {}  # By default there is none.


class TransformsParser(_PointsOfPly, Nerfstudio):
    """nerfstudio's parser of transforms.json, which moves cameras and points to the frame that a file may fix."""

    def _generate_dataparser_outputs(self, split: str = "train") -> DataparserOutputs:
        path = self.config.data if self.config.data.suffix == ".json" else self.config.data / "transforms.json"
        if (model := path.parent / COLMAP_FOLDERS[0]).exists():
            self.prompted_user, self.create_pc = True, False  # The answer no; the points are read below.
        meta = read_transforms(path)
        self._middle, middle = _centre(meta, self.config.center_method)
        with mock.patch.object(nerfstudio_dataparser, "load_from_json", lambda _: meta):
            outputs = super()._generate_dataparser_outputs(split)
        source = colmap.points_file(model)
        if self.config.load_3D_points and "points3D_xyz" not in outputs.metadata and source is not None:
            positions, colors = colmap.read_points(source)
            placed = outputs.dataparser_transform, outputs.dataparser_scale
            outputs.metadata |= points_in_the_run(positions - middle, colors, *placed)
        _move_to_fixed_frame(_undo_centring(outputs, middle), meta, path)
        return outputs


class ColmapParser(ColmapDataParser):
    """nerfstudio's parser of COLMAP's files, which reads points in a tenth of the time and finds masks by all names."""

    def _generate_dataparser_outputs(self, split: str = "train", **options: Any) -> DataparserOutputs:
        return _undo_centring(super()._generate_dataparser_outputs(split, **options), self._middle)

    def _get_all_images_and_cameras(self, recon_dir: Path) -> dict[str, Any]:
        described, config = super()._get_all_images_and_cameras(recon_dir), self.config
        if config.masks_path is not None:
            masks, images = config.data / config.masks_path, (config.data / config.images_path).as_posix()
            for frame in described["frames"]:
                frame["mask_path"] = (masks / mask_name(masks, os.path.relpath(frame["file_path"], images))).as_posix()
        self._middle = _centre(described, config.center_method)[1]
        return described

    def _load_3D_points(self, colmap_path: Path, transform_matrix: Tensor, scale_factor: float) -> dict[str, Tensor]:
        matches = self.config.max_2D_matches_per_3D_point
        found = super()._load_3D_points(colmap_path, transform_matrix, scale_factor) if matches else {}
        positions, colors = colmap.read_points(colmap.points_file(colmap_path) or colmap_path / "points3D.bin")
        return found | points_in_the_run(positions - self._middle, colors, transform_matrix, scale_factor)


OWN: dict[type, type] = {own.__bases__[-1]: own for own in (_Blender, ColmapParser, _ScanNet, TransformsParser)}
"""This package's parser in the place of each of nerfstudio's."""


def _centre(meta: Mapping[str, Any], method: str) -> NDArray[np.float64]:
    """Move poses that are far from the origin, as on a map, there; others stay, which is a translation by zeros.

    nerfstudio would round them first; raise InputError if it shall not centre them and rounds them coarsely. Return the
    translation in the frames of the poses and of the data. [2, 3]
    """
    poses = np.array([frame["transform_matrix"] for frame in meta["frames"]], np.float64)  # [V, 4, 4]
    middle = np.median(poses[:, :3, 3], axis=0)
    distance, extent = np.abs(middle).max(), np.ptp(poses[:, :3, 3], axis=0).max()
    if method == "none" and distance > 1000 * extent:
        raise InputError("--center-method none leaves the cameras where float32 rounds their places: leave it out.")
    middle *= method != "none" and distance > _FAR * extent
    for frame, pose in zip(meta["frames"], poses, strict=True):
        pose[:3, 3] -= middle
        frame["transform_matrix"] = pose
    applied = np.array(meta.get("applied_transform", np.eye(3, 4)), np.float64)
    return np.stack([middle, np.linalg.pinv(applied[:, :3]) @ middle])


def _undo_centring(outputs: DataparserOutputs, middle: NDArray[np.float64]) -> DataparserOutputs:
    """Return outputs whose transform maps the data of before a translation [3], in float64 if there was one."""
    if middle.any():
        found = Similarity.of(outputs.dataparser_transform.double().numpy())
        linear = found.scale * found.orthogonal
        outputs.dataparser_transform = torch.from_numpy(np.c_[linear, found.translation - linear @ middle])
    return outputs


def _move_to_fixed_frame(outputs: DataparserOutputs, meta: dict[str, Any], path: Path) -> None:
    """Move a parser's cameras and points to the frame that the content of a `transforms.json` fixes, if it does."""
    if (fixed := fixed_frame(meta, path)) is None:
        return
    chosen = Similarity.of(outputs.dataparser_scale * outputs.dataparser_transform.double().numpy())
    cameras, metadata = outputs.cameras, outputs.metadata
    poses = fixed.poses(chosen.inverse().poses(cameras.camera_to_worlds.double().numpy()))
    cameras.camera_to_worlds = torch.from_numpy(poses).float()
    if "points3D_xyz" in metadata:
        points = metadata["points3D_xyz"].double().numpy()
        metadata["points3D_xyz"] = torch.from_numpy(fixed.positions(chosen.inverse().positions(points))).float()
    outputs.dataparser_transform = torch.tensor(meta[FRAME_KEYS[0]], dtype=outputs.dataparser_transform.dtype)
    outputs.dataparser_scale = float(meta[FRAME_KEYS[1]])


def points_in_the_run(
    positions: NDArray[np.floating], colors: NDArray[np.uint8], transform: Tensor, scale: float
) -> dict[str, Tensor]:
    """Return points [P, 3] and their colours in 0 … 255 [P, 3] as nerfstudio's metadata hold them in the run's frame.

    The transform [3, 4] maps the data's frame to the run's; the scale is applied after it.
    """
    with np.errstate(over="ignore"):  # Numbers beyond float32 become infinite, and are left out later.
        positions = positions.astype(np.float32)
    homogeneous = torch.from_numpy(np.pad(positions, ((0, 0), (0, 1)), constant_values=1))
    return {"points3D_xyz": homogeneous @ transform.T * scale, "points3D_rgb": torch.from_numpy(colors)}
