"""Which points and cameras of a capture count, and how far its cameras reach."""

from __future__ import annotations

import torch
from torch import Tensor

from sadgs_ns.geometry.outliers import CAMERA_SHARE, POINT_SHARE, far_outliers


def plausible_points(
    points: Tensor,  # [P, 3]
    share: float = POINT_SHARE,
) -> Tensor:
    """Tell which SfM points, or cameras, count: all but `outliers.far_outliers` with this share. bool [P]"""
    outliers = far_outliers(points.detach().cpu().numpy(), share)
    return ~torch.from_numpy(outliers).to(points.device)


def camera_extent(
    positions: Tensor,  # [C, 3]
) -> float:
    """The extent of cameras in world units, > 0: 1.1 times the largest distance from their centre (3DGS).

    Cameras that lie absurdly far from the others (`outliers.far_outliers`) do not count. It is 1 where all coincide.
    """
    positions = positions[plausible_points(positions, CAMERA_SHARE)]
    from_centre = positions - positions.mean(0)
    extent = 1.1 * float(from_centre.norm(dim=-1).max())
    if extent > 0:
        return extent
    return 1.0
