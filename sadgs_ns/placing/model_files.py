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

IMAGES = "images.bin"
"""Name of the file of poses and keypoints."""
POINTS = "points3D.bin"
"""Name of the file of points."""
_COUNT_BYTES = 8  # A file begins with the number of its images or points.
_CAMERA_OFFSET = 60  # The number of an image's camera lies here in the image, after its own number and its pose.
_NAME_OFFSET = 64  # An image's name follows, with a zero byte at its end, then the number of its keypoints.
_POINT_BYTES = 51  # A point in points3D.bin, without its track
_TRACK_ELEMENT_BYTES = 8  # An observation of a point in points3D.bin
_KEYPOINT = np.dtype([("xy", "<f8", 2), ("point3D_id", "<i8")])


def check_written(folder: Path, model: pycolmap.Reconstruction) -> None:
    """Raise OSError if the files of a model are shorter than its content; COLMAP does not say that a disk is full.

    COLMAP must not read the files to check them. In a file that is cut off it takes wrong bytes for a length, and asks
    for that much memory. Images and points are nearly all of a model, and are written after its cameras and rigs.
    """
    images_size = _COUNT_BYTES
    for image in model.images.values():
        if image.has_pose:
            name_bytes = len(image.name.encode()) + 1
            images_size += _NAME_OFFSET + name_bytes + _COUNT_BYTES + _KEYPOINT.itemsize * image.num_points2D()
    points_size = _COUNT_BYTES + _POINT_BYTES * model.num_points3D()
    points_size += _TRACK_ELEMENT_BYTES * model.compute_num_observations()
    for name, size in ((IMAGES, images_size), (POINTS, points_size)):
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
    path = folder / IMAGES
    content = np.fromfile(path, np.uint8)
    position = _COUNT_BYTES
    for _ in range(_number_at(content, 0)):
        camera_id = int(content[position + _CAMERA_OFFSET : position + _NAME_OFFSET].view("<u4")[0])
        position += _NAME_OFFSET
        while content[position] != 0:
            position += 1
        position += 1
        count = _number_at(content, position)
        position += _COUNT_BYTES
        end = position + count * _KEYPOINT.itemsize
        keypoints = content[position:end].view(_KEYPOINT)
        if count > 0:
            keypoints["xy"] = _seen_by(before[camera_id], after[camera_id], keypoints["xy"])
        position = end
    path.write_bytes(content.data)


def _number_at(content: NDArray[np.uint8], position: int) -> int:
    """Return the number of eight bytes at a position."""
    return int(content[position : position + _COUNT_BYTES].view("<u8")[0])


def _seen_by(
    before: pycolmap.Camera,
    after: pycolmap.Camera,
    places: NDArray[np.float64],  # px [K, 2]
) -> NDArray[np.float64]:
    """Return where a camera sees what another one in its place sees at these places. px [K, 2]"""
    rays = np.asarray(before.cam_from_img(np.ascontiguousarray(places)))[:, :2]
    points = np.c_[rays, np.ones(len(rays))]  # At depth 1 before the camera. [K, 3]
    return np.asarray(after.img_from_cam(points))
