"""Checks of a `transforms.json`, as `ns-process-data` writes it, and of a synthetic scene in the layout of NeRF's."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sadgs_ns.data import colmap, images
from sadgs_ns.data.checks import geometry
from sadgs_ns.data.checks.findings import Finding, collect_findings, note, warning
from sadgs_ns.data.checks.images import check_images
from sadgs_ns.data.checks.layouts import no_layout
from sadgs_ns.data.checks.splits import SPLITS, check_splits
from sadgs_ns.data.coordinates import fixed_frame
from sadgs_ns.data.layouts import COLMAP_FOLDERS, ParserOptions, transforms_path
from sadgs_ns.data.transforms import (
    APPLIED_TRANSFORM,
    DISTORTION,
    PERSPECTIVE,
    PINHOLE,
    blender_images,
    camera_of,
    focal_length,
    matrix_of,
    read_blender,
    read_transforms,
    view_of,
)
from sadgs_ns.data.views import Camera, View, check_positive, finite
from sadgs_ns.errors import InputError


@collect_findings
def check_nerfstudio(data: Path, options: ParserOptions, open_images: bool = True) -> Iterator[Finding]:
    """Check a `transforms.json`, or the one in a folder, and its images if asked."""
    path = transforms_path(data)
    if not path.is_file():
        raise InputError(no_layout(data))
    folder = path.parent
    meta = read_transforms(path)
    described = meta["frames"]
    model = meta.get("camera_model", "OPENCV")
    known = (*PERSPECTIVE, "OPENCV_FISHEYE", "FISHEYE624")
    if model not in known:
        raise InputError(f"{path} has the camera model {model!r}: give one of {', '.join(known)}.")
    _check_transform(meta, path)
    factor = options.downscale_factor or 1
    if open_images:
        factor = _factor_of(described, folder, options)
    locate = functools.partial(_locate, folder, factor)
    views = []
    frames = []
    for frame in described:
        where = f"{path}: frame {frame['file_path']}"
        check_positive(frame, where, PINHOLE)
        image = locate(frame["file_path"])
        views.append(_view(frame, where, camera_of(frame, model, where), image, open_images))
        frames.append(images.Frame(image, _scaled_size(frame, factor), _mask(frame, locate)))
    _check_all_or_none(described, "depth_file_path", "depths", path)
    names = [frame["file_path"] for frame in described]
    lists = {split: meta[f"{split}_filenames"] for split in SPLITS if f"{split}_filenames" in meta}
    training = yield from check_splits(names, lists, lambda split: f"{path}: {split}_filenames", locate, options)
    yield from geometry.check_times(_times(described), path)
    sound = yield from geometry.check_views(views, training, path)
    if 3 <= training == len(frames) < 10:  # With more frames all are trained on only where that was asked for.
        yield note(f"{path} has {training} views, none of them held out: `ns-eval` cannot measure any.")
    if not any("mask_path" in frame for frame in described):
        yield from _check_unnamed_masks(folder / "masks", path)
    if open_images:
        yield from check_images(frames, path, folder, look_for_unused=factor == 1)
    if not sound:
        views = []  # Points are then checked without them.
    if options.load_3D_points:
        yield from _check_ply(meta, path, views)


def _locate(folder: Path, factor: int, name: str, kind: str = "images") -> Path:
    """Return the file that a name in a folder stands for, or its copy that is smaller by a factor."""
    if factor == 1:
        return folder / name
    return folder / f"{kind}_{factor}" / Path(name).name  # Copies lie in one folder.


def _scaled_size(frame: dict[str, Any], factor: int) -> images.Size:
    size = (int(frame["w"]), int(frame["h"]))
    return images.scaled_size(size, factor, "floor")


def _mask(frame: dict[str, Any], locate: Callable[[str, str], Path]) -> Path | None:
    if frame.get("mask_path") is None:
        return None
    return locate(frame["mask_path"], "masks")


def _check_unnamed_masks(folder: Path, path: Path) -> Iterator[Finding]:
    if images.images_in(folder):
        remedy = "name each as mask_path of its frame to leave out what is black in it"
        yield warning(f"{folder} holds masks that are not used, as {path} names none: {remedy}.")


def _view(frame: dict[str, Any], where: str, camera: Camera, image: Path, open_image: bool) -> View:
    """Return the view of a frame, without its image if that shall not be opened."""
    if open_image:
        return view_of(frame, where, camera, image)
    return view_of(frame, where, camera, None)


def _times(frames: Sequence[dict[str, Any]]) -> list[Any]:
    """Return the times of frames that have one."""
    return [frame["time"] for frame in frames if "time" in frame]


def _check_all_or_none(frames: Sequence[dict[str, Any]], key: str, files: str, path: Path) -> None:
    """Raise InputError if some frames, but not all, name files by a key."""
    number = sum(key in frame for frame in frames)
    if 0 < number < len(frames):
        problem = f"{path} names {files} for {number} of {len(frames)} frames"
        raise InputError(f"{problem}: give all of them one, or none.")


def _factor_of(described: Sequence[dict[str, Any]], folder: Path, options: ParserOptions) -> int:
    """Return the downscale factor of the frames' images to read; raise InputError if these or masks are missing."""
    first = folder / described[0]["file_path"]
    factor = options.downscale_factor

    def copies(by: int) -> Path:
        return images.smaller_folder(folder / "images", by) / first.name

    if factor is None and not first.is_file():
        for by in (2, 4, 8):  # Some captures are shared smaller.
            if copies(by).is_file():
                problem = f"{first} does not exist, but {copies(by)} does"
                raise InputError(f"{problem}: end the command with `nerfstudio-data --downscale-factor {by}`.")
    factor = factor or images.automatic_factor(first, copies)
    if factor == 1:
        return factor
    for kind, key in (("images", "file_path"), ("masks", "mask_path")):
        smaller = images.smaller_folder(folder / kind, factor)
        if any(key in frame for frame in described) and not smaller.is_dir():
            problem = f"{smaller} does not exist, which should hold the {kind} scaled down by {factor}"
            scale = f"--pipeline.datamanager.camera-res-scale-factor {1 / factor:.4g}"
            remedy = f"make it, or end the command with `{scale} nerfstudio-data --downscale-factor 1`"
            raise InputError(f"{problem}: {remedy}.")
    _check_copies(described, folder, factor)
    return factor


def _check_copies(described: Sequence[dict[str, Any]], folder: Path, factor: int) -> None:
    """Raise InputError if two frames would read one smaller copy: nerfstudio leaves out the folders of their names."""
    first_of: dict[Path, str] = {}
    for frame in described:
        name = frame["file_path"]
        copy = _locate(folder, factor, name)
        first = first_of.setdefault(copy, name)
        if first != name:
            problem = f"{copy} would be the copy of both {first} and {name}, whose folders are left out there"
            scale = f"--pipeline.datamanager.camera-res-scale-factor {1 / factor:.4g}"
            remedy = f"end the command with `{scale} nerfstudio-data --downscale-factor 1`"
            raise InputError(f"{problem}: {remedy}.")


@collect_findings
def check_blender(data: Path, options: ParserOptions, open_images: bool = True) -> Iterator[Finding]:
    """Check a synthetic scene in NeRF's layout, `transforms_train.json` and its siblings, and its images if asked."""
    for split in SPLITS:
        path = data / f"transforms_{split}.json"
        if split == "test" and not path.is_file():
            yield warning(f"{path} does not exist: `ns-eval` will have nothing to measure.")
            continue
        if split == "val" and not path.exists() and not path.with_name("transforms_test.json").exists():
            problem = f"{path} does not exist, nor a transforms_test.json"
            raise InputError(
                f"{problem}: rename transforms_train.json to transforms.json, and some views are held out."
            )
        meta = read_blender(path)
        described = meta["frames"]
        if split == "train":
            yield from geometry.check_times(_times(described), path)
        paths = blender_images(described, data)
        size = images.image_size(paths[0])  # The cameras have no size of their own.
        if not any(size):
            size = None
        views = _blender_views(meta, path, paths, size, open_images)
        if split == "train":
            yield from _check_blender_training(views, data, path, options)
        else:
            yield from geometry.check_rotations(views)
        if open_images:
            frames = [images.Frame(image, size) for image in paths]
            yield from check_images(frames, path, data)


def _blender_views(
    meta: dict[str, Any], path: Path, paths: Sequence[Path], size: images.Size | None, open_images: bool
) -> list[View]:
    """Return the views of a file's frames, whose images have these paths and this size, if it is known.

    Raise InputError for intrinsics that nerfstudio does not read.
    """
    checked = []  # Values that may give intrinsics
    if open_images and size is not None:
        width, height = size
        checked = [meta, *meta["frames"]]
    else:
        width = height = 1  # The other checks need no size.
    if "camera_angle_x" not in meta:
        _refuse_unread_intrinsics([meta, *meta["frames"]], path)
    focal = focal_length(meta, width, "camera_angle_x", str(path))
    camera = Camera(width, height, focal, focal, width / 2, height / 2)
    for values in checked:
        _check_blender_intrinsics(values, camera, path)
    views = []
    for frame, image in zip(meta["frames"], paths, strict=True):
        where = f"{path}: frame {frame['file_path']}"
        views.append(_view(frame, where, camera, image, open_images))
    return views


def _check_blender_intrinsics(values: dict[str, Any], camera: Camera, path: Path) -> None:
    """Raise InputError if a file's or a frame's values give other intrinsics than a camera has."""
    expected = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
    expected |= dict.fromkeys(DISTORTION, 0)
    for name, value in expected.items():
        given = finite(values.get(name, value), name, str(path))
        if abs(given - value) > 1e-3 * value:
            raise _unread_intrinsic(name, path)


def _refuse_unread_intrinsics(described: Sequence[dict[str, Any]], path: Path) -> None:
    """Raise InputError if values of a file or its frames have intrinsics in the place of the angle that is read."""
    for name in ("fl_x", "fl_y", "camera_angle_y", "camera_angle_x"):
        if any(name in values for values in described):
            raise _unread_intrinsic(name, path)


def _unread_intrinsic(name: str, path: Path) -> InputError:
    return InputError(f"{path}: of Blender scenes {name} is not read; rename it to transforms.json.")


def _check_blender_training(views: Sequence[View], data: Path, path: Path, options: ParserOptions) -> Iterator[Finding]:
    """Check a file's training views, and the points from which training starts."""
    sound = yield from geometry.check_views(views, len(views), path)
    distance = float(np.median([np.linalg.norm(view.centre) for view in views]))
    if options.ply_path is not None:
        remedy = "restore it, or leave `--ply-path` out to start from random points"
        if not sound:
            views = []
        yield from geometry.check_ply(data / options.ply_path, views, remedy)
    elif not 0.5 < distance < 25:
        problem = f"{path} has cameras {distance:.3g} units from the origin, about which random points fill a cube"
        remedy = "rename it to transforms.json, whose cameras are centred and scaled"
        yield warning(f"{problem} of side 10 as training starts: {remedy}.")


def _check_transform(meta: dict[str, Any], path: Path) -> None:
    """Raise InputError if the settings of all poses together make no sense."""
    applied = matrix_of(meta.get("applied_transform", APPLIED_TRANSFORM), 3)
    if applied is None or not np.isfinite(applied).all():
        raise InputError(f"{path} has an applied_transform that is not 3 × 4 finite numbers: correct or remove it.")
    if finite(meta.get("applied_scale", 1), "applied_scale", str(path)) != 1:
        problem = f"{path} has applied_scale = {meta['applied_scale']}, by which nerfstudio moves points and no cameras"
        raise InputError(f"{problem}: remove it.")
    fixed_frame(meta, path)
    if meta.get("fisheye_crop_radius") is not None:
        finite(meta["fisheye_crop_radius"], "fisheye_crop_radius", str(path))
    methods = ("pca", "up", "vertical", "none")
    method = meta.get("orientation_override", "none")
    if method not in methods:
        raise InputError(f"{path} has orientation_override = {method!r}: give one of {', '.join(methods)}.")


def _check_ply(meta: dict[str, Any], path: Path, views: Sequence[View]) -> Iterator[Finding]:
    if "ply_file_path" in meta:
        remedy = f"restore it, or remove ply_file_path from {path} to start from random points"
        yield from geometry.check_ply(path.parent / str(meta["ply_file_path"]), views, remedy)
        return
    source = colmap.points_file(path.parent / COLMAP_FOLDERS[0])
    if source is not None:
        positions, colors = colmap.read_points(source)
        transform = np.array(meta["applied_transform"], float)  # [3, 4]
        moved = positions @ transform[:, :3].T + transform[:, 3]
        random = "end the command with `nerfstudio-data --load-3D-points False` to start from random points"
        yield from geometry.check_points((moved, colors), views, source, f"run COLMAP's mapper again, or {random}")
        return
    remark = f"{path} has no ply_file_path: training will start from random points"
    unnamed = min(path.parent.glob("*.ply"), default=None)
    if unnamed is not None:
        yield warning(f"{remark}, not from {unnamed}, unless you name it there.")
    else:
        yield note(f"{remark}.")
