"""A model's files as COLMAP writes them: whether they are whole, and where keypoints lie in them.

pycolmap hands out keypoints one at a time, 240,000 of them for 50 photos. Moving them in the file takes a fraction of
the time.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from sadgs_ns.data.colmap import KEYPOINT, find_keypoints

_IMAGES = "images.bin"
_POINTS = "points3D.bin"
_COUNT_BYTES = 8  # A file begins with the number of its images or points.
_IMAGE_BYTES = 73  # An image in images.bin, without the letters of its name and without its keypoints
_POINT_BYTES = 51  # A point in points3D.bin, without its track
_TRACK_ELEMENT_BYTES = 8  # An observation of a point in points3D.bin


def check_written(folder: Path, model: pycolmap.Reconstruction) -> None:
    """Raise OSError if the files of a model are shorter than its content; COLMAP does not say that a disk is full.

    COLMAP must not read the files to check them. In a file that is cut off it takes wrong bytes for a length, and asks
    for that much memory. Images and points are nearly all of a model, and are written after its cameras and rigs.
    """
    images_size = _COUNT_BYTES
    for image in model.images.values():
        if image.has_pose:
            images_size += _IMAGE_BYTES + len(image.name.encode()) + KEYPOINT.itemsize * image.num_points2D()
    points_size = _COUNT_BYTES + _POINT_BYTES * model.num_points3D()
    points_size += _TRACK_ELEMENT_BYTES * model.compute_num_observations()
    for name, size in ((_IMAGES, images_size), (_POINTS, points_size)):
        if (folder / name).stat().st_size < size:
            raise OSError(f"{folder} was not written completely: the disk is full")


def move_keypoints(folder: Path, before: Mapping[int, pycolmap.Camera], after: Mapping[int, pycolmap.Camera]) -> None:
    """Move the keypoints of a model's file to where cameras without distortion see them.

    Raises OSError if the file cannot be read or written.

    Args:
        folder: Holds the model, whole as `check_written` says.
        before: The cameras in which the keypoints lie, by their numbers.
        after: The cameras in which they shall lie.
    """
    path = folder / _IMAGES
    content = bytearray(path.read_bytes())
    for camera_id, start, count in find_keypoints(path):
        if count > 0:
            keypoints = np.frombuffer(content, KEYPOINT, count, start)
            keypoints["place"] = _seen_by(before[camera_id], after[camera_id], keypoints["place"])
    path.write_bytes(content)


def _seen_by(
    before: pycolmap.Camera,
    after: pycolmap.Camera,
    places: NDArray[np.float64],  # px [K, 2]
) -> NDArray[np.float64]:
    """Return where a camera sees what another one in its place sees at these places. px [K, 2]"""
    rays = np.asarray(before.cam_from_img(np.ascontiguousarray(places)))[:, :2]
    points = np.c_[rays, np.ones(len(rays))]  # At depth 1 before the camera. [K, 3]
    return np.asarray(after.img_from_cam(points))
