"""How accurately the cameras of models of the same photos are placed, without knowing where they were.

Models of one capture by other random samples are compared by their common points, which are known by their
observations. Within one model, observations that were left out of an adjustment are compared with where they should be.
"""

from __future__ import annotations

from collections import Counter
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
_LEFT_OUT = 0.1  # Share of the observations that are left out
_LONG_TRACK = 4  # Least number of observations of a point from which one is left out


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
        for image_id in model.reg_image_ids():
            image = model.images[image_id]
            for index, place in enumerate(image.points2D):
                if place.has_point3D():
                    points[image.name, index] = place.point3D_id
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
            seen = _project(photos[name], points[rows])
            seen_by_other = _project(others[name], moved[rows])
            distances = np.linalg.norm(seen - seen_by_other, axis=1)
            found.append((float(np.nanmean(distances)), name))
    return found


def _photos(model: pycolmap.Reconstruction) -> dict[str, pycolmap.Image]:
    """Return the photos that have a pose, by their names."""
    return {model.images[image_id].name: model.images[image_id] for image_id in model.reg_image_ids()}


def _project(image: pycolmap.Image, points: Array) -> Array:
    """Return the places of N points [N, 3] in a photo in px, NaN behind its camera. [N, 2]"""
    assert image.camera is not None
    return np.asarray(image.camera.img_from_cam(image.cam_from_world() * points))


@dataclass(frozen=True)
class LeftOut:
    """Observations that an adjustment does not see."""

    image_ids: list[int]
    point_ids: list[int]
    places: Array  # In px [N, 2]


def leave_out(model: pycolmap.Reconstruction, seed: int) -> LeftOut:
    """Delete a random tenth of the observations of points that have four or more, and return them.

    At least three observations of each point stay. The model is changed in place.
    """
    random = np.random.default_rng(seed)
    candidates = []
    for image_id in sorted(model.reg_image_ids()):
        for index, place in enumerate(model.images[image_id].points2D):
            if place.has_point3D() and model.points3D[place.point3D_id].track.length() >= _LONG_TRACK:
                candidates.append((image_id, index, place.point3D_id))
    chosen = random.permutation(len(candidates))[: round(_LEFT_OUT * len(candidates))]
    image_ids = []
    point_ids = []
    places = []
    for image_id, index, point_id in (candidates[i] for i in sorted(chosen)):
        if model.points3D[point_id].track.length() >= _LONG_TRACK:  # Others of the point may have been left out.
            image_ids.append(image_id)
            point_ids.append(point_id)
            places.append(np.array(model.images[image_id].points2D[index].xy))
            model.delete_observation(image_id, index)
    return LeftOut(image_ids, point_ids, np.array(places).reshape(-1, 2))


def reprojection_errors(model: pycolmap.Reconstruction, left_out: LeftOut) -> Array:
    """Return the distance in px of N observations from where a model sees their points, NaN if it has none. [N]"""
    found = np.full(len(left_out.places), np.nan)
    image_ids = np.array(left_out.image_ids)
    has_point = np.array([point_id in model.points3D for point_id in left_out.point_ids], bool)
    for image_id in model.reg_image_ids():
        rows = np.flatnonzero((image_ids == image_id) & has_point)
        if len(rows) > 0:
            points = np.array([model.points3D[left_out.point_ids[row]].xyz for row in rows])
            projected = _project(model.images[image_id], points)
            found[rows] = np.linalg.norm(projected - left_out.places[rows], axis=1)
    return found
