"""Checks of a `transforms.json`, as `ns-process-data` writes it, and of a synthetic scene in the layout of NeRF's."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sadgs_ns.data import colmap, images
from sadgs_ns.data.checks import geometry
from sadgs_ns.data.checks.findings import Finding, collect_findings, note, warning
from sadgs_ns.data.checks.images import check_images
from sadgs_ns.data.checks.layouts import GIVE_POSES, no_layout
from sadgs_ns.data.checks.splits import SPLITS, check_splits
from sadgs_ns.data.coordinates import fixed_frame
from sadgs_ns.data.layouts import COLMAP_FOLDERS, ParserOptions
from sadgs_ns.data.text import read_text
from sadgs_ns.errors import InputError, reason

_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")  # nerfstudio's coefficients, in the order of its distortion_params
_FILES = ("file_path", "mask_path", "depth_file_path")  # Keys with which a frame names files
_LENS, _PINHOLE = (*_DISTORTION, "distortion_params"), ("fl_x", "fl_y", "cx", "cy", "w", "h")
_APPLIED = [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]
"""The map [3, 4] from COLMAP's world to that of the poses of older ns-process-data, which wrote no such map."""
_PERSPECTIVE = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV")


@collect_findings
def check_nerfstudio(data: Path, options: ParserOptions, open_images: bool = True) -> Iterator[Finding]:
    """Check a `transforms.json`, or the one in a folder, and its images if asked."""
    path = data if data.suffix == ".json" else data / "transforms.json"
    if not path.is_file():
        raise InputError(no_layout(data))
    folder, meta = path.parent, read_transforms(path)
    described, model = meta["frames"], meta.get("camera_model", "OPENCV")
    if model not in (known := (*_PERSPECTIVE, "OPENCV_FISHEYE", "FISHEYE624")):
        raise InputError(f"{path} has the camera model {model!r}: give one of {', '.join(known)}.")
    _check_transform(meta, path)
    factor = _factor_of(described, folder, options) if open_images else options.downscale_factor or 1

    def locate(name: str, kind: str = "images") -> Path:
        return folder / (f"{kind}_{factor}/{Path(name).name}" if factor > 1 else name)  # Copies lie in one folder.

    frames, views = [], []
    for frame in described:
        where, mask = f"{path}: frame {frame['file_path']}", frame.get("mask_path")
        geometry.check_positive(frame, where, _PINHOLE)
        image = locate(frame["file_path"])
        size = images.scaled_size((int(frame["w"]), int(frame["h"])), factor, "floor")
        views.append(view_of(frame, where, _camera(frame, model, where), image if open_images else None))
        frames.append(images.Frame(image, size, None if mask is None else locate(mask, "masks")))
    for name, what in (("mask_path", "masks"), ("depth_file_path", "depths")):
        if 0 < (having := sum(name in frame for frame in described)) < len(frames):
            problem = f"{path} names {what} for {having} of {len(frames)} frames"
            raise InputError(f"{problem}: give all of them one, or none.")
    names = [frame["file_path"] for frame in described]
    lists = {split: meta[f"{split}_filenames"] for split in SPLITS if f"{split}_filenames" in meta}
    training = yield from check_splits(names, lists, lambda split: f"{path}: {split}_filenames", locate, options)
    sound = yield from geometry.check_views(views, training, path)
    if 3 <= training == len(frames) < 10:  # With more frames all are trained on only where that was asked for.
        yield note(f"{path} has {training} views, none of them held out: `ns-eval` cannot measure any.")
    if not any("mask_path" in frame for frame in described) and images.images_in(folder / "masks"):
        remedy = "name each as mask_path of its frame to leave out what is black in it"
        yield warning(f"{folder / 'masks'} holds masks that are not used, as {path} names none: {remedy}.")
    if open_images:
        yield from check_images(frames, path, look_for_unused=factor == 1)
    if options.load_3D_points:
        yield from _check_ply(meta, path, views if sound else [])


def _factor_of(described: Sequence[dict[str, Any]], folder: Path, options: ParserOptions) -> int:
    """Return the downscale factor of the frames' images to read; raise InputError if these or masks are missing."""
    first = folder / described[0]["file_path"]
    factor, copies = options.downscale_factor, lambda by: images.smaller_folder(folder / "images", by) / first.name
    if factor is None and not first.is_file() and (there := [by for by in (2, 4, 8) if copies(by).is_file()]):
        told = f"{first} does not exist, but {copies(there[0])} does"  # Some captures are shared smaller.
        raise InputError(f"{told}: end the command with `nerfstudio-data --downscale-factor {there[0]}`.")
    factor = factor or images.automatic_factor(first, copies)
    for kind, key in (("images", "file_path"), ("masks", "mask_path")):
        if factor > 1 and key in described[0] and not (where := images.smaller_folder(folder / kind, factor)).is_dir():
            told = f"{where} does not exist, which should hold the {kind} scaled down by {factor}: make it"
            scale = f"--pipeline.datamanager.camera-res-scale-factor {1 / factor:.4g}"
            raise InputError(f"{told}, or end the command with `{scale} nerfstudio-data --downscale-factor 1`.")
    return factor


@collect_findings
def check_blender(data: Path, options: ParserOptions, open_images: bool = True) -> Iterator[Finding]:
    """Check a synthetic scene in NeRF's layout, `transforms_train.json` and its siblings, and its images if asked."""
    for split in SPLITS:
        path = data / f"transforms_{split}.json"
        if split == "test" and not path.is_file():
            yield warning(f"{path} does not exist: `ns-eval` will have nothing to measure.")
            continue
        if split == "val" and not path.exists() and not path.with_name("transforms_test.json").exists():
            told = f"{path} does not exist, nor a transforms_test.json"
            raise InputError(f"{told}: rename transforms_train.json to transforms.json, and some views are held out.")
        described = (meta := read_blender(path))["frames"]
        if "time" in described[0] and split == "train":
            told = f"{path} gives each frame a time, as of a scene that moves, and all are trained as of one moment"
            yield warning(f"{told}: what moves will blur, so keep the frames of one time if you can.")
        paths = [data / (frame["file_path"].replace("./", "") + ".png") for frame in described]
        size = images.image_size(paths[0])  # The cameras have no size of their own.
        width, height = size if open_images and any(size) else (1, 1)  # The other checks need none.
        focal = _focal_length(meta, width, "camera_angle_x", str(path))
        taken = {"fl_x": focal, "fl_y": focal, "cx": width / 2, "cy": height / 2, **dict.fromkeys(_DISTORTION, 0)}
        for values in (meta, *described) if open_images and any(size) else ():
            for name, value in taken.items():
                if abs(geometry.finite(values.get(name, value), name, str(path)) - value) > 1e-3 * value:
                    raise InputError(f"{path}: of Blender scenes {name} is not read; rename it to transforms.json.")
        camera = geometry.Camera(width, height, focal, focal, width / 2, height / 2)
        views = [
            view_of(frame, f"{path}: frame {frame['file_path']}", camera, image if open_images else None)
            for frame, image in zip(described, paths, strict=True)
        ]
        if split == "train":
            sound = yield from geometry.check_views(views, len(views), path)
            distance = float(np.median([np.linalg.norm(view.centre) for view in views]))
            if options.ply_path is None and not 0.5 < distance < 25:
                told = f"{path} has cameras {distance:.3g} units from the origin, about which random points fill a cube"
                remedy = "rename it to transforms.json, whose cameras are centred and scaled"
                yield warning(f"{told} of side 10 as training starts: {remedy}.")
            if options.ply_path is not None:
                remedy = "restore it, or leave `--ply-path` out to start from random points"
                yield from geometry.check_ply(data / options.ply_path, views if sound else [], remedy)
        else:
            yield from geometry.check_rotations(views)
        if open_images:
            yield from check_images([images.Frame(image, size if any(size) else None) for image in paths], path)


def read_transforms(path: Path) -> dict[str, Any]:
    """Return a `transforms.json` for nerfstudio's parser, in which each frame has all values that it shares.

    A frame's own values come first. Raise InputError as `read_json` and `frames_of`, for wrong angles or mixed models.
    """
    meta, models = read_json(path), set()
    frames = [frame | _completed(frame, meta, path) for frame in frames_of(meta, path)]
    for values in ({**meta, **frame} for frame in frames):
        fisheye, model = bool(values.get("is_fisheye")), str(values.get("camera_model", "OPENCV"))
        models.add("OPENCV" + fisheye * "_FISHEYE" if model in _PERSPECTIVE else model)
    if len(models) > 1:
        mixed = " and ".join(sorted(models))
        raise InputError(f"{path} mixes the camera models {mixed}: keep the frames of one of them.")
    meta = {name: meta[name] for name in meta if name not in (*_PINHOLE, *_LENS)}
    if (path.parent / COLMAP_FOLDERS[0]).exists():
        meta.setdefault("applied_transform", _APPLIED)
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
            values.setdefault(center, geometry.finite(values[side], side, where) / 2)
            if focal not in values and angle in values:
                values[focal] = _focal_length(values, values[side], angle, where)
    if "fl_x" in values:
        values.setdefault("fl_y", values["fl_x"])
    lens = frame if any(name in frame for name in _LENS) else meta
    return {n: values[n] for n in _PINHOLE if n in values} | {n: lens[n] for n in _LENS if n in lens} | files


def mended_name(folder: Path, name: str) -> str:
    """Return the name of a file in a folder that lacks its suffix or was written with backslashes, as it is there."""
    names = (
        start + suffix for start in (name, name.replace("\\", "/")) for suffix in ("", *sorted(images.IMAGE_SUFFIXES))
    )
    return next((found for found in names if (folder / found).is_file()), name)


def _focal_length(values: dict[str, Any], side: float, angle: str, where: str) -> float:
    """Return the focal length in px of a named angle of view over a side in px; raise InputError if it is no angle."""
    geometry.check_positive(values, where, [angle])
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


def _check_transform(meta: dict[str, Any], path: Path) -> None:
    """Raise InputError if the settings of all poses together make no sense."""
    if (applied := _rows_of_four(meta.get("applied_transform", _APPLIED), 3)) is None or not np.isfinite(applied).all():
        raise InputError(f"{path} has an applied_transform that is not 3 × 4 finite numbers: correct or remove it.")
    if geometry.finite(meta.get("applied_scale", 1), "applied_scale", str(path)) != 1:
        told = f"{path} has applied_scale = {meta['applied_scale']}, by which nerfstudio moves points and no cameras"
        raise InputError(f"{told}: remove it.")
    fixed_frame(meta, path)
    if meta.get("fisheye_crop_radius") is not None:
        geometry.finite(meta["fisheye_crop_radius"], "fisheye_crop_radius", str(path))
    methods = ("pca", "up", "vertical", "none")
    if (method := meta.get("orientation_override", "none")) not in methods:
        raise InputError(f"{path} has orientation_override = {method!r}: give one of {', '.join(methods)}.")


def _rows_of_four(value: Any, rows: int) -> NDArray[np.float64] | None:
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
        if (pose := _rows_of_four(frame.get("transform_matrix"), 4)) is None:
            raise InputError(f"{where} has no pose of 4 × 4 numbers: give it a transform_matrix, or remove the frame.")
        if not np.isfinite(pose).all():
            raise InputError(f"{where} has NaN or infinity in its pose: remove the frame, or compute the poses again.")
        if np.abs(pose[3] - [0, 0, 0, 1]).max() > 1e-6:
            raise InputError(f"{where} has a last row in its pose that is not 0 0 0 1: transpose it, or correct it.")
        for name in _FILES:
            if not isinstance(value := frame.get(name, ""), str) or "\0" in value:
                raise InputError(f"{path}: frame {number} has a {name} that no file can have: correct or remove it.")
    return frames


def view_of(frame: dict[str, Any], where: str, camera: geometry.Camera, image: Path | None) -> geometry.View:
    """Return the view of a frame that `frames_of` found good."""
    pose = np.array(frame["transform_matrix"], dtype=np.float64)
    rotation = (pose[:3, :3] * [1, -1, -1]).T  # The axes become OpenCV's.
    return geometry.View(where, where, rotation, pose[:3, 3], camera, image)


def _camera(values: dict[str, Any], model: str, where: str) -> geometry.Camera:
    """Return the camera of good values; raise InputError for a distortion that nerfstudio does not support."""
    pinhole = (int(values["w"]), int(values["h"]), *(values[name] for name in _PINHOLE[:4]))
    listed = values.get("distortion_params", [values.get(name, 0.0) for name in _DISTORTION])
    if not isinstance(listed, list) or len(listed) not in (6, 12):  # FISHEYE624 has 12.
        named = f"distortion_params that are no list of 6 numbers ({', '.join(_DISTORTION)})"
        raise InputError(f"{where} has {named}: correct or remove them.")
    k1, k2, k3, k4, p1, p2 = (
        geometry.finite(value, name, where) for value, name in zip(listed, _DISTORTION, strict=False)
    )
    if model == "FISHEYE624":
        if not any((k1, k2, k3, k4, p1, p2)):
            raise InputError(f"{where} is a fisheye {geometry.NO_COEFFICIENTS}")
        return geometry.Camera(*pinhole, fisheye=True)  # Its coefficients mean something else.
    if model == "OPENCV_FISHEYE":
        return geometry.Camera(*pinhole, radial=(k1, k2, k3, k4), fisheye=True)
    if k4 != 0:
        raise InputError(f"{where} has k4 = {k4:g}, which nerfstudio cannot undo: undistort the images yourself.")
    return geometry.Camera(*pinhole, radial=(k1, k2, k3), tangential=(p1, p2))


def _check_ply(meta: dict[str, Any], path: Path, views: Sequence[geometry.View]) -> Iterator[Finding]:
    if "ply_file_path" in meta:
        remedy = f"restore it, or remove ply_file_path from {path} to start from random points"
        yield from geometry.check_ply(path.parent / str(meta["ply_file_path"]), views, remedy)
    elif (source := colmap.points_file(path.parent / COLMAP_FOLDERS[0])) is not None:
        (positions, colors), transform = colmap.read_points(source), np.array(meta["applied_transform"], float)
        points = positions @ transform[:, :3].T + transform[:, 3], colors
        random = "end the command with `nerfstudio-data --load-3D-points False` to start from random points"
        yield from geometry.check_points(points, views, source, f"run COLMAP's mapper again, or {random}")
    else:
        told = f"{path} has no ply_file_path: training will start from random points"
        found = min(path.parent.glob("*.ply"), default=None)
        yield warning(f"{told}, not from {found}, unless you name it there.") if found else note(f"{told}.")
