"""Panoramas of 2:1, which show all directions, and the pinhole views that they are cut into."""

from __future__ import annotations

import re
from functools import lru_cache

import numpy as np
from PIL import Image

VIEWS = 8
"""Views of a panorama: four above the horizon, and four below it that look between those. A view of 90° × 90° has a
quarter of the panorama's width, so nearly as many pixels as the panorama has there."""
_VIEW_NAME = re.compile(r"(.+\.[a-z]\w{2,3})/[0-7]\.(jpg|png)", re.IGNORECASE)
"""Name of a panorama's view, which lies in a folder that is called as the photo, as `Photo.views` names it."""
_PITCH = 22.5
"""Degrees above and below the horizon. The views show latitudes up to 60°, and none over 68°, where a tripod is."""

_CIRCLE = 128  # Side in px to which each half of a photo is reduced to look for circles
_MOST_UNEVEN = 0.02  # Largest difference between the width and twice the height, as a share of the width
_DARK = 40  # Largest value of what is outside of a circle; flares reach beyond its rim
_OUTSIDE = 1.2  # Radius outside of all lenses' circles, in halves of the height: the corners
_RIM = (0.7, 0.9)  # Radii inside of all lenses' circles, near their rim
_MOST = 0.95  # Least share of what is outside that is dark
_LEAST_BRIGHT = 0.4  # Least share of the rim that is not


def rotations() -> np.ndarray:
    """Return the rotations from a view's axes (x right, y down, z forward) to those of its panorama. [VIEWS, 3, 3]"""
    import cv2  # Most photos need it not, and it takes time to import.

    def turn(pitch: float, yaw: float) -> np.ndarray:
        return cv2.Rodrigues(np.array([pitch, yaw, 0.0]))[0]

    angles = np.radians([(90 * i, _PITCH) for i in range(4)] + [(90 * i + 45, -_PITCH) for i in range(4)])
    return np.stack([turn(0, yaw) @ turn(pitch, 0) for yaw, pitch in angles])


def photo_of(view: str) -> str:
    """Return the name that all views of a panorama share, given that of one; the name of another image is its own."""
    found = _VIEW_NAME.fullmatch(view)
    if found is None:
        return view
    return found[1]


def is_panorama(image: Image.Image, size: tuple[int, int]) -> bool:
    """Return whether a photo of this size in px, loaded with 512 px across or more, shows all directions.

    XMP says so, or its ends meet and its poles are even. The ends of two circles that are not stitched yet are black.
    """
    if size[0] != 2 * size[1] or b"equirectangular" in image.info.get("xmp", b""):
        return size[0] == 2 * size[1]  # Others are parts of a panorama.
    small = np.asarray(image.convert("L").resize((256, 128), Image.Resampling.BOX), float)
    seam = np.abs(small[:, 0] - small[:, -1]).mean()
    steps = np.abs(np.diff(small, axis=1))
    poles = steps[[0, -1]].mean(1).max()  # Each is one point.
    return bool(max(seam / 3, 4 * poles) < steps.mean() and small[:, 0].std() > 0.1 * small.std())


def is_fisheye_pair(image: Image.Image, size: tuple[int, int]) -> bool:
    """Return whether a photo of this size in px shows two fisheye circles side by side, as 360° cameras store them.

    Nearly all outside of the two circles is dark, and most along their rims is not. Of a panorama by night, whose sky
    and floor are dark, the rims are dark, too.
    """
    width, height = size
    if abs(width - 2 * height) > _MOST_UNEVEN * width:
        return False
    small = image.convert("L").resize((2 * _CIRCLE, _CIRCLE), Image.Resampling.BOX)
    halves = np.asarray(small).reshape(_CIRCLE, 2, _CIRCLE)
    across = (np.arange(_CIRCLE) + 0.5) / _CIRCLE * 2 - 1
    radius = np.hypot(*np.meshgrid(across, across))  # 1 at the middle of a half's edges [_CIRCLE, _CIRCLE]
    is_dark = (halves <= _DARK).transpose(1, 0, 2)
    outside = is_dark[:, radius > _OUTSIDE].mean(axis=1)
    rim = is_dark[:, (radius > _RIM[0]) & (radius < _RIM[1])].mean(axis=1)
    return bool(outside.min() > _MOST and rim.max() < 1 - _LEAST_BRIGHT)


def cut(panorama: Image.Image) -> list[Image.Image]:
    """Cut a panorama into its `VIEWS`, squares of half its height."""
    import cv2

    pixels = np.asarray(panorama)
    border = cv2.BORDER_WRAP
    maps = [map_of_view(i, panorama.height) for i in range(VIEWS)]
    return [Image.fromarray(cv2.remap(pixels, *places, cv2.INTER_CUBIC, borderMode=border)) for places in maps]


@lru_cache(VIEWS)
def map_of_view(view: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Return x and y in a panorama of a height in px, in OpenCV's px, of the pixels of a view. [H/2, H/2] each"""
    side = height // 2
    across = (np.arange(side) + 0.5) / side * 2 - 1  # The tangents of angles up to 45° from the view's axis
    rays = np.stack([*np.meshgrid(across, across), np.ones((side, side))], -1) @ rotations()[view].T
    x, y, z = np.moveaxis(rays.astype(np.float32), -1, 0)
    columns = 1 + np.arctan2(x, z) / np.pi
    rows = 0.5 + np.arctan2(y, np.hypot(x, z)) / np.pi
    return columns * height - 0.5, rows * height - 0.5
