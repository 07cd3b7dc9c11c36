"""Positions that lie too far from the others to measure anything by them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

REACH = 30.0
"""A position this many times as far out as most others is an outlier. In the captures on which this was tried, the
farthest SfM point is 2 to 9 times as far out as 99 % of them, the farthest camera at most 1.4 times as 90 %."""
POINT_SHARE = 0.99
"""Share of the SfM points that tells how far out a point usually lies."""
CAMERA_SHARE = 0.9
"""Share of the cameras that tells how far out a camera usually lies."""

FEWEST_PLACES = 3
"""Places of SfM points from which a run starts; fewer span no plane, and a splat that starts there shows next to
nothing."""


def has_enough_places(
    positions: NDArray[np.floating],  # [P, 3]
) -> bool:
    """Tell whether the finite ones of positions lie in `FEWEST_PLACES` or more different places."""
    remaining = positions[np.isfinite(positions).all(axis=-1)]
    for _ in range(FEWEST_PLACES):
        if len(remaining) == 0:
            return False
        is_elsewhere = (remaining != remaining[0]).any(axis=-1)
        remaining = remaining[is_elsewhere]
    return True


def far_outliers(
    positions: NDArray[np.floating],  # [P, 3]
    share: float,
) -> NDArray[np.bool_]:
    """Tell which positions are not finite, or more than `REACH` times as far from the median as most. bool [P]

    Of fewer than four positions, or if most coincide, only those that are not finite are outliers. The share, in
    (0, 1), of the positions tells how far out is usual; it leaves out at least one of them.
    """
    outliers = ~np.isfinite(positions).all(axis=-1)
    if (~outliers).sum() < 4:
        return outliers
    sound = positions[~outliers].astype(np.float64)
    with np.errstate(over="ignore"):  # Squares of numbers that are nearly infinite overflow.
        from_median = sound - np.median(sound, axis=0)
        distances = np.linalg.norm(from_median, axis=-1)
    last = len(sound) - 1
    rank = int(share * last)
    usual = np.partition(distances, rank)[rank]
    if usual > 0:
        outliers[~outliers] = distances > REACH * usual
    return outliers
