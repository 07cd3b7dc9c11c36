"""The frame of a run: how a parser's poses and points are moved into it without rounding them coarsely."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from numpy.typing import NDArray
from torch import Tensor

from sadgs_ns.data.coordinates import FRAME_KEYS, Similarity, fixed_frame
from sadgs_ns.errors import InputError
from sadgs_ns.geometry.outliers import has_enough_places

POINTS_FILE = "points3D_file"
"""Key of a parser's metadata: the file of a COLMAP reconstruction from which all its points were read, in its order."""
_FAR = 10.0  # Poses that lie farther than this from the origin are centred, in extents of the poses.
_TOO_FAR = 1000.0  # Poses that lie farther than this from the origin are coarse in float32, in extents of the poses.


class Centring(NamedTuple):
    """The translation by which the poses of a capture were moved to the origin before nerfstudio parses them."""

    of_poses: NDArray[np.float64]  # In the frame of the poses, to be subtracted from positions. [3]
    of_data: NDArray[np.float64]  # The same in the frame of the data. [3]


def centre_poses(meta: Mapping[str, Any], method: str) -> Centring:
    """Move the poses of frames to the origin if all are far from it, as in a map's coordinates, or else leave them.

    Without this nerfstudio would round such poses to float32 before it centres them. They also stay if `method`, the
    parser's `center_method`, is "none". Raise InputError if the cameras are then so far away that float32 is too
    coarse.
    """
    poses = np.array([frame["transform_matrix"] for frame in meta["frames"]], np.float64)  # [V, 4, 4]
    middle = np.median(poses[:, :3, 3], axis=0)  # [3]
    distance = np.abs(middle).max()
    extent = np.ptp(poses[:, :3, 3], axis=0).max()
    if method == "none" and distance > _TOO_FAR * extent:
        raise InputError("--center-method none leaves the cameras where float32 rounds their places: leave it out.")
    if method == "none" or distance <= _FAR * extent:
        middle = np.zeros(3)
    for frame, pose in zip(meta["frames"], poses, strict=True):
        pose[:3, 3] -= middle
        frame["transform_matrix"] = pose
    applied = np.array(meta.get("applied_transform", np.eye(3, 4)), np.float64)
    return Centring(middle, np.linalg.pinv(applied[:, :3]) @ middle)


def undo_centring(outputs: DataparserOutputs, middle: NDArray[np.float64]) -> None:
    """Make the outputs' transform one of the data as they were before a translation by −`middle` [3].

    It is in float64 if there was such a translation.
    """
    if not middle.any():
        return
    of_centred = Similarity.of(outputs.dataparser_transform.double().numpy())
    linear = of_centred.scale * of_centred.orthogonal  # [3, 3]
    translation = of_centred.translation - linear @ middle
    outputs.dataparser_transform = torch.from_numpy(np.column_stack([linear, translation]))


def move_to_fixed_frame(outputs: DataparserOutputs, meta: dict[str, Any], path: Path) -> None:
    """Move a parser's cameras and points to the frame that the content of a `transforms.json` fixes, if it does."""
    fixed = fixed_frame(meta, path)
    if fixed is None:
        return
    chosen = Similarity.of(outputs.dataparser_scale * outputs.dataparser_transform.double().numpy())
    to_data = chosen.inverse()
    cameras = outputs.cameras
    poses = to_data.poses(cameras.camera_to_worlds.double().numpy())
    cameras.camera_to_worlds = torch.from_numpy(fixed.poses(poses)).float()
    metadata = outputs.metadata
    if "points3D_xyz" in metadata:
        points = to_data.positions(metadata["points3D_xyz"].double().numpy())
        metadata["points3D_xyz"] = torch.from_numpy(fixed.positions(points)).float()
    transform, scale = (meta[key] for key in FRAME_KEYS)
    outputs.dataparser_transform = torch.tensor(transform, dtype=outputs.dataparser_transform.dtype)
    outputs.dataparser_scale = float(scale)


def points_in_the_run(
    positions: NDArray[np.floating], colors: NDArray[np.uint8], transform: Tensor, scale: float
) -> dict[str, Tensor]:
    """Return points [P, 3] and their colours in 0 … 255 [P, 3] as nerfstudio's metadata hold them in the run's frame.

    Points in too few places are left out, so that the run starts as without points.

    The transform [3, 4] maps the data's frame to the run's; the scale is applied after it.
    """
    if not has_enough_places(positions):
        return {}
    with np.errstate(over="ignore"):  # Numbers beyond float32 become infinite, and are left out later.
        positions = positions.astype(np.float32)
    homogeneous = torch.from_numpy(np.pad(positions, ((0, 0), (0, 1)), constant_values=1))  # [P, 4]
    placed = homogeneous @ transform.T * scale  # [P, 3]
    return {"points3D_xyz": placed, "points3D_rgb": torch.from_numpy(colors)}
