"""Checks of a synthetic scene in the layout of NeRF's: `transforms_train.json` and its siblings."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from sadgs_ns.data.validation.findings import Finding, collect_findings
from sadgs_ns.data.validation.geometry import check_number, check_positive
from sadgs_ns.data.validation.images import Frame, check_images, image_size
from sadgs_ns.data.validation.layouts import no_layout
from sadgs_ns.data.validation.transforms import frames_of, read_json
from sadgs_ns.errors import InputError


@collect_findings
def check_blender(data: Path, *, open_images: bool = True) -> Iterator[Finding]:
    """Findings for a synthetic scene in the layout of NeRF's: `transforms_train.json` and its siblings."""
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
        images = [data / (frame["file_path"].replace("./", "") + ".png") for frame in described]
        if split == "train":
            yield from check_number(len(images), len(images), path)
        if open_images:
            size = image_size(images[0])  # that of all cameras
            yield from check_images([Frame(image, size if any(size) else None) for image in images], path)
