"""Checks of a `transforms.json`, as `ns-process-data` writes it."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from sadgs_ns.data.validation.findings import Finding, collect_findings
from sadgs_ns.data.validation.geometry import check_centres, check_number, check_positive
from sadgs_ns.data.validation.images import MAX_AUTO_RESOLUTION, Frame, check_images, image_size, scaled_size
from sadgs_ns.data.validation.layouts import COLMAP_FOLDERS, GIVE_POSES, find_reconstruction, no_layout
from sadgs_ns.errors import InputError, reason

_PLY_BYTES = {"short": 2, "ushort": 2, "int16": 2, "uint16": 2, "int": 4, "uint": 4, "int32": 4, "uint32": 4,
              "float": 4, "float32": 4, "double": 8, "float64": 8}  # fmt: skip


@collect_findings
def check_nerfstudio(
    data: Path,
    *,
    downscale_factor: int | None = None,
    load_points: bool = True,
    training_images: Callable[[int], int] | None = lambda count: math.ceil(0.9 * count),
    open_images: bool = True,
) -> Iterator[Finding]:
    """Findings for a `transforms.json`, as `ns-process-data` writes it.

    Args:
        data: The folder, or the file itself.
        downscale_factor: As of nerfstudio's parser: None chooses by size.
        load_points: Whether the SfM points will be read.
        training_images: How many of so many views are trained on; None if that depends on names.
        open_images: Whether to look into the images, too.
    """
    path = data if data.suffix == ".json" else data / "transforms.json"
    folder = path.parent
    if not path.is_file():
        if (found := find_reconstruction(data)) is not None:
            raise InputError(
                f"{path} does not exist, but {data / found} holds a COLMAP reconstruction: end the command with "
                f"`colmap --colmap-path {found}`."
            )
        raise InputError(no_layout(data) if data.suffix != ".json" else f"{path} does not exist: {GIVE_POSES}.")
    meta = read_json(path)
    described = frames_of(meta, path)
    model = meta.get("camera_model", "OPENCV")
    perspective = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE", "FISHEYE624")
    if model not in perspective:
        raise InputError(f"{path} has the camera model {model!r}: give one of {', '.join(perspective)}.")
    factor = downscale_factor
    if factor is None:
        factor = _smaller_copies(folder, Path(described[0]["file_path"])) if open_images else 1
    frames = []
    for frame in described:
        image, values = Path(frame["file_path"]), {**frame, **meta}
        check_positive(values, f"{path}: frame {image}", ("fl_x", "fl_y", "cx", "cy", "w", "h"))
        mask = frame.get("mask_path")
        frames.append(
            Frame(
                folder / (f"images_{factor}/{image.name}" if factor > 1 else image),
                scaled_size((int(values["w"]), int(values["h"])), factor, "floor"),
                None if mask is None else folder / (f"masks_{factor}/{Path(mask).name}" if factor > 1 else mask),
            )
        )
    masked = sum(frame.mask is not None for frame in frames)
    if 0 < masked < len(frames):
        raise InputError(f"{path} names masks for {masked} of {len(frames)} frames: give all of them one, or none.")
    split = meta.get("train_filenames")
    count = len(split) if isinstance(split, list) else training_images and training_images(len(frames))
    yield from check_number(len(frames), count, path)
    yield from check_centres(np.array([frame["transform_matrix"] for frame in described])[:, :3, 3], path)
    if open_images:
        yield from check_images(frames, path, look_for_unused=factor == 1)
    if load_points:
        yield from _check_ply(meta, path)


def read_json(path: Path) -> dict[str, Any]:
    try:
        meta = json.loads(path.read_text(encoding="utf8"))
    except FileNotFoundError:
        raise InputError(f"{path} does not exist: restore it, or {GIVE_POSES}.") from None
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path} is not readable JSON ({reason(error)}): restore it, or {GIVE_POSES}.") from error
    if not isinstance(meta, dict):
        raise InputError(f"{path} holds a {type(meta).__name__} instead of an object with frames: {GIVE_POSES}.")
    return meta


def frames_of(meta: dict[str, Any], path: Path) -> list[dict[str, Any]]:
    """The frames, each with a file path and a pose that can be used."""
    frames = meta.get("frames")
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path} lists no frames, so there is no image to train on: {GIVE_POSES}.")
    for number, frame in enumerate(frames):
        if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
            raise InputError(f"{path}: frame {number} has no file_path: give it one, or remove the frame.")
        where = f"{path}: frame {frame['file_path']}"
        try:
            pose = np.array(frame["transform_matrix"], dtype=np.float64)
        except (KeyError, TypeError, ValueError):
            pose = np.empty(0)
        if pose.shape != (4, 4):
            raise InputError(f"{where} has no pose of 4 × 4 numbers: give it a transform_matrix, or remove the frame.")
        if not np.isfinite(pose).all():
            raise InputError(f"{where} has NaN or infinity in its pose: remove the frame, or compute the poses again.")
        if abs(np.linalg.det(pose[:3, :3])) < 1e-9:
            raise InputError(f"{where} has no rotation in its pose: remove the frame, or compute the poses again.")
        if not isinstance(frame.get("mask_path", ""), str):
            raise InputError(f"{where} has a mask_path that is no string: correct or remove it.")
    return frames


def _check_ply(meta: dict[str, Any], path: Path) -> Iterator[Finding]:
    name = meta.get("ply_file_path")
    if name is None:
        if (path.parent / COLMAP_FOLDERS[0]).exists():
            yield Finding("warning", f"{path} has no ply_file_path: nerfstudio will ask whether to make one; say yes.")
        else:
            yield Finding("note", f"{path} has no ply_file_path: training will start from random points.")
        return
    ply = path.parent / str(name)
    remedy = f"restore it, or remove ply_file_path from {path} to start from random points"
    try:
        problem = _ply_problem(ply.read_bytes())
    except OSError as error:
        problem = f"cannot be read ({reason(error)})"
    if problem is not None:
        yield Finding("error", f"{ply} should hold the SfM points but {problem}: {remedy}.")


def _ply_problem(content: bytes) -> str | None:
    """What is wrong with a PLY file of points, which come first in it; None if nothing."""
    header, end, body = content.partition(b"end_header\n" if b"end_header\n" in content else b"end_header\r\n")
    lines = [line.split() for line in header.decode("ascii", "replace").splitlines()]
    counts = [line[2] for line in lines if line[:2] == ["element", "vertex"] and len(line) == 3]
    types = [line[1] for line in lines if line[:1] == ["property"] and len(line) == 3]  # lists, of faces, have more
    if not end or lines[:1] != [["ply"]] or len(counts) != 1 or not counts[0].isdecimal():
        return "is not a PLY file of points"
    if int(counts[0]) == 0:
        return "is empty"
    if ["format", "ascii", "1.0"] in lines:
        there = body.count(b"\n") + (not body.endswith(b"\n"))
    else:
        there = len(body) // max(sum(_PLY_BYTES.get(kind, 1) for kind in types), 1)
    return f"is cut off: its header promises {counts[0]} points" if there < int(counts[0]) else None


def _smaller_copies(folder: Path, image: Path) -> int:
    """The factor that nerfstudio's own parser chooses: it takes smaller copies only where they exist."""
    factor, size = 1, image_size(folder / image)
    while max(size) / factor > MAX_AUTO_RESOLUTION and (folder / f"images_{2 * factor}" / image.name).exists():
        factor *= 2
    return factor
