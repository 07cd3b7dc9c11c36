"""Judges whether a model of cameras and points can be right.

Photos without parallax, or by lenses that the camera model does not fit, may all register and still give a wrong model.
Sound captures keep far from the limits below. Ten real ones have angles of view of 35 to 79°, focal lengths that differ
by at most 8 %, 116 points or more in the median photo, 5° or more between two rays to the median point, and shifts of
1.4 % or more; fourteen have tilts of 7.5° or less. Two placings of those that few points hold together differ by at
most 1.7 %. Of photos by a camera that turns on the spot, COLMAP often makes a model with large angles between rays, but
too narrow a view; the shift alone tells it.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np
import pycolmap

from sadgs_ns.data.level import LARGEST_TILT, tilt

_SHARE = 0.2  # Share of the photos whose angle of view must be impossible, because single photos do little harm
_POINTS = 2000  # Least number of points that parallax is measured at, spread over all; twice as many at most
_SHARED_POINTS = 10  # Least number of those that two photos must show to be compared
_PAIRS = 60  # Most pairs of photos that are compared, spread over all
_PAIR_QUANTILE = 0.75  # Some pairs were taken in one place in sound captures, too, as brackets are
_FOCAL_FACTORS = np.geomspace(0.8, 2.5, 15)
"""Factors of the tangents of angles of view. Models of a camera that turned had views narrower by up to 1.9. With much
narrower ones than the model's, turning would explain flat ground, seen from straight above, too."""


@dataclasses.dataclass(frozen=True)
class Measures:
    """What a model is judged by; NaN for what is not known, which no criterion holds against it."""

    widest: float  # Angle of view in degrees, along the side where it is larger, that a fifth of the photos reach
    narrowest: float  # The same, along the side where it is smaller: a fifth of the photos have no more
    stretch: float  # Quotient of the larger focal length of a camera and the smaller one, of the median photo
    observations: float  # Points that the median photo shows
    parallax: float  # Largest angle in degrees between two rays to a point, of the median point
    shift: float  # What turning leaves unexplained of the way of points between photos, as a share of the longer side
    tilt: float = math.nan  # How far photos are turned about their viewing axes, in degrees, as of `level.tilt`
    disagreement: float = math.nan
    """How far points move between two placings of the photos with other samples, as a share of the longer side. The two
    are the most alike of up to three; NaN if there is one."""


@dataclasses.dataclass(frozen=True)
class Criterion:
    """The limits of a measure, and the reason to give beyond them."""

    measure: str  # Field of `Measures`
    doubtful: float
    wrong: float  # Lies beyond `doubtful`, above or below it
    reason: Callable[[float], str]  # Given the measure, the part of a sentence that names the problem and the remedy

    def is_beyond(self, value: float, limit: float) -> bool:
        """Return whether a value is on the bad side of a limit."""
        if self.wrong > self.doubtful:
            return value > limit
        return value < limit


_MOVE = "take a step to the side between photos"
_FISHEYE = "make panoramas of 2:1 or flat photos of fisheye ones"


def _wide(angle: float) -> str:
    return f"they would see {angle:.0f}° across, more than a lens does: {_MOVE}, and {_FISHEYE}"


def _narrow(angle: float) -> str:
    return f"they would see {angle:.2g}° across, less than a lens does: zoom less, {_MOVE}, and {_FISHEYE}"


def _stretched(quotient: float) -> str:
    return f"their focal lengths across and down would differ by a factor of {quotient:.1f}: {_MOVE}, and {_FISHEYE}"


def _few_points(count: float) -> str:
    advice = "take sharp photos of things with texture, with two thirds of overlap"
    return f"half of the photos show at most {count:.0f} points: {advice}"


def _flat(angle: float) -> str:
    return f"half of the points are seen from directions within {angle:.1f}° of each other: {_MOVE}"


def _turned(shift: float) -> str:
    return f"the photos look as if the camera had turned on the spot, to {100 * shift:.2f} % of their size: {_MOVE}"


def _tilted(angle: float) -> str:
    problem = (
        f"the camera would have been tilted to all sides, by {angle:.0f}°, as if parts of the scene were turned over"
    )
    advice = "take photos that show both sides of what looks alike from two, or go on if you held it so"
    return f"{problem}: {advice}"


def _unlike(share: float) -> str:
    problem = "few points hold the photos together, and placed again with other random samples"
    return f"{problem} they move by {100 * share:.2g} % of a photo's size: take more photos in between"


CRITERIA = (
    Criterion("widest", 120.0, 130.0, _wide),
    Criterion("narrowest", 6.0, 2.0, _narrow),
    Criterion("stretch", 1.25, 2.2, _stretched),
    Criterion("observations", 40.0, 15.0, _few_points),
    Criterion("parallax", 2.5, 1.8, _flat),
    Criterion("shift", 0.004, 0.0025, _turned),
    Criterion("tilt", LARGEST_TILT, math.inf, _tilted),
    Criterion("disagreement", 0.02, 0.05, _unlike),
)
"""What a model is judged by. A circular fisheye of 200° comes out at 120°. Anamorphic lenses squeeze pictures by two at
most. COLMAP drops points that are seen within 1.5°, so a median little above it says that most points were dropped."""


@dataclasses.dataclass(frozen=True)
class Judgement:
    """Why the cameras of a model may be wrong, and why they are.

    Each reason names the problem and the remedy, and goes on after "the cameras are wrong, because".
    """

    doubts: list[str]
    faults: list[str]

    @property
    def is_sound(self) -> bool:
        """Whether nothing speaks against the model."""
        return not self.doubts and not self.faults


def judge(measures: Measures) -> Judgement:
    """Return the reasons for which a model may be or is wrong."""
    doubts = []
    faults = []
    for criterion in CRITERIA:
        value = getattr(measures, criterion.measure)
        if criterion.is_beyond(value, criterion.wrong):
            faults.append(criterion.reason(value))
        elif criterion.is_beyond(value, criterion.doubtful):
            doubts.append(criterion.reason(value))
    return Judgement(doubts, faults)


def measure(model: pycolmap.Reconstruction) -> Measures:
    """Measure a model with at least one photo that has a pose."""
    images = [model.images[image_id] for image_id in model.reg_image_ids()]
    cameras = [model.cameras[image.camera_id] for image in images]
    angles = [_angles_of_view(camera) for camera in cameras]
    stretches = [_stretch(camera) for camera in cameras]
    counts = [image.num_points3D for image in images]
    observations = float(np.median(counts))
    if not any(counts) and model.num_points3D():  # Its tracks were removed, as in scenes to download.
        observations = math.nan
    point_ids = sorted(model.points3D)
    step = max(1, len(point_ids) // _POINTS)
    points = [model.points3D[point_id] for point_id in point_ids[::step]]
    return Measures(
        widest=float(np.quantile([max(pair) for pair in angles], 1 - _SHARE, method="higher")),
        narrowest=float(np.quantile([min(pair) for pair in angles], _SHARE, method="lower")),
        stretch=float(np.median(stretches)),
        observations=observations,
        parallax=_median_parallax(points, images),
        shift=_shift(points, images, cameras),
        tilt=tilt(np.stack([image.cam_from_world().rotation.matrix() for image in images])),
    )


def _angles_of_view(camera: pycolmap.Camera) -> tuple[float, float]:
    """Return the angles of view of a camera across and down, in degrees, without its distortion."""
    across = 2 * math.degrees(math.atan(0.5 * camera.width / camera.focal_length_x))
    down = 2 * math.degrees(math.atan(0.5 * camera.height / camera.focal_length_y))
    return across, down


def _stretch(camera: pycolmap.Camera) -> float:
    """Return the quotient of the larger focal length and the smaller one."""
    quotient = camera.focal_length_x / camera.focal_length_y
    return max(quotient, 1 / quotient)


def _median_parallax(points: Sequence[pycolmap.Point3D], images: Sequence[pycolmap.Image]) -> float:
    """Return the median parallax of points in degrees, NaN without tracks.

    The parallax of a point is the largest angle between the rays of two cameras that see it.
    """
    centres = {image.image_id: image.projection_center() for image in images}
    parallaxes = []
    for point in points:
        seen_from = [centres[element.image_id] for element in point.track.elements]
        if len(seen_from) > 1:
            rays = np.stack(seen_from) - point.xyz
            rays /= np.linalg.norm(rays, axis=1, keepdims=True)
            smallest_cosine = np.clip((rays @ rays.T).min(), -1.0, 1.0)
            parallaxes.append(math.degrees(math.acos(smallest_cosine)))
    if not parallaxes:
        return math.nan
    return float(np.median(parallaxes))


def _shift(
    points: Sequence[pycolmap.Point3D], images: Sequence[pycolmap.Image], cameras: Sequence[pycolmap.Camera]
) -> float:
    """Return how far points lie from where turned photos would show them, as a share of a photo's longer side.

    For each pair of photos it is the median of their common points after the rotation that fits them best. The angle of
    view, which all pairs share, is the one that fits best, because the model's own may be wrong. NaN without pairs.

    Args:
        points: Points of the model.
        images: Its photos.
        cameras: The camera of each photo.
    """
    places = _places(points, images, cameras)
    is_seen = ~np.isnan(places[..., 0])
    common = is_seen.astype(np.float32) @ is_seen.T.astype(np.float32)  # Numbers of points. [I, I]
    first, second = np.nonzero(np.triu(common >= _SHARED_POINTS, 1))
    if len(first) == 0:
        return math.nan
    chosen = np.unique(np.linspace(0, len(first) - 1, _PAIRS).astype(int))
    shifts = []
    for i, j in zip(first[chosen], second[chosen], strict=True):
        in_both = is_seen[i] & is_seen[j]
        camera = cameras[i]
        focal_length = camera.mean_focal_length() / max(camera.width, camera.height)
        shifts.append(focal_length * _shifts_of_pair(places[i, in_both], places[j, in_both]))
    return float(np.quantile(shifts, _PAIR_QUANTILE, axis=0).min())


def _places(
    points: Sequence[pycolmap.Point3D], images: Sequence[pycolmap.Image], cameras: Sequence[pycolmap.Camera]
) -> np.ndarray:
    """Return the places of P points in I images, in focal lengths from the principal point. [I, P, 2]

    A point has NaN in an image that does not show it. The places are not undistorted, since the distortion of a wrong
    model may be as wrong as its focal lengths.

    Args:
        points: Points of the model.
        images: Its photos, all that its points are seen in.
        cameras: The camera of each photo.
    """
    places = np.full((len(images), len(points), 2), np.nan, np.float32)
    rows = {image.image_id: i for i, image in enumerate(images)}
    for column, point in enumerate(points):
        for element in point.track.elements:
            row = rows[element.image_id]
            places[row, column] = images[row].points2D[element.point2D_idx].xy
    for i, camera in enumerate(cameras):
        places[i] -= (camera.principal_point_x, camera.principal_point_y)
        places[i] /= (camera.focal_length_x, camera.focal_length_y)
    return places


def _shifts_of_pair(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the shifts of a pair of photos in focal lengths, for each of F `_FOCAL_FACTORS`. [F]

    Args:
        one: Places of N points in one photo, in focal lengths. [N, 2]
        other: Their places in the other photo. [N, 2]
    """
    from_one = _rays(one)
    from_other = _rays(other)
    left, _, right = np.linalg.svd(from_other.transpose(0, 2, 1) @ from_one)  # Kabsch's algorithm. [F, 3, 3]
    left[:, :, 2] *= np.linalg.det(left @ right)[:, None]  # Not a reflection.
    turned = from_one @ (left @ right).transpose(0, 2, 1)
    return np.median(np.linalg.norm(from_other - turned, axis=2), axis=1) / _FOCAL_FACTORS


def _rays(places: np.ndarray) -> np.ndarray:
    """Return unit rays through N places [N, 2] in a photo, for each of F `_FOCAL_FACTORS`. [F, N, 3]"""
    rays = np.ones((len(_FOCAL_FACTORS), len(places), 3))
    rays[..., :2] = _FOCAL_FACTORS[:, None, None] * places
    return rays / np.linalg.norm(rays, axis=2, keepdims=True)
