"""Readers of a `transforms.json`, as `ns-process-data` writes it, and of a synthetic scene in the layout of NeRF's."""

from __future__ import annotations

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
_FILES = ("file_path", "mask_path", "depth_file_path")  # Keys with which a frame names files
_LENS, PINHOLE = (*DISTORTION, "distortion_params"), ("fl_x", "fl_y", "cx", "cy", "w", "h")
APPLIED_TRANSFORM = [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]
"""The map [3, 4] from COLMAP's world to that of the poses of older ns-process-data, which wrote no such map."""
PERSPECTIVE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")


def read_transforms(path: Path) -> dict[str, Any]:
    """Return a `transforms.json` for nerfstudio's parser, in which each frame has all values that it shares.

    A frame's own values come first. Raise InputError as `read_json` and `frames_of`, for wrong angles or mixed models.
    """
    meta, models = read_json(path), set()
    frames = [frame | _completed(frame, meta, path) for frame in frames_of(meta, path)]
    for values in ({**meta, **frame} for frame in frames):
        fisheye, model = bool(values.get("is_fisheye")), str(values.get("camera_model", "OPENCV"))
        models.add("OPENCV" + fisheye * "_FISHEYE" if model in PERSPECTIVE else model)
    if len(models) > 1:
        mixed = " and ".join(sorted(models))
        raise InputError(f"{path} mixes the camera models {mixed}: keep the frames of one of them.")
    meta = {name: meta[name] for name in meta if name not in (*PINHOLE, *_LENS)}
    if (path.parent / COLMAP_FOLDERS[0]).exists():
        meta.setdefault("applied_transform", APPLIED_TRANSFORM)
    return {**meta, "camera_model": models.pop(), "frames": frames}


def _completed(frame: dict[str, Any], meta: dict[str, Any], path: Path) -> dict[str, Any]:
    """Return the frame's intrinsics, derived from shared values, angles or the image, and its files' mended names."""
    where = f"{path}: frame {frame['file_path']}"
    files = {n: mended_name(path.parent, frame[n]) for n in _FILES if n in frame}
    has_focal = not frame.keys().isdisjoint(("fl_x", "camera_angle_x"))  # Then no shared one is of this frame.
    values = {n: meta[n] for n in meta if not (has_focal and n.startswith(("fl_", "camera_angle_")))} | frame
    if not values.keys() >= {"w", "h"} and any(size := images.image_size(path.parent / files["file_path"])):
        values = {"w": size[0], "h": size[1], **values}
    for side, focal, center, angle in (("w", "fl_x", "cx", "camera_angle_x"), ("h", "fl_y", "cy", "camera_angle_y")):
        if side in values:
            values.setdefault(center, finite(values[side], side, where) / 2)
            if focal not in values and angle in values:
                values[focal] = focal_length(values, values[side], angle, where)
    if "fl_x" in values:
        values.setdefault("fl_y", values["fl_x"])
    lens = frame if any(name in frame for name in _LENS) else meta
    return {n: values[n] for n in PINHOLE if n in values} | {n: lens[n] for n in _LENS if n in lens} | files


def mended_name(folder: Path, name: str) -> str:
    """Return the name of a file in a folder that lacks its suffix or was written with backslashes, as it is there."""
    names = (
        start + suffix for start in (name, name.replace("\\", "/")) for suffix in ("", *sorted(images.IMAGE_SUFFIXES))
    )
    return next((found for found in names if (folder / found).is_file()), name)


def focal_length(values: dict[str, Any], side: float, angle: str, where: str) -> float:
    """Return the focal length in px of a named angle of view over a side in px; raise InputError if it is no angle."""
    check_positive(values, where, [angle])
    if not values[angle] < math.pi:
        raise InputError(f"{where} has {angle} = {values[angle]:g}, which is no angle of view in radians: correct it.")
    return 0.5 * side / math.tan(0.5 * values[angle])


def read_blender(path: Path) -> dict[str, Any]:
    """Return a Blender scene's file, or that of the tests if validation has none, without the .png that is added."""
    tests = path.with_name("transforms_test.json")
    meta = read_json(tests if path.name == "transforms_val.json" and tests.exists() and not path.exists() else path)
    for frame in frames_of(meta, path):
        if not (path.parent / f"{frame['file_path']}.png").exists():
            frame["file_path"] = frame["file_path"].removesuffix(".png")
    return meta


def blender_images(frames: Sequence[dict[str, Any]], data: Path) -> list[Path]:
    """Return the images of a Blender scene's frames as `read_blender` returns them."""
    return [data / (frame["file_path"].replace("./", "") + ".png") for frame in frames]


def matrix_of(value: Any, rows: int) -> NDArray[np.float64] | None:
    """Return numbers in JSON as a matrix [rows, 4]; None if they are none."""
    try:
        matrix = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return None
    return matrix if matrix.shape == (rows, 4) else None


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
    if not isinstance(frames := meta.get("frames"), list) or not frames:
        raise InputError(f"{path} lists no frames, so there is no image to train on: {GIVE_POSES}.")
    for number, frame in enumerate(frames):
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
            raise InputError(f"{path}: frame {number} has no file_path: give it one, or remove the frame.")
        where = f"{path}: frame {frame['file_path']}"
        if (pose := matrix_of(frame.get("transform_matrix"), 4)) is None:
            raise InputError(f"{where} has no pose of 4 × 4 numbers: give it a transform_matrix, or remove the frame.")
        if not np.isfinite(pose).all():
            raise InputError(f"{where} has NaN or infinity in its pose: remove the frame, or compute the poses again.")
        if np.abs(pose[3] - [0, 0, 0, 1]).max() > 1e-6:
            raise InputError(f"{where} has a last row in its pose that is not 0 0 0 1: transpose it, or correct it.")
        for name in _FILES:
            if not isinstance(value := frame.get(name, ""), str) or "\0" in value:
                raise InputError(f"{path}: frame {number} has a {name} that no file can have: correct or remove it.")
    return frames


def view_of(frame: dict[str, Any], where: str, camera: Camera, image: Path | None) -> View:
    """Return the view of a frame that `frames_of` found good."""
    pose = np.array(frame["transform_matrix"], dtype=np.float64)
    rotation = (pose[:3, :3] * [1, -1, -1]).T  # The axes become OpenCV's.
    return View(where, where, rotation, pose[:3, 3], camera, image)


def camera_of(values: dict[str, Any], model: str, where: str) -> Camera:
    """Return the camera of good values; raise InputError for a distortion that nerfstudio does not support."""
    pinhole = (int(values["w"]), int(values["h"]), *(values[name] for name in PINHOLE[:4]))
    listed = values.get("distortion_params", [values.get(name, 0.0) for name in DISTORTION])
    if not isinstance(listed, list) or len(listed) not in (6, 12):  # FISHEYE624 has 12.
        named = f"distortion_params that are no list of 6 numbers ({', '.join(DISTORTION)})"
        raise InputError(f"{where} has {named}: correct or remove them.")
    k1, k2, k3, k4, p1, p2 = (finite(value, name, where) for value, name in zip(listed, DISTORTION, strict=False))
    if model == "FISHEYE624":
        if not any((k1, k2, k3, k4, p1, p2)):
            raise InputError(f"{where} is a fisheye {NO_COEFFICIENTS}")
        return Camera(*pinhole, fisheye=True)  # Its coefficients mean something else.
    if model == "OPENCV_FISHEYE":
        return Camera(*pinhole, radial=(k1, k2, k3, k4), fisheye=True)
    if k4 != 0:
        raise InputError(f"{where} has k4 = {k4:g}, which nerfstudio cannot undo: undistort the images yourself.")
    return Camera(*pinhole, radial=(k1, k2, k3), tangential=(p1, p2))
