"""Cameras at their places, as readers of all layouts give them, and the numbers that describe a camera."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sadgs_ns.errors import InputError

NO_COEFFICIENTS = (
    "with all distortion coefficients 0, and nerfstudio undistorts no such image: undistort the images yourself, or "
    "give one coefficient a tiny value (k1 = 1e-9)."
)
"""The rest of a sentence about a fisheye camera."""


@dataclass(frozen=True)
class Camera:
    """Intrinsics of a camera, as all layouts give them."""

    width: int  # Size of the image in px
    height: int
    fx: float  # Focal lengths in px
    fy: float
    cx: float  # Distance of the principal point from the left and the upper edge in px
    cy: float
    radial: tuple[float, ...] = ()  # Coefficients k1, k2, … of OpenCV's polynomial of the radius, or a fisheye's angle
    tangential: tuple[float, ...] = ()  # Coefficients p1, p2 as OpenCV defines them
    fisheye: bool = False


class View(NamedTuple):
    """A camera at its place."""

    where: str  # The start of a sentence about its pose: file and image
    where_camera: str  # The start of a sentence about its camera
    rotation: NDArray[np.float64]  # Rotation from world to camera, in OpenCV's axes. [3, 3]
    centre: NDArray[np.float64]  # Position of the camera in world units. [3]
    camera: Camera
    image: Path | None = None  # None if it shall not be opened


def check_positive(values: Mapping[str, Any], where: str, names: Sequence[str]) -> None:
    """Raise InputError unless the named values are finite numbers, sizes whole and all but the centre positive."""
    for name in names:
        if name not in values:
            raise InputError(f"{where} has no {name}: give it one, for all frames or this one.")
        value = finite(values[name], name, where)
        if name not in ("cx", "cy") and value <= 0:
            raise InputError(f"{where} has {name} = {value}, which must be positive: correct it.")
        if name in ("w", "h") and value != int(value):
            raise InputError(f"{where} has {name} = {value}, which is no whole number of pixels: correct it.")


def finite(value: Any, name: str, where: str) -> float:
    """Return a JSON value that is a finite number; raise InputError if it is not."""
    if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max:
        return value
    raise InputError(f"{where} has {name} = {value!r:.60}, which is no finite number: correct it.")
