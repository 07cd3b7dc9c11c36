"""Readers of COLMAP's reconstructions, text and binary, as far as checks and training need them.

The readers of nerfstudio and pycolmap trust the files, and ask for terabytes if a length is corrupt. Those here do not,
take a tenth of the time of nerfstudio's, and less than it takes to import pycolmap.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sadgs_ns.data import ply
from sadgs_ns.data.text import check_byte_order_mark
from sadgs_ns.errors import InputError, reason

CAMERA_PARAMETERS = {
    "SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8, "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12, "FOV": 5, "SIMPLE_RADIAL_FISHEYE": 4, "RADIAL_FISHEYE": 5, "THIN_PRISM_FISHEYE": 12,
}  # fmt: skip
"""Number of parameters of each of COLMAP's camera models, in the order of the models' numbers."""

Points = tuple[NDArray[np.float64], NDArray[np.uint8]]  # Positions [P, 3] and colours in 0 … 255 [P, 3]
Pose = tuple[str, int, NDArray[np.float64]]  # Name, camera's id, wxyz quaternion and translation, world to camera [7]


@dataclass(frozen=True)
class Camera:
    """Intrinsics of a camera, as COLMAP stores them."""

    model: str
    width: int  # Size of the images in px
    height: int
    params: tuple[float, ...]  # Parameters in the order of the model; the first are focal lengths in px


class _Binary:
    """A COLMAP binary file, read item by item; reading raises an InputError if it ends too early."""

    def __init__(self, path: Path) -> None:
        self.path, self.offset = path, 0
        with path.open("rb") as file:
            self.content: mmap | bytes = mmap(file.fileno(), 0, access=ACCESS_READ) if path.stat().st_size else b""

    def corrupt(self, detail: str) -> InputError:
        """Return the error for content that makes no sense."""
        return InputError(f"{self.path} is cut off or corrupt ({detail}): copy it again, or run COLMAP's mapper again.")

    def take(self, layout: struct.Struct) -> tuple[Any, ...]:
        """Return the next values."""
        self.skip(layout.size)
        return layout.unpack_from(self.content, self.offset - layout.size)

    def skip(self, size: int) -> None:
        """Pass over bytes."""
        if self.offset + size > len(self.content):
            raise self.corrupt(f"it ends after {len(self.content)} bytes, in the middle of an item")
        self.offset += size

    def text(self) -> str:
        """Return the next string, which ends with a zero byte."""
        if (end := self.content.find(b"\0", self.offset, self.offset + 4096)) < 0:
            raise self.corrupt(f"at byte {self.offset} there is no image's name")
        raw, self.offset = self.content[self.offset : end], end + 1
        try:
            return raw.decode("utf8")
        except UnicodeDecodeError:
            raise self.corrupt(f"at byte {end - len(raw)} there is no image's name") from None


_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<iiQQ")
_POSE = struct.Struct("<i7di")
_POINT = np.dtype([("id", "<u8"), ("position", "<f8", 3), ("color", "u1", 3), ("error", "<f8"), ("track", "<u8")])


def _read_binary_cameras(path: Path) -> Iterator[tuple[int, Camera]]:
    file = _Binary(path)
    for _ in range(file.take(_COUNT)[0]):
        camera_id, model_id, width, height = file.take(_CAMERA)
        if not 0 <= model_id < len(CAMERA_PARAMETERS):
            problem = f"camera {camera_id} has COLMAP's model {model_id}, which nerfstudio does not know: undistort the"
            raise InputError(f"{path}: {problem} images with `colmap image_undistorter`, or copy it again if damaged.")
        model = list(CAMERA_PARAMETERS)[model_id]
        yield camera_id, Camera(model, width, height, file.take(struct.Struct(f"<{CAMERA_PARAMETERS[model]}d")))


def _read_binary_poses(path: Path) -> Iterator[Pose]:
    file = _Binary(path)
    for _ in range(file.take(_COUNT)[0]):
        _, *pose, camera_id = file.take(_POSE)
        name = file.text()
        file.skip(24 * file.take(_COUNT)[0])  # The keypoints are not needed.
        yield name, camera_id, np.array(pose)


def _read_binary_points(path: Path) -> Points:
    file = _Binary(path)
    (count,), content, start, records = file.take(_COUNT), file.content, file.offset, []
    for _ in range(count):  # There may be millions, so nothing is called in here.
        record = content[start : start + _POINT.itemsize]
        records.append(record)
        start += _POINT.itemsize + 8 * int.from_bytes(record[-8:], "little")  # Its track follows it.
        if start > len(content):
            break
    file.skip(start - file.offset)
    points = np.frombuffer(b"".join(records), _POINT)
    return points["position"], points["color"].copy()


def _read_text(path: Path, minimum: int, numbered: bool = True) -> Iterator[tuple[list[str], Iterator[str]]]:
    """Yield the fields of each line of data, and the lines after it; if they are numbered, no two have one number."""
    numbers = set[str]()
    with path.open(encoding="utf8") as file:
        check_byte_order_mark(file.read(1), path)
        file.seek(0)
        for line in file:
            if line.strip() and not line.lstrip().startswith("#"):
                if len(fields := line.split()) < minimum:
                    raise ValueError(f"{minimum} fields expected in {line.strip()[:60]!r}")
                if fields[0] in numbers:
                    raise ValueError(f"two lines have the number {fields[0]}")
                numbers.add(fields[0] if numbered else "")
                yield fields, file


def _read_text_cameras(path: Path) -> Iterator[tuple[int, Camera]]:
    for fields, _ in _read_text(path, 5):
        yield int(fields[0]), Camera(fields[1], int(fields[2]), int(fields[3]), tuple(map(float, fields[4:])))


def _read_text_poses(path: Path) -> Iterator[Pose]:
    for fields, following in _read_text(path, 10):
        if len(fields) > 10:
            raise InputError(
                f"{path}: image {' '.join(fields[9:])!r} has a space in its name, where nerfstudio takes the name to "
                "end: write the model in binary (`colmap model_converter --output_type BIN`), or rename the image."
            )
        keypoints = next(following, "").split()
        if len(keypoints) % 3:  # Each has x, y and the number of its point.
            problem = f"{path}: the line after image {fields[9]!r} does not hold its keypoints"
            raise InputError(f"{problem}: each image needs such a line, which may be empty.")
        yield fields[9], int(fields[8]), np.array(fields[1:8], dtype=np.float64)


def _read_text_points(path: Path) -> Points:
    lines = [fields[1:7] for fields, _ in _read_text(path, 8, numbered=False)]
    positions, colors = np.hsplit(np.array(lines, np.float64).reshape(-1, 6), 2)
    if not ((colors >= 0) & (colors <= 255)).all():
        raise ValueError("a colour is not in 0 … 255")
    return positions, colors.astype(np.uint8)


@contextlib.contextmanager
def _errors_as_sentences(path: Path) -> Iterator[None]:
    try:
        yield
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"{path} cannot be read ({reason(error)}): copy the whole reconstruction.") from error
    except ValueError as error:
        why = f"{path} is not COLMAP's text ({reason(error)})"
        raise InputError(f"{why}: copy it again, or run COLMAP's mapper again.") from error


def model_kind(model: Path) -> str | None:
    """Return the kind of a folder's reconstruction, "txt", which nerfstudio prefers, or "bin"; None if it has none."""
    return next((kind for kind in ("txt", "bin") if (model / f"cameras.{kind}").is_file()), None)


def image_names(model: Path) -> list[str]:
    """Return the names of the images of a reconstruction in a folder; raises as `read_cameras`."""
    return [name for name, _, _ in read_poses(model / f"images.{model_kind(model) or 'bin'}")]


def read_cameras(path: Path) -> dict[int, Camera]:
    """Return the cameras of a `cameras.bin` or `cameras.txt` by their ids; raise InputError if it cannot be read."""
    with _errors_as_sentences(path):
        return dict((_read_binary_cameras if path.suffix == ".bin" else _read_text_cameras)(path))


def read_poses(path: Path) -> list[Pose]:
    """Return the poses of an `images.bin` or `images.txt`; raises as `read_cameras`."""
    with _errors_as_sentences(path):
        return list((_read_binary_poses if path.suffix == ".bin" else _read_text_poses)(path))


def points_file(model: Path) -> Path | None:
    """Return a reconstruction's file of points, or None; of several that of the cameras' kind, as is of one model."""
    kinds = (model_kind(model), "bin", "txt", "ply")
    return next((path for kind in kinds if (path := model / f"points3D.{kind}").is_file()), None)


def read_points(path: Path) -> Points:
    """Return the points of a `points3D.bin`, `.txt` or `.ply`; raises as `read_cameras`."""
    readers = {".bin": _read_binary_points, ".txt": _read_text_points, ".ply": ply.read_points}
    with _errors_as_sentences(path):
        return readers[path.suffix](path)
