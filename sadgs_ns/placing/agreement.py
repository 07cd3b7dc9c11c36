"""How far models of the same photos differ, and which of several to trust, without knowing where the photos were taken.

Models by other random samples are compared by their common points, which are known by their observations.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

Array = NDArray[np.float64]
Observation = tuple[str, int]  # A photo's name, and the index of one of its features
_LEAST_SHARED = 2  # Observations that a point of two models has in both at least
_LEAST_FITTED = 3  # Points that a similarity can be fitted to
_LEAST_POINTS = 10  # Common points that a photo must show to be compared
_FITS = 5  # Fits of a similarity, each without the points that lie far off by the one before
_FAR = 3.0  # Distance from which a point is far off, in medians of all; points far away are uncertain
_PLACINGS = 3  # How often photos are placed at most
_AGREEMENT = 0.02
"""Disagreement up to which two models agree. Sound ones of lund differ by up to .012, those of
other captures with as few observations by up to .017, and two of lund whose last seven photos were misplaced by .13."""
_AS_MANY = 0.9  # Share of the first model's photos that a model must have to replace it


@dataclass(frozen=True)
class Displacement:
    """How far common points move between two models, as seen through the cameras of both, in px."""

    mean: float  # Over photos, of the mean over points
    worst: float  # Of the photo where it is largest
    worst_view: str  # Name of that photo
    points: int  # Number of common points


@dataclass(frozen=True)
class Observed:
    """A model, with the point of each observation in the photos that have a pose."""

    model: pycolmap.Reconstruction
    points: dict[Observation, int]

    @classmethod
    def of(cls, model: pycolmap.Reconstruction) -> Observed:
        """Read the points of a model's observations."""
        points: dict[Observation, int] = {}
        names = {image_id: model.images[image_id].name for image_id in model.reg_image_ids()}
        for point_id, point in model.points3D.items():
            for element in point.track.elements:
                points[names[element.image_id], element.point2D_idx] = point_id
        return cls(model, points)


def common_points(one: dict[Observation, int], other: dict[Observation, int]) -> list[tuple[int, int]]:
    """Return the points of two models that are the same, in pairs: each shares the most observations with the other.

    The arguments are the `points` of `Observed`.
    """
    shared = Counter((point, other[observation]) for observation, point in one.items() if observation in other)
    # Of equal counts the first in order decides.
    order = sorted(shared, key=lambda pair: (-shared[pair], pair))
    best_of_one: dict[int, int] = {}
    best_of_other: dict[int, int] = {}
    for first, second in order:
        best_of_one.setdefault(first, second)
        best_of_other.setdefault(second, first)
    pairs = []
    for first, second in order:
        is_mutual = best_of_one[first] == second and best_of_other[second] == first
        if is_mutual and shared[first, second] >= _LEAST_SHARED:
            pairs.append((first, second))
    return pairs


def align(points: Array, targets: Array) -> pycolmap.Sim3d:
    """Return the similarity that brings N points [N, 3] onto their targets [N, 3], but for those that are far off.

    Raises ValueError if there is none, as of fewer than three points.
    """
    similarity = _fit(points, targets)
    for _ in range(_FITS - 1):
        distances = np.linalg.norm(similarity * points - targets, axis=1)
        kept = distances <= _FAR * np.median(distances)
        similarity = _fit(points[kept], targets[kept])
    return similarity


def _fit(points: Array, targets: Array) -> pycolmap.Sim3d:
    """Return the similarity that brings points onto their targets with the least squares; raise ValueError if none."""
    similarity = None
    if len(points) >= _LEAST_FITTED:
        similarity = pycolmap.estimate_sim3d(points, targets)
    if similarity is None:
        raise ValueError("two models have too few points in common, or these lie on a line: they cannot be compared.")
    return similarity


def displacement(one: Observed, other: Observed) -> Displacement:
    """Compare two models by the displacement of their common points in the photos of both.

    A point of a model is projected by the camera of a photo that shows it, and by the other model's camera of that
    photo, after the similarity that brings the models' common points onto each other. Raises ValueError if the models
    have too little in common.
    """
    pairs = common_points(one.points, other.points)
    swapped = [(second, first) for first, second in pairs]
    found = _displacements(one, other, pairs) + _displacements(other, one, swapped)
    if not found:
        raise ValueError("two models have no photo in common that shows enough of their common points.")
    worst, worst_view = max(found)
    mean = np.mean([value for value, _ in found])
    return Displacement(float(mean), worst, worst_view, len(pairs))


def disagreement(one: pycolmap.Reconstruction, other: pycolmap.Reconstruction) -> float:
    """Return how far common points move between two models, as a share of the longer side of the median photo.

    It is 1, the most that there is, for models that have too little in common.
    """
    try:
        moved = displacement(Observed.of(one), Observed.of(other)).mean
    except ValueError:
        return 1.0
    sides = [_longer_side(image) for image in _photos(one).values()]
    return min(1.0, moved / float(np.median(sides)))


def most_agreed(
    first: pycolmap.Reconstruction,
    place_again: Callable[[int], pycolmap.Reconstruction | None],
    rank: Callable[[pycolmap.Reconstruction], tuple[bool, int]],
) -> tuple[pycolmap.Reconstruction, float]:
    """Return the model that another placing of the photos confirms best, and the disagreement of the two.

    If a second model disagrees with the first one, there is a third, and the two that are most alike count. The
    disagreement is NaN if the photos could not be placed again.

    Args:
        first: The model to confirm.
        place_again: Makes another, given its number from 1 on.
        rank: Returns whether a model can be right, and how many photos it registered.
    """
    models = [first]
    agreed = first
    moved = math.nan
    is_possible, registered = rank(first)
    least = (is_possible, math.ceil(_AS_MANY * registered))
    for number in range(1, _PLACINGS):
        other = place_again(number)
        if other is None:
            continue
        for model in models:
            difference = disagreement(model, other)
            better = model
            if (rank(other), other.compute_num_observations()) > (rank(model), model.compute_num_observations()):
                better = other
            is_closer = math.isnan(moved) or difference < moved
            if is_closer and rank(better) >= least:
                agreed = better
                moved = difference
        models.append(other)
        if moved <= _AGREEMENT:
            break
    return agreed, moved


def _displacements(one: Observed, other: Observed, pairs: list[tuple[int, int]]) -> list[tuple[float, str]]:
    """Return the mean displacement in px of one model's points in each photo that has a pose in both, with its name."""
    points = np.array([one.model.points3D[first].xyz for first, _ in pairs]).reshape(-1, 3)
    targets = np.array([other.model.points3D[second].xyz for _, second in pairs]).reshape(-1, 3)
    moved = align(points, targets) * points
    row_of_point = {first: row for row, (first, _) in enumerate(pairs)}
    rows_of_photo: dict[str, list[int]] = {}
    for (name, _), point in one.points.items():
        if point in row_of_point:
            rows_of_photo.setdefault(name, []).append(row_of_point[point])
    photos = _photos(one.model)
    others = _photos(other.model)
    found = []
    for name in sorted(photos.keys() & others.keys()):
        rows = rows_of_photo.get(name, [])
        if len(rows) >= _LEAST_POINTS:
            seen = project(photos[name], points[rows])
            seen_by_other = project(others[name], moved[rows])
            distances = np.linalg.norm(seen - seen_by_other, axis=1)
            side = _longer_side(photos[name])
            # Points behind a camera, and near its plane, count as if they moved across the photo.
            distances = np.minimum(np.nan_to_num(distances, nan=side), side)
            found.append((float(distances.mean()), name))
    return found


def _photos(model: pycolmap.Reconstruction) -> dict[str, pycolmap.Image]:
    """Return the photos that have a pose, by their names."""
    return {model.images[image_id].name: model.images[image_id] for image_id in model.reg_image_ids()}


def _longer_side(image: pycolmap.Image) -> int:
    """Return the longer side of a photo in px."""
    assert image.camera is not None
    return max(image.camera.width, image.camera.height)


def project(image: pycolmap.Image, points: Array) -> Array:
    """Return the places of N points [N, 3] in a photo in px, NaN behind its camera. [N, 2]"""
    assert image.camera is not None
    return np.asarray(image.camera.img_from_cam(image.cam_from_world() * points))
