"""Readers of a `transforms.json`, as `ns-process-data` writes it, and of a synthetic scene in the layout of NeRF's."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sadgs_ns.data import images
from sadgs_ns.data.layouts import COLMAP_FOLDERS
from sadgs_ns.data.text import read_text
from sadgs_ns.data.views import NO_COEFFICIENTS, Camera, View, check_positive, finite
from sadgs_ns.errors import InputError, reason

GIVE_POSES = "compute poses with `sadgs-process PHOTOS FOLDER` or `ns-process-data`"  # A remedy where there are none
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")  # nerfstudio's coefficients, in the order of its distortion_params
PINHOLE = ("fl_x", "fl_y", "cx", "cy", "w", "h")  # Keys of a camera without its lens
_LENS = (*DISTORTION, "distortion_params")
_FILES = ("file_path", "mask_path", "depth_file_path")  # Keys with which a frame names files
APPLIED_TRANSFORM = [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]
"""The map [3, 4] from COLMAP's world to that of the poses of older ns-process-data, which wrote no such map."""
PERSPECTIVE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")
"""Camera models that nerfstudio reads alike, by the coefficients that are given."""


def read_transforms(path: Path) -> dict[str, Any]:
    """Return a `transforms.json` in which each frame has all values that it shares with others.

    A frame's own values come first. Raise InputError as `read_json` and `frames_of`, for wrong angles or mixed models.
    """
    meta = read_json(path)
    frames = [frame | _complete(frame, meta, path) for frame in frames_of(meta, path)]
    models = {_camera_model(meta | frame) for frame in frames}
    if len(models) > 1:
        mixed = " and ".join(sorted(models))
        raise InputError(f"{path} mixes the camera models {mixed}: keep the frames of one of them.")
    content = {name: value for name, value in meta.items() if name not in (*PINHOLE, *_LENS)}
    content["camera_model"] = models.pop()
    content["frames"] = frames
    if (path.parent / COLMAP_FOLDERS[0]).exists():
        content.setdefault("applied_transform", APPLIED_TRANSFORM)
    return content


def _camera_model(values: dict[str, Any]) -> str:
    """Return the camera model of a frame, which is one for all perspective models, and one for their fisheyes."""
    model = str(values.get("camera_model", "OPENCV"))
    if model not in PERSPECTIVE:
        return model
    if values.get("is_fisheye"):
        return "OPENCV_FISHEYE"
    return "OPENCV"


def _complete(frame: dict[str, Any], meta: dict[str, Any], path: Path) -> dict[str, Any]:
    """Return a frame's intrinsics and the mended names of its files.

    Intrinsics that the frame lacks are derived from shared values, angles of view or the image.
    """
    where = f"{path}: frame {frame['file_path']}"
    files = {key: mended_name(path.parent, frame[key]) for key in _FILES if key in frame}
    values = _shared_values(frame, meta) | frame
    if "w" not in values or "h" not in values:
        width, height = images.image_size(path.parent / files["file_path"])
        if width or height:
            values = {"w": width, "h": height} | values
    for side, focal, center, angle in (("w", "fl_x", "cx", "camera_angle_x"), ("h", "fl_y", "cy", "camera_angle_y")):
        if side in values:
            middle = finite(values[side], side, where) / 2
            values.setdefault(center, middle)
            if focal not in values and angle in values:
                values[focal] = focal_length(values, values[side], angle, where)
    if "fl_x" in values:
        values.setdefault("fl_y", values["fl_x"])
    lens = meta
    if any(key in frame for key in _LENS):
        lens = frame
    intrinsics = {key: values[key] for key in PINHOLE if key in values}
    coefficients = {key: lens[key] for key in _LENS if key in lens}
    return intrinsics | coefficients | files


def _shared_values(frame: dict[str, Any], meta: dict[str, Any]) -> dict[str, Any]:
    """Return a file's values for a frame; a frame with a focal length or angle of its own takes no shared one."""
    if "fl_x" not in frame and "camera_angle_x" not in frame:
        return meta
    return {key: value for key, value in meta.items() if not key.startswith(("fl_", "camera_angle_"))}


def mended_name(folder: Path, name: str) -> str:
    """Return the name of a file in a folder as it is there, if it lacks its suffix or was written with backslashes."""
    for start in (name, name.replace("\\", "/")):
        for suffix in ("", *sorted(images.IMAGE_SUFFIXES)):
            candidate = f"{start}{suffix}"
            if (folder / candidate).is_file():
                return candidate
    return name


def focal_length(values: dict[str, Any], side: float, angle: str, where: str) -> float:
    """Return the focal length in px of a named angle of view over a side in px; raise InputError if it is no angle."""
    check_positive(values, where, [angle])
    if not values[angle] < math.pi:
        raise InputError(f"{where} has {angle} = {values[angle]:g}, which is no angle of view in radians: correct it.")
    return 0.5 * side / math.tan(0.5 * values[angle])


def read_blender(path: Path) -> dict[str, Any]:
    """Return the content of a Blender scene's file, whose frames name images without the .png that is added.

    The test views' file stands in for a missing one of validation. Raises as `read_json` and `frames_of`.
    """
    source = path
    tests = path.with_name("transforms_test.json")
    if path.name == "transforms_val.json" and tests.exists() and not path.exists():
        source = tests
    meta = read_json(source)
    for frame in frames_of(meta, path):
        if not (path.parent / f"{frame['file_path']}.png").exists():
            frame["file_path"] = frame["file_path"].removesuffix(".png")
    return meta


def blender_images(frames: Sequence[dict[str, Any]], data: Path) -> list[Path]:
    """Return the images of a Blender scene's frames, as `read_blender` returns them."""
    return [data / (frame["file_path"].replace("./", "") + ".png") for frame in frames]


def read_json(path: Path) -> dict[str, Any]:
    """Return the object that a file holds; raise InputError if it holds none in JSON and plain UTF-8."""
    try:
        meta = json.loads(read_text(path))
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"{path} does not exist: restore it, or {GIVE_POSES}.") from None
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path} is not readable JSON ({reason(error)}): restore it, or {GIVE_POSES}.") from error
    if not isinstance(meta, dict):
        raise InputError(f"{path} holds a {type(meta).__name__} instead of an object with frames: {GIVE_POSES}.")
    return meta


def frames_of(meta: dict[str, Any], path: Path) -> list[dict[str, Any]]:
    """Return the frames; raise InputError if there are none, or one has no usable file path and pose."""
    frames = meta.get("frames")
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path} lists no frames, so there is no image to train on: {GIVE_POSES}.")
    for number, frame in enumerate(frames):
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
            raise InputError(f"{path}: frame {number} has no file_path: give it one, or remove the frame.")
        _check_pose(frame, f"{path}: frame {frame['file_path']}")
        for key in _FILES:
            name = frame.get(key, "")
            if not isinstance(name, str) or "\0" in name:
                raise InputError(f"{path}: frame {number} has a {key} that no file can have: correct or remove it.")
    return frames


def _check_pose(frame: dict[str, Any], where: str) -> None:
    """Raise InputError if a frame has no pose, or one that makes no sense."""
    pose = matrix_of(frame.get("transform_matrix"), 4)
    if pose is None:
        raise InputError(f"{where} has no pose of 4 × 4 numbers: give it a transform_matrix, or remove the frame.")
    if not np.isfinite(pose).all():
        raise InputError(f"{where} has NaN or infinity in its pose: remove the frame, or compute the poses again.")
    if np.abs(pose[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise InputError(f"{where} has a last row in its pose that is not 0 0 0 1: transpose it, or correct it.")


def matrix_of(value: Any, rows: int) -> NDArray[np.float64] | None:
    """Return a value of JSON as a matrix [rows, 4]; None if it holds no such numbers."""
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return None
    if matrix.shape != (rows, 4):
        return None
    return matrix


def view_of(frame: dict[str, Any], where: str, camera: Camera, image: Path | None) -> View:
    """Return the view of a frame that `frames_of` found good."""
    pose = np.array(frame["transform_matrix"], dtype=np.float64)  # [4, 4]
    rotation = (pose[:3, :3] * [1, -1, -1]).T  # The axes become OpenCV's.
    return View(where, where, rotation, pose[:3, 3], camera, image)


def camera_of(values: dict[str, Any], model: str, where: str) -> Camera:
    """Return the camera of good values; raise InputError for a distortion that nerfstudio does not support."""
    width = int(values["w"])
    height = int(values["h"])
    fx, fy, cx, cy = (values[key] for key in PINHOLE[:4])
    pinhole = Camera(width, height, fx, fy, cx, cy)
    k1, k2, k3, k4, p1, p2 = _coefficients(values, where)
    if model == "FISHEYE624":
        if not any((k1, k2, k3, k4, p1, p2)):
            raise InputError(f"{where} is a fisheye {NO_COEFFICIENTS}")
        return dataclasses.replace(pinhole, fisheye=True)  # Its coefficients mean something else.
    if model == "OPENCV_FISHEYE":
        return dataclasses.replace(pinhole, radial=(k1, k2, k3, k4), fisheye=True)
    if k4 != 0:
        raise InputError(f"{where} has k4 = {k4:g}, which nerfstudio cannot undo: undistort the images yourself.")
    return dataclasses.replace(pinhole, radial=(k1, k2, k3), tangential=(p1, p2))


def _coefficients(values: dict[str, Any], where: str) -> list[float]:
    """Return the first 6 distortion coefficients of a camera, in nerfstudio's order, which are 0 by default."""
    listed = values.get("distortion_params", [values.get(name, 0.0) for name in DISTORTION])
    if not isinstance(listed, list) or len(listed) not in (6, 12):  # FISHEYE624 has 12.
        problem = f"{where} has distortion_params that are no list of 6 numbers ({', '.join(DISTORTION)})"
        raise InputError(f"{problem}: correct or remove them.")
    return [finite(value, name, where) for value, name in zip(listed, DISTORTION, strict=False)]
