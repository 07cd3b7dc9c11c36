"""Checks of a `transforms.json`, as `ns-process-data` writes it, and of a synthetic scene in the layout of NeRF's."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
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
    if model not in (known := (*PERSPECTIVE, "OPENCV_FISHEYE", "FISHEYE624")):
        raise InputError(f"{path} has the camera model {model!r}: give one of {', '.join(known)}.")
    _check_transform(meta, path)
    factor = _factor_of(described, folder, options) if open_images else options.downscale_factor or 1

    def locate(name: str, kind: str = "images") -> Path:
        return folder / (f"{kind}_{factor}/{Path(name).name}" if factor > 1 else name)  # Copies lie in one folder.

    frames = []
    views = []
    for frame in described:
        where = f"{path}: frame {frame['file_path']}"
        mask = frame.get("mask_path")
        check_positive(frame, where, PINHOLE)
        image = locate(frame["file_path"])
        size = images.scaled_size((int(frame["w"]), int(frame["h"])), factor, "floor")
        views.append(view_of(frame, where, camera_of(frame, model, where), image if open_images else None))
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
    factor = options.downscale_factor

    def copies(by: int) -> Path:
        return images.smaller_folder(folder / "images", by) / first.name

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
        paths = blender_images(described, data)
        size = images.image_size(paths[0])  # The cameras have no size of their own.
        width, height = size if open_images and any(size) else (1, 1)  # The other checks need none.
        focal = focal_length(meta, width, "camera_angle_x", str(path))
        taken = {"fl_x": focal, "fl_y": focal, "cx": width / 2, "cy": height / 2, **dict.fromkeys(DISTORTION, 0)}
        for values in (meta, *described) if open_images and any(size) else ():
            for name, value in taken.items():
                if abs(finite(values.get(name, value), name, str(path)) - value) > 1e-3 * value:
                    raise InputError(f"{path}: of Blender scenes {name} is not read; rename it to transforms.json.")
        camera = Camera(width, height, focal, focal, width / 2, height / 2)
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


def _check_transform(meta: dict[str, Any], path: Path) -> None:
    """Raise InputError if the settings of all poses together make no sense."""
    applied = matrix_of(meta.get("applied_transform", APPLIED_TRANSFORM), 3)
    if applied is None or not np.isfinite(applied).all():
        raise InputError(f"{path} has an applied_transform that is not 3 × 4 finite numbers: correct or remove it.")
    if finite(meta.get("applied_scale", 1), "applied_scale", str(path)) != 1:
        told = f"{path} has applied_scale = {meta['applied_scale']}, by which nerfstudio moves points and no cameras"
        raise InputError(f"{told}: remove it.")
    fixed_frame(meta, path)
    if meta.get("fisheye_crop_radius") is not None:
        finite(meta["fisheye_crop_radius"], "fisheye_crop_radius", str(path))
    methods = ("pca", "up", "vertical", "none")
    if (method := meta.get("orientation_override", "none")) not in methods:
        raise InputError(f"{path} has orientation_override = {method!r}: give one of {', '.join(methods)}.")


def _check_ply(meta: dict[str, Any], path: Path, views: Sequence[View]) -> Iterator[Finding]:
    if "ply_file_path" in meta:
        remedy = f"restore it, or remove ply_file_path from {path} to start from random points"
        yield from geometry.check_ply(path.parent / str(meta["ply_file_path"]), views, remedy)
    elif (source := colmap.points_file(path.parent / COLMAP_FOLDERS[0])) is not None:
        (positions, colors) = colmap.read_points(source)
        transform = np.array(meta["applied_transform"], float)
        points = positions @ transform[:, :3].T + transform[:, 3], colors
        random = "end the command with `nerfstudio-data --load-3D-points False` to start from random points"
        yield from geometry.check_points(points, views, source, f"run COLMAP's mapper again, or {random}")
    else:
        told = f"{path} has no ply_file_path: training will start from random points"
        found = min(path.parent.glob("*.ply"), default=None)
        yield warning(f"{told}, not from {found}, unless you name it there.") if found else note(f"{told}.")
