"""Checks of a synthetic scene in the layout of NeRF's: `transforms_train.json` and its siblings."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

from sadgs_ns.data.checks.findings import Finding, collect_findings
from sadgs_ns.data.checks.geometry import Camera, check_ply, check_positive, check_rotations, check_views
from sadgs_ns.data.checks.images import Frame, check_images, image_size
from sadgs_ns.data.checks.layouts import no_layout
from sadgs_ns.data.checks.transforms import frames_of, read_json, view_of
from sadgs_ns.errors import InputError


@collect_findings
def check_blender(data: Path, *, ply_path: Path | None = None, open_images: bool = True) -> Iterator[Finding]:
    """Check a synthetic scene in the layout of NeRF's: `transforms_train.json` and its siblings.

    Args:
        data: The folder.
        ply_path: SfM points, relative to the folder, as of nerfstudio's parser.
        open_images: Whether to look into the images, too.
    """
    if not (data / "transforms_train.json").is_file():
        raise InputError(no_layout(data))
    for split in ("train", "val", "test"):
        path = data / f"transforms_{split}.json"
        if split == "test" and not path.is_file():
            yield Finding("warning", f"{path} does not exist: `ns-eval` will have nothing to measure.")
            continue
        meta = read_json(path)
        described = frames_of(meta, path)
        check_positive(meta, str(path), ["camera_angle_x"])
        if not meta["camera_angle_x"] < math.pi:
            angle = f"camera_angle_x = {meta['camera_angle_x']:g}"
            raise InputError(f"{path} has {angle}, which is no angle of view in radians: correct it.")
        images = [data / (frame["file_path"].replace("./", "") + ".png") for frame in described]
        size = image_size(images[0])  # The cameras have no size of their own.
        width, height = size if open_images and any(size) else (1, 1)  # The other checks need none.
        focal = 0.5 * width / math.tan(0.5 * meta["camera_angle_x"])
        camera = Camera(width, height, focal, focal, width / 2, height / 2)
        views = [view_of(frame, f"{path}: frame {frame['file_path']}", camera) for frame in described]
        if split == "train":
            yield from (of_views := list(check_views(views, len(views), path)))
            if ply_path is not None:
                wrong = any(finding.severity == "error" for finding in of_views)
                remedy = "restore it, or leave `--ply-path` out to start from random points"
                yield from check_ply(data / ply_path, [] if wrong else views, remedy)
        else:
            yield from check_rotations(views)
        if open_images:
            yield from check_images([Frame(image, size if any(size) else None) for image in images], path)
