"""How level the cameras of a capture were held, which tells whether parts of its poses are joined wrongly.

Whoever takes photos holds the camera level, even when it looks up or down: the horizon is across the photo. So there is
one direction, that of gravity, to which the sides of all photos are nearly perpendicular. If two parts of a scene are
joined wrongly, as where two sides of a thing look alike, each part has a direction of its own.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

LARGEST_TILT = 13.0
"""Tilt in degrees from which poses are doubtful. Fifteen sets of poses of fourteen captures, by hand and by a drone,
have .5 to 7.5. One set, whose halves were joined with an angle of 88° between their directions of gravity, has 22.5."""
FEWEST_VIEWS = 8
"""Views from which the tilt is known: some direction is perpendicular to the sides of few photos anyway."""


def tilt(
    rotations: NDArray[np.float64],  # World to camera, x across the photo [V, 3, 3]
) -> float:
    """Return how far photos are turned about their viewing axes, in degrees, 0 to 35.3; NaN for too few or broken ones.

    It is the root mean square over views against the direction for which that is least.
    """
    across = rotations[:, 0]  # [V, 3]
    if len(across) < FEWEST_VIEWS or not np.isfinite(across).all():
        return math.nan
    squares = np.linalg.eigvalsh(across.T @ across / len(across))
    least = min(max(float(squares[0]), 0.0), 1.0)
    return math.degrees(math.asin(math.sqrt(least)))
