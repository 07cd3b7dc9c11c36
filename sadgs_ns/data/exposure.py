"""How much the exposure of photos varies: by what the cameras wrote into them, or by how bright they show a thing.

Where EXIF is lacking, SfM points are looked up in the photos, and their brightness is explained by one number for each
point and one for each photo, its exposure. Tracks would say which photo shows which point, but parsers do not keep them
and many captures come without. Points that others hide, coarsely, and those that have another colour than SfM gave
them are left out instead, and of what remains outliers count little.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

Array = NDArray[np.float64]

MOST_VIEWS = 48
"""Photos that are opened, evenly spread over the capture, where EXIF does not tell."""
LEAST_STOPS = 0.2
"""Standard deviation of photos' exposures, in stops, from which exposure is said to vary."""
_MOST_POINTS, _MOST_OBSERVED = 200_000, 6_000
"""SfM points that can hide others, and those of them whose brightness is looked up."""
_SIDE = 800
"""Longest side in px to which JPEG files are decoded, at least; others are decoded whole."""
_NEAR = 1.1
"""A point is taken for hidden if it is so many times as far from the camera as the nearest one around it."""
_SAME_COLOR = 0.3
"""Largest difference in stops of each channel's share between an observation and its SfM point."""
_DARKEST, _BRIGHTEST = 0.004, 250
"""Linear light under which, and sRGB's byte from which, a pixel says nothing about exposure."""
_LEAST_VIEWS, _LEAST_OBSERVATIONS = 3, 30
"""Photos that a point must be seen in, and points that a photo must see, to count."""
_EXIF, _TIME, _F_NUMBER, _ISO = 0x8769, 33434, 33437, 34855
"""Numbers of EXIF's tags."""


@dataclass(frozen=True)
class Exposures:
    """Relative exposures of photos."""

    stops: Array
    """log2 of the light that the same thing has in each photo, of mean 0; NaN for a photo that says nothing. [V]"""
    unexplained: float
    """Standard deviation, in stops, of what exposures do not explain of the brightness of points; 0 by EXIF."""
    source: Literal["EXIF", "pixels"]
    """What they were read from."""

    @property
    def range(self) -> float:
        """Difference between the 95th and the 5th percentile, in stops."""
        low, high = np.nanpercentile(self.stops, [5, 95])
        return float(high - low)

    @property
    def varies(self) -> bool:
        """Whether they differ, and that explains more of the brightness of points than it leaves unexplained."""
        return bool(np.nanstd(self.stops) >= max(LEAST_STOPS, self.unexplained))


@dataclass(frozen=True)
class PinholeViews:
    """Cameras of photos, and where the photos are."""

    files: Sequence[Path]
    """The photos. V of them"""
    world_to_camera: Array
    """Poses; x is right, y is down, z is forward. [V, 3, 4]"""
    intrinsics: Array
    """fx, fy, cx and cy as shares of the width, the height, the width and the height. [V, 4]"""
    distortion: Array
    """k1, k2, k3, k4, p1 and p2 of OpenCV's polynomial model, of which k4 is not read. [V, 6]"""


def exposures(views: PinholeViews, points: Array, colors: NDArray[np.uint8]) -> Exposures | None:
    """Find out how much the exposure of photos varies, by EXIF where all of them have it, else by their pixels.

    Args:
        views: The photos.
        points: SfM points in world units. [P, 3]
        colors: Their colours in 0 … 255. [P, 3]

    Returns:
        Exposures of all photos by EXIF, or of up to `MOST_VIEWS` by pixels; None where neither tells.
    """
    if (stops := exif_stops(views.files)) is not None:
        return Exposures(stops, 0.0, "EXIF")
    chosen = np.unique(np.linspace(0, len(views.files) - 1, min(len(views.files), MOST_VIEWS)).round().astype(int))
    every = -(-len(points) // _MOST_POINTS) or 1
    points, colors = points[::every], colors[::every]
    observed = np.arange(0, len(points), -(-len(points) // _MOST_OBSERVED) or 1)
    with ThreadPoolExecutor() as pool:  # Most of the time images are decoded, for which Python does not wait.
        columns = list(pool.map(lambda view: _light_of_points(views, int(view), points, colors, observed), chosen))
    found = relative_stops(np.stack(columns, axis=1)) if columns else None
    return None if found is None else Exposures(*found, "pixels")


def exif_stops(files: Sequence[Path]) -> Array | None:
    """Return log2 of exposure time × ISO / aperture number² of photos, less the mean [V]; None where one lacks it."""
    stops = []
    for file in files:
        try:
            with Image.open(file) as image:
                tags = image.getexif().get_ifd(_EXIF)
            time, aperture, iso = (np.ravel(tags[tag])[0] for tag in (_TIME, _F_NUMBER, _ISO))
            stops.append(math.log2(float(time) * float(iso) / float(aperture) ** 2))
        except (OSError, KeyError, IndexError, TypeError, ValueError, ZeroDivisionError, SyntaxError):
            return None
    if not stops or not np.isfinite(stops).all():
        return None
    return np.array(stops) - np.mean(stops)


def relative_stops(light: Array) -> tuple[Array, float] | None:
    """Explain the brightness of points in photos by one number a point and one a photo, by robust least squares.

    Args:
        light: log2 of the linear light of each point in each photo, NaN where it is not seen. [P, V]

    Returns:
        Relative exposures of the photos in stops, of mean 0, NaN for photos that see too few points [V], and the
        standard deviation of what they leave unexplained; None where too few photos have something in common.
    """
    seen = np.isfinite(light)
    for _ in range(2):  # Leaving out photos may leave points that too few others see.
        seen &= seen.sum(axis=1, keepdims=True) >= _LEAST_VIEWS
        seen &= seen.sum(axis=0, keepdims=True) >= _LEAST_OBSERVATIONS
    views = seen.any(axis=0)
    if views.sum() < _LEAST_VIEWS:
        return None
    seen, values = seen[:, views], np.where(seen, light, 0.0)[:, views]
    weights, stops, sigma = seen.astype(float), np.zeros(values.shape[1]), 0.0
    for _ in range(20):
        # Without the points, which the photos' exposures determine, as many equations remain as there are photos.
        of_points = np.maximum(weights.sum(axis=1), 1e-9)
        matrix = np.diag(weights.sum(axis=0)) - weights.T @ (weights / of_points[:, None])
        right = (weights * values).sum(axis=0) - weights.T @ ((weights * values).sum(axis=1) / of_points)
        stops = np.linalg.lstsq(matrix, right, rcond=1e-9)[0]
        stops -= stops.mean()
        levels = (weights * (values - stops)).sum(axis=1) / of_points
        residuals = values - stops - levels[:, None]
        sigma = float(1.4826 * np.median(np.abs(residuals[seen])))
        weights = np.where(seen, 1 / (1 + np.square(residuals / (2 * max(sigma, 0.02)))), 0.0)  # Cauchy's
    result = np.full(len(views), np.nan)
    result[views] = stops
    return result, sigma


def _light_of_points(
    views: PinholeViews, view: int, points: Array, colors: NDArray[np.uint8], observed: NDArray[np.int_]
) -> Array:
    """Return log2 of the linear light that a photo shows of the observed points, NaN where it does not. [O]"""
    light = np.full(len(observed), np.nan)
    try:
        with Image.open(views.files[view]) as image:
            image.draft("RGB", (_SIDE, _SIDE))
            pixels = np.asarray(image.convert("RGB"))  # [H, W, 3]
    except (OSError, UnidentifiedImageError, ValueError, SyntaxError, Image.DecompressionBombError):
        return light  # Training will say what is wrong with the file.
    x, y, visible = _project(views, view, points)
    visible = visible[observed]
    shown = observed[visible]
    height, width, _ = pixels.shape
    column, row = (x[shown] * width).astype(int), (y[shown] * height).astype(int)
    window = np.zeros((len(shown), 3))
    saturated = np.zeros(len(shown), bool)
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            part = pixels[np.clip(row + down, 0, height - 1), np.clip(column + right, 0, width - 1)]  # [O', 3]
            window += linear_light(part / 255.0) / 9
            saturated |= (part >= _BRIGHTEST).any(axis=1)
    stops = np.log2(np.maximum(window, 1e-6))  # [O', 3]
    expected = np.log2(np.maximum(linear_light(colors[shown] / 255.0), 1e-6))
    shares = (stops - stops.mean(axis=1, keepdims=True)) - (expected - expected.mean(axis=1, keepdims=True))
    usable = ~saturated & (window.min(axis=1) > _DARKEST) & (np.abs(shares).max(axis=1, initial=0) < _SAME_COLOR)
    light[np.flatnonzero(visible)[usable]] = stops[usable].mean(axis=1)
    return light


def _project(views: PinholeViews, view: int, points: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return where a photo shows points, as shares of its width and height, and whether it does; [P] each."""
    pose, (fx, fy, cx, cy) = views.world_to_camera[view], views.intrinsics[view]
    k1, k2, k3, _, p1, p2 = views.distortion[view]
    camera = points @ pose[:, :3].T + pose[:, 3]  # [P, 3]
    depth = camera[:, 2]
    with np.errstate(all="ignore"):
        u, v = camera[:, 0] / depth, camera[:, 1] / depth
        r2 = u * u + v * v
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        x = fx * (u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u)) + cx
        y = fy * (v * radial + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v) + cy
        inside = (depth > 0) & (x >= 0) & (x < 1) & (y >= 0) & (y < 1)
    indices = np.flatnonzero(inside)
    # In a grid with about four points a cell, the nearest of a cell and those around it hide what is farther.
    cells = int(np.clip(np.sqrt(len(indices) / 4), 4, 64))
    column, row = (x[indices] * cells).astype(int), (y[indices] * cells).astype(int)
    nearest = np.full((cells + 2, cells + 2), np.inf)
    np.minimum.at(nearest, (row + 1, column + 1), depth[indices])
    around = np.min([nearest[i : i + cells, j : j + cells] for i in range(3) for j in range(3)], axis=0)
    inside[indices] = depth[indices] < _NEAR * around[row, column]
    return x, y, inside


def linear_light(values: Array) -> Array:
    """Return the linear light in [0, 1] that sRGB's values in [0, 1] stand for."""
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def srgb_values(light: Array) -> Array:
    """Return sRGB's values in [0, 1] of linear light in [0, 1]; the inverse of `linear_light`."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 0.0031308) ** (1 / 2.4) - 0.055)
