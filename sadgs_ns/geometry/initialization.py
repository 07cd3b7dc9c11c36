"""The Gaussians that training starts from: SfM points and the faces of their bounding box (paper, section 3.6)."""

from __future__ import annotations

import torch
from scipy.spatial import KDTree
from torch import Tensor

from sadgs_ns.geometry.outliers import CAMERA_SHARE, POINT_SHARE, far_outliers

FACE_GRID = 16
"""Points along each side of a face (released code)."""
FACE_OPACITY = 0.05
"""Initial opacity of the points on the faces (released code)."""
POINT_OPACITY = 0.1
"""Initial opacity of SfM points (3DGS)."""
FACE_GREY = 0.5
"""Colour of the points on the faces in [0, 1] (released code)."""


def bounding_box_points(points: Tensor, grid: int = FACE_GRID) -> tuple[Tensor, float]:
    """Make regular grids on the six faces of the axis-aligned bounding box of points [P, 3].

    Returns:
        6·grid² points [6·grid², 3], and the spacing that their scale starts from, mean box extent / grid, world units.
        Where the box is flat, faces coincide and every place has one point; a box without extent has no points.
    """
    low = points.amin(0)
    high = points.amax(0)
    if (low == high).all():
        return points[:0], 1.0
    ticks = (torch.arange(grid, device=points.device, dtype=points.dtype) + 0.5) / grid  # cell centres in (0, 1)
    square = torch.cartesian_prod(ticks, ticks)  # [grid², 2]
    faces = []
    for axis in range(3):
        for side in (0.0, 1.0):
            face = torch.cat([square[:, :axis], torch.full_like(square[:, :1], side), square[:, axis:]], dim=1)
            faces.append(low + face * (high - low))
    placed = torch.cat(faces)
    if (low == high).any():
        placed = placed.unique(dim=0)
    return placed, float((high - low).mean()) / grid


def neighbour_scales(points: Tensor) -> Tensor:
    """The initial scale, > 0, of points [P, 3]: the mean distance to the 3 nearest neighbours (3DGS, splatfacto). [P]

    It is at least a millionth of the cloud's extent, so as to have a logarithm. Raises ValueError if there is no point.
    """
    if len(points) == 0:
        raise ValueError("There are no points to start from: give SfM points, or set pipeline.model.random-init True.")
    extent = float((points.amax(0) - points.amin(0)).norm()) or 1.0
    k = min(3, len(points) - 1)
    if k < 1:
        return torch.full_like(points[:, 0], 0.01 * extent)
    array = points.detach().cpu().numpy()
    distances, _ = KDTree(array).query(array, k + 1, workers=-1)  # scikit-learn's takes half a second to import
    return torch.from_numpy(distances[:, 1:].mean(1)).to(points).clamp_min(1e-6 * extent)


def plausible_points(points: Tensor, share: float = POINT_SHARE) -> Tensor:
    """Tell which SfM points, or cameras, count: all but `outliers.far_outliers` with this share. [P, 3] → bool [P]"""
    return ~torch.from_numpy(far_outliers(points.detach().cpu().numpy(), share)).to(points.device)


def starting_points(
    points: Tensor,  # [P, 3]
    colors: Tensor,  # [P, 3]
    *,
    faces: bool,
    opacity: float = POINT_OPACITY,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The points that training starts from, with the scale and opacity of each; raises ValueError if there is no point.

    `faces` adds `bounding_box_points` to the given points with their colours in [0, 1]. Return points and colours,
    [N, 3] each, and scales in world units, > 0, and opacities, [N] each.
    """
    scales = neighbour_scales(points)
    opacities = torch.full((len(points),), opacity)
    if not faces:
        return points, colors, scales, opacities
    added, spacing = bounding_box_points(points)
    return (
        torch.cat([points, added]),
        torch.cat([colors, torch.full_like(added, FACE_GREY)]),
        torch.cat([scales, torch.full((len(added),), spacing)]),
        torch.cat([opacities, torch.full((len(added),), FACE_OPACITY)]),
    )


def camera_extent(positions: Tensor) -> float:
    """The extent of cameras at positions [C, 3]: 1.1 times the largest distance from their centre (3DGS).

    Cameras that lie absurdly far from the others (`outliers.far_outliers`) do not count. It is 1 where all coincide.
    """
    positions = positions[plausible_points(positions, CAMERA_SHARE)]
    extent = 1.1 * float((positions - positions.mean(0)).norm(dim=-1).max())
    return extent if extent > 0 else 1.0
