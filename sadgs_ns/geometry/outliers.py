"""Positions that lie too far from the others to measure anything by them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

REACH = 30.0
"""A position this many times as far out as most others is an outlier. In the captures on which this was tried, the
farthest SfM point is 2 to 9 times as far out as 99 % of them, the farthest camera at most 1.4 times as 90 %."""
POINT_SHARE = 0.99  # Share of the SfM points that tells how far out one usually lies
CAMERA_SHARE = 0.9  # The same of cameras


def far_outliers(positions: NDArray[np.floating], share: float) -> NDArray[np.bool_]:
    """Return which positions are not finite, or more than `REACH` times as far from the median as most. [P, 3] → [P]

    Of fewer than four positions, or if most coincide, only those that are not finite are outliers. The share, in
    (0, 1), of the positions tells how far out is usual; it leaves out at least one of them.
    """
    outliers = ~np.isfinite(positions).all(axis=-1)
    if (~outliers).sum() < 4:
        return outliers
    sound = positions[~outliers].astype(np.float64)
    with np.errstate(over="ignore"):  # squares of numbers that are nearly infinite
        distances = np.linalg.norm(sound - np.median(sound, axis=0), axis=-1)
    usual = np.partition(distances, rank := int(share * (len(sound) - 1)))[rank]
    if usual > 0:
        outliers[~outliers] = distances > REACH * usual
    return outliers
