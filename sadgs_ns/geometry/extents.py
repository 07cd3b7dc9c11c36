"""Which points and cameras of a capture count, and how far its cameras reach."""

from __future__ import annotations

import torch
from torch import Tensor

from sadgs_ns.geometry.outliers import CAMERA_SHARE, POINT_SHARE, far_outliers


def plausible_points(points: Tensor, share: float = POINT_SHARE) -> Tensor:
    """Tell which SfM points, or cameras, count: all but `outliers.far_outliers` with this share. [P, 3] → bool [P]"""
    return ~torch.from_numpy(far_outliers(points.detach().cpu().numpy(), share)).to(points.device)


def camera_extent(positions: Tensor) -> float:
    """The extent of cameras at positions [C, 3]: 1.1 times the largest distance from their centre (3DGS).

    Cameras that lie absurdly far from the others (`outliers.far_outliers`) do not count. It is 1 where all coincide.
    """
    positions = positions[plausible_points(positions, CAMERA_SHARE)]
    extent = 1.1 * float((positions - positions.mean(0)).norm(dim=-1).max())
    return extent if extent > 0 else 1.0
