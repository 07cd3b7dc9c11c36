"""What identifies a capture in a folder: its photos, their cameras and the SfM points, counted and hashed.

The order in which a reconstruction lists its cameras, images and points does not matter, nor whether its files are
binary or text: numbers are hashed with nine digits. So a folder that was copied or converted has the digests of the
original, and one whose photos were placed again has other digests of cameras and points.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.photo_captures import photos_of
from sadgs_ns.data import colmap
from sadgs_ns.data.images import image_size

SPARSE = Path("sparse/0")
"""Folder of a scene's COLMAP model."""
TRANSFORMS = Path("transforms.json")
"""Cameras of a scene without a COLMAP model."""
DIGITS = 16
"""How many hexadecimal digits of a SHA-256 are kept."""


@dataclass(frozen=True)
class Photos:
    """The photos of a folder."""

    count: int
    sizes: tuple[str, ...]
    """Sizes in px, such as "640×480", the most frequent first."""
    names: str
    """Digest of the names and sizes."""
    content: str
    """Digest of the names and files."""


@dataclass(frozen=True)
class Model:
    """The cameras and SfM points of a scene."""

    views: int
    """How many photos have a camera."""
    points: int
    """Number of SfM points."""
    cameras: str
    """Digest of the cameras and poses, and of the lists of held-out views where the file has such."""
    positions: str
    """Digest of the points' positions and colours."""


def digest(lines: Iterable[str]) -> str:
    """Hash lines, whose order does not matter."""
    text = "\n".join(sorted(lines))
    return hashlib.sha256(text.encode()).hexdigest()[:DIGITS]


def measure_photos(folder: Path) -> Photos:
    """Measure the photos in a folder and in those below it. Raises OSError if one cannot be read."""
    sizes = Counter[str]()
    names = []
    contents = []
    for name in photos_of(folder):
        width, height = image_size(folder / name)
        size = f"{width}×{height}"
        sizes[size] += 1
        names.append(f"{name} {size}")
        content = hashlib.sha256((folder / name).read_bytes())
        contents.append(f"{name} {content.hexdigest()}")
    frequent = tuple(size for size, _ in sizes.most_common())
    return Photos(len(names), frequent, digest(names), digest(contents))


def measure_model(scene: Path) -> Model | None:
    """Measure the cameras and points of a scene, or return None if it has neither a COLMAP model nor `transforms.json`.

    Raises InputError or ValueError if they cannot be read.
    """
    model = scene / SPARSE
    kind = colmap.model_kind(model)
    if kind is not None:
        return _measure_colmap(model, kind)
    if (scene / TRANSFORMS).is_file():
        return _measure_transforms(scene / TRANSFORMS)
    return None


def _numbers(values: Sequence[float]) -> str:
    return " ".join(f"{value:.9g}" for value in values)


def _measure_colmap(model: Path, kind: str) -> Model:
    cameras = colmap.read_cameras(model / f"cameras.{kind}")
    lines = []
    for name, camera_id, pose in colmap.read_poses(model / f"images.{kind}"):
        camera = cameras[camera_id]
        if pose[0] < 0:  # A quaternion and its negative are one rotation.
            pose = np.concatenate([-pose[:4], pose[4:]])
        lens = f"{camera.model} {camera.width} {camera.height} {_numbers(camera.params)}"
        lines.append(f"{name} {lens} {_numbers(pose.tolist())}")
    points: list[str] = []
    path = colmap.points_file(model)
    if path is not None:
        positions, colors = colmap.read_points(path)
        text = io.StringIO()
        np.savetxt(text, np.hstack([positions, colors]), "%.9g")
        points = text.getvalue().splitlines()
    return Model(len(lines), len(points), digest(lines), digest(points))


def _measure_transforms(path: Path) -> Model:
    content: dict[str, Any] = json.loads(path.read_text("utf8"), parse_float=lambda text: f"{float(text):.9g}")
    content.pop("ply_file_path", None)  # These points are random.
    frames = content.pop("frames")
    lines = [json.dumps(frame, sort_keys=True) for frame in frames]
    for key, value in content.items():
        if isinstance(value, list):
            value = sorted(map(str, value))
        lines.append(json.dumps([key, value]))
    return Model(len(frames), 0, digest(lines), digest([]))
