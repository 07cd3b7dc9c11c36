"""How well a model of photos fits observations that it has not seen.

Observations that were left out of an adjustment are compared with where they should be.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pycolmap

from sadgs_ns.placing.agreement import Array, project

_LEFT_OUT = 0.1  # Share of the observations that are left out
_LONG_TRACK = 4  # Least number of observations of a point from which one is left out


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
            projected = project(model.images[image_id], points)
            found[rows] = np.linalg.norm(projected - left_out.places[rows], axis=1)
    return found
