"""Looks at a data folder before nerfstudio parses it, and says in one sentence each what would go wrong.

A few hundred images take under a second. Nothing here needs torch.
"""

from __future__ import annotations

import functools
import json
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, ParamSpec

import numpy as np

from sadgs_ns.data import colmap
from sadgs_ns.data.image_validation import Frame, Size, image_problems, image_size, images_in, unused_images
from sadgs_ns.errors import InputError, reason

MAX_AUTO_RESOLUTION = 1600
"""px; nerfstudio looks for smaller copies of images that are larger than this."""
COLMAP_FOLDERS = ("colmap/sparse/0", "sparse/0", "sparse", "colmap")
"""Where a reconstruction is looked for; nerfstudio's default is the first."""
UNSUPPORTED_CAMERAS = {"FULL_OPENCV", "FOV", "THIN_PRISM_FISHEYE"}
"""COLMAP's camera models that nerfstudio cannot read."""
Rounding = Literal["floor", "round", "ceil"]
_PLY_BYTES = {"short": 2, "ushort": 2, "int16": 2, "uint16": 2, "int": 4, "uint": 4, "int32": 4, "uint32": 4,
              "float": 4, "float32": 4, "double": 8, "float64": 8}  # fmt: skip
_GIVE_POSES = "compute poses with `sadgs-process PHOTOS FOLDER` or `ns-process-data`"


@dataclass(frozen=True)
class Finding:
    """One thing to know about a data folder."""

    severity: Literal["error", "warning", "note"]
    """Whether training is refused, may disappoint, or just behaves in a way worth knowing."""
    sentence: str
    """Names the file and the remedy."""


_Arguments = ParamSpec("_Arguments")


def _findings(check: Callable[_Arguments, Iterator[Finding]]) -> Callable[_Arguments, list[Finding]]:
    """The findings of a check, or of one that gave up with an InputError this alone."""

    @functools.wraps(check)
    def findings(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> list[Finding]:
        try:
            return list(check(*args, **kwargs))
        except InputError as error:
            return [Finding("error", str(error))]

    return findings


# --- whole folders ---


def check_data(data: Path) -> list[Finding]:
    """Findings for a folder in whatever layout it has: nerfstudio's, COLMAP's or Blender's, with default options."""
    if data.is_file() or (data / "transforms.json").is_file():
        return check_nerfstudio(data)
    if (data / "transforms_train.json").is_file():
        return check_blender(data)
    if (folder := find_reconstruction(data)) is not None:
        return check_colmap(data, colmap_path=folder)
    return [Finding("error", _no_layout(data))]


def refuse(findings: Sequence[Finding], data: Path) -> None:
    """Raise the first error among findings.

    Raises:
        InputError: With the error's sentence, and how many more there are.
    """
    errors = [finding.sentence for finding in findings if finding.severity == "error"]
    if errors:
        more = f" (`sadgs-doctor {data}` shows {len(errors) - 1} more.)" if len(errors) > 1 else ""
        raise InputError(errors[0] + more)


def find_reconstruction(data: Path) -> Path | None:
    """The folder of a COLMAP reconstruction, relative to the data, or None."""
    for folder in COLMAP_FOLDERS:
        if any((data / folder / f"cameras.{kind}").is_file() for kind in ("txt", "bin")):
            return Path(folder)
    return None


def _no_layout(data: Path) -> str:
    """The sentence for a folder without poses."""
    if not data.exists():
        return f"{data} does not exist: give --data the folder of a capture."
    images = images_in(data) or images_in(data / "images")
    if images:
        return f"{data} holds {len(images)} images but no camera poses: {_GIVE_POSES}."
    return (
        f"{data.absolute()} holds neither transforms.json nor a COLMAP reconstruction ({', '.join(COLMAP_FOLDERS)}): "
        f"give --data another folder, or {_GIVE_POSES}."
    )


# --- nerfstudio's transforms.json ---


@_findings
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
        raise InputError(_no_layout(data) if data.suffix != ".json" else f"{path} does not exist: {_GIVE_POSES}.")
    meta = _read_json(path)
    described = _frames_of(meta, path)
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
        _check_intrinsics(values, f"{path}: frame {image}", ("fl_x", "fl_y", "cx", "cy", "w", "h"))
        mask = frame.get("mask_path")
        frames.append(
            Frame(
                folder / (f"images_{factor}/{image.name}" if factor > 1 else image),
                _scaled((int(values["w"]), int(values["h"])), factor, "floor"),
                None if mask is None else folder / (f"masks_{factor}/{Path(mask).name}" if factor > 1 else mask),
            )
        )
    masked = sum(frame.mask is not None for frame in frames)
    if 0 < masked < len(frames):
        raise InputError(f"{path} names masks for {masked} of {len(frames)} frames: give all of them one, or none.")
    split = meta.get("train_filenames")
    count = len(split) if isinstance(split, list) else training_images and training_images(len(frames))
    yield from _check_number(len(frames), count, path)
    yield from _check_positions(np.array([frame["transform_matrix"] for frame in described])[:, :3, 3], path)
    if open_images:
        yield from _check_images(frames, path, look_for_unused=factor == 1)
    if load_points:
        yield from _check_ply(meta, path)


def _read_json(path: Path) -> dict[str, Any]:
    try:
        meta = json.loads(path.read_text(encoding="utf8"))
    except FileNotFoundError:
        raise InputError(f"{path} does not exist: restore it, or {_GIVE_POSES}.") from None
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{path} is not readable JSON ({reason(error)}): restore it, or {_GIVE_POSES}.") from error
    if not isinstance(meta, dict):
        raise InputError(f"{path} holds a {type(meta).__name__} instead of an object with frames: {_GIVE_POSES}.")
    return meta


def _frames_of(meta: dict[str, Any], path: Path) -> list[dict[str, Any]]:
    """The frames, each with a file path and a pose that can be used."""
    frames = meta.get("frames")
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path} lists no frames, so there is no image to train on: {_GIVE_POSES}.")
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


def _check_intrinsics(values: dict[str, Any], where: str, names: Sequence[str]) -> None:
    """Raise InputError unless the names have finite values, positive but for the principal point."""
    for name in names:
        value = values.get(name)
        if name not in values:
            raise InputError(f"{where} has no {name}: give it one, for all frames or this one.")
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise InputError(f"{where} has {name} = {value!r}, which is no finite number: correct it.")
        if name not in ("cx", "cy") and value <= 0:
            raise InputError(f"{where} has {name} = {value}, which must be positive: correct it.")


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


# --- COLMAP ---


@_findings
def check_colmap(
    data: Path,
    *,
    images_path: Path = Path("images"),
    colmap_path: Path = Path(COLMAP_FOLDERS[0]),
    masks_path: Path | None = None,
    downscale_factor: int | None = None,
    rounding: Rounding = "floor",
    load_points: bool = True,
    training_images: Callable[[int], int] | None = lambda count: count - math.ceil(count / 8),
    open_images: bool = True,
) -> Iterator[Finding]:
    """Findings for a COLMAP reconstruction, binary or text.

    Args:
        data: The folder that the other paths are relative to.
        images_path, colmap_path, masks_path, downscale_factor, rounding: As of nerfstudio's parser.
        load_points, training_images, open_images: As for `check_nerfstudio`.
    """
    images_folder, model_folder = data / images_path, data / colmap_path
    kind = next((kind for kind in ("txt", "bin") if (model_folder / f"cameras.{kind}").is_file()), None)
    if kind is None:
        if (found := find_reconstruction(data)) is not None:
            raise InputError(
                f"{model_folder} holds no COLMAP reconstruction, but {data / found} does: add `--colmap-path {found}` "
                "after `colmap`."
            )
        raise InputError(_no_layout(data))
    cameras_path, poses_path = model_folder / f"cameras.{kind}", model_folder / f"images.{kind}"
    cameras = colmap.read_cameras(cameras_path)
    poses = colmap.read_poses(poses_path)
    if not poses:
        raise InputError(f"{poses_path} holds no pose, so there is no image to train on: run COLMAP's mapper again.")
    for name, camera_id, pose in poses:
        where = f"{poses_path}: image {name}"
        if not np.isfinite(pose).all():
            raise InputError(f"{where} has NaN or infinity in its pose: run COLMAP's mapper again.")
        if not 0.99 < np.linalg.norm(pose[:4]) < 1.01:
            raise InputError(f"{where} has a rotation that is no unit quaternion: run COLMAP's mapper again.")
        if camera_id not in cameras:
            raise InputError(f"{where} has camera {camera_id}, which {cameras_path} lacks: take both of one model.")
    used = {camera_id: cameras[camera_id] for _, camera_id, _ in poses}
    for camera_id, camera in cameras.items():  # nerfstudio reads all of them, used or not
        _check_camera(camera, f"{cameras_path}: camera {camera_id}")
    if len({"FISHEYE" in camera.model for camera in used.values()}) > 1:
        raise InputError(
            f"{cameras_path} mixes fisheye and other cameras, which nerfstudio cannot read: undistort the images with "
            "`colmap image_undistorter`."
        )
    if not images_folder.is_dir():
        raise InputError(
            f"{poses_path} has poses of {len(poses)} images, but there is no folder {images_folder}: put them there, "
            "or add `--images-path FOLDER` after `colmap`."
        )
    training = training_images and training_images(len(poses))
    if (listed := data / "train_list.txt").is_file():
        training = len(listed.read_text(encoding="utf8").splitlines())
    yield from _check_number(len(poses), training, poses_path)
    yield from _check_positions(np.array([colmap.camera_centre(pose) for _, _, pose in poses]), poses_path)
    if load_points:
        yield from _check_points(model_folder)
    if not open_images:
        return
    factor = downscale_factor
    if factor is None:
        factor, size = 1, image_size(images_folder / poses[0][0])
        while max(size) / factor > MAX_AUTO_RESOLUTION:
            factor *= 2
    smaller = _smaller_folder(images_folder, factor)
    if not all((smaller / name).parent.exists() for name, _, _ in poses):
        yield Finding(
            "warning",
            f"{images_folder} holds images of more than {MAX_AUTO_RESOLUTION} px and there is no {smaller}: nerfstudio "
            f"will ask whether to make it with ffmpeg; say yes, or add `--downscale-factor 1` after `colmap`.",
        )
        factor, smaller = 1, images_folder
    frames = []
    for name, camera_id, _ in poses:
        size = _scaled((used[camera_id].width, used[camera_id].height), factor, rounding)
        mask = None
        if masks_path is not None:
            mask = (_smaller_folder(data / masks_path, factor) / name).with_suffix(".png")
        frames.append(Frame(smaller / name, size, mask))
    yield from _check_images(frames, poses_path, look_for_unused=factor == 1)


def _check_camera(camera: colmap.Camera, where: str) -> None:
    """Raise InputError if nerfstudio cannot read it or a value makes no sense."""
    if camera.model not in colmap.CAMERA_PARAMETERS or camera.model in UNSUPPORTED_CAMERAS:
        raise InputError(
            f"{where} has the model {camera.model}, which nerfstudio cannot read: undistort the images with "
            "`colmap image_undistorter`."
        )
    focals = 1 if camera.model.startswith("SIMPLE") or "RADIAL" in camera.model else 2
    values = {"width": camera.width, "height": camera.height}
    values |= {f"focal length {axis}": value for axis, value in zip("xy", camera.params[:focals], strict=False)}
    _check_intrinsics(values, where, list(values))
    if not np.isfinite(camera.params).all() or len(camera.params) != colmap.CAMERA_PARAMETERS[camera.model]:
        raise InputError(
            f"{where} has the parameters {camera.params} instead of {colmap.CAMERA_PARAMETERS[camera.model]} finite "
            "numbers: run COLMAP's mapper again."
        )


def _check_points(model_folder: Path) -> Iterator[Finding]:
    """Findings for the SfM points."""
    path = colmap.points_file(model_folder)
    random = "add `--load-3D-points False` after `colmap` to start from random points"
    if path is None:
        yield Finding(
            "error", f"{model_folder} has no points3D.bin or .txt: copy the whole reconstruction, or {random}."
        )
        return
    positions, _ = colmap.read_points(path)
    if not np.isfinite(positions).all():
        yield Finding("error", f"{path} has NaN or infinity in a point: run COLMAP's mapper again, or {random}.")
    if len(positions) == 0:
        yield Finding("error", f"{path} holds no SfM point: run COLMAP's mapper again, or {random}.")


# --- Blender ---


@_findings
def check_blender(data: Path, *, open_images: bool = True) -> Iterator[Finding]:
    """Findings for a synthetic scene in the layout of NeRF's: `transforms_train.json` and its siblings."""
    if not (data / "transforms_train.json").is_file():
        raise InputError(_no_layout(data))
    for split in ("train", "val", "test"):
        path = data / f"transforms_{split}.json"
        if split == "test" and not path.is_file():
            yield Finding("warning", f"{path} does not exist: `ns-eval` will have nothing to measure.")
            continue
        meta = _read_json(path)
        described = _frames_of(meta, path)
        _check_intrinsics(meta, str(path), ["camera_angle_x"])
        images = [data / (frame["file_path"].replace("./", "") + ".png") for frame in described]
        if split == "train":
            yield from _check_number(len(images), len(images), path)
        if open_images:
            size = image_size(images[0])  # that of all cameras
            yield from _check_images([Frame(image, size if any(size) else None) for image in images], path)


# --- what all layouts share ---


def _check_number(views: int, training: int | None, source: Path) -> Iterator[Finding]:
    """Findings for the number of views in all and of those that are trained on, where that is known."""
    if views < 2:
        yield Finding("error", f"{source} has 1 view, which shows no depth: take at least 2 images, better 20 or more.")
    elif training == 0:
        yield Finding("error", f"{source} leaves no view for training: name some in its list of training images.")
    elif training is not None and training < 3:
        yield Finding(
            "warning",
            f"{source} leaves {training} training view{'s' * (training > 1)}: so few fix no shape; take 20 or more.",
        )
    elif training == views and views < 10:
        yield Finding("note", f"{source} has {views} views, none of them held out: `ns-eval` cannot measure any.")


def _check_positions(centres: np.ndarray, source: Path) -> Iterator[Finding]:
    """Findings for camera centres [V, 3]."""
    spread = np.abs(centres - centres.mean(axis=0)).max()
    if len(centres) > 1 and spread <= 1e-9 * max(np.abs(centres).max(), 1.0):
        yield Finding(
            "error", f"{source} has all {len(centres)} cameras in one place, which shows no depth: move between images."
        )


def _scaled(size: Size, factor: int, rounding: Rounding) -> Size:
    """A camera's width and height after nerfstudio scaled them down, in its float32."""
    width, height = (float(np.float32(side) * np.float32(1.0 / factor)) for side in size)
    to_int = {"floor": math.floor, "round": lambda value: math.floor(value + 0.5), "ceil": math.ceil}[rounding]
    return to_int(width), to_int(height)


def _smaller_folder(folder: Path, factor: int) -> Path:
    """Where nerfstudio keeps a folder's images scaled down."""
    return folder.with_name(f"{folder.name}_{factor}") if factor > 1 else folder


def _check_images(frames: Sequence[Frame], source: Path, look_for_unused: bool = False) -> Iterator[Finding]:
    """Findings for the frames' images and masks and, on demand, for images beside them."""
    for sentence in image_problems(frames, source):
        yield Finding("error", sentence)
    if look_for_unused and (unused := unused_images(frames, source)) is not None:
        yield Finding("warning", unused)
