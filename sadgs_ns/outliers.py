"""Which of some positions lie so far from the others that nothing should be measured by them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

REACH = 30.0
"""A position that is this many times as far out as most of the others is an outlier.
In the captures that this was tried on, the farthest SfM point is 2 to 9 times as far out as 99 % of the points, and the
farthest camera at most 1.4 times as far out as 90 % of the cameras."""

POINT_SHARE = 0.99
"""The part of the SfM points that tells how far out a point usually lies."""
CAMERA_SHARE = 0.9
"""The part of the cameras that tells how far out a camera usually lies."""


def far_outliers(positions: NDArray[np.floating], share: float) -> NDArray[np.bool_]:
    """Which positions are not finite, or lie more than `REACH` times as far from the median as most of them. bool [P]

    Of fewer than four positions, and where most of them coincide, only those are that are not finite.

    Args:
        positions: Points or camera centres in any unit. [P, 3]
        share: The part of the positions, in (0, 1), that tells how far out is usual. At least one is never part of it,
            so that a single wild position is found among as few as four.
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
