"""Readers of COLMAP's reconstructions, text and binary, as far as checks and training need them.

The readers of nerfstudio and pycolmap trust the files, and ask for terabytes if a length is corrupt. These readers do
not. They take a tenth of the time of nerfstudio's, which is less than the import of pycolmap takes.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from sadgs_ns.data import ply
from sadgs_ns.data.text import check_byte_order_mark
from sadgs_ns.errors import InputError, reason

CAMERA_PARAMETERS = {
    "SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8, "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12, "FOV": 5, "SIMPLE_RADIAL_FISHEYE": 4, "RADIAL_FISHEYE": 5, "THIN_PRISM_FISHEYE": 12,
}  # fmt: skip
"""Number of parameters of each of COLMAP's camera models, in the order of the models' ids."""

Points = tuple[NDArray[np.float64], NDArray[np.uint8]]  # Positions [P, 3] and colours in 0 … 255 [P, 3]
Tracks = tuple[NDArray[np.int64], NDArray[np.int64]]  # Ids of images [K], and which point each sees, from 0 [K]
Pose = tuple[str, int, NDArray[np.float64]]
"""An image's name, its camera's id, and the wxyz quaternion and translation from world to camera. [7]"""


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
        self.path = path
        self.offset = 0  # Of the next item, in bytes
        self.content: mmap | bytes = b""
        with path.open("rb") as file:
            if path.stat().st_size > 0:  # An empty file cannot be mapped.
                self.content = mmap(file.fileno(), 0, access=ACCESS_READ)

    def corrupt(self, detail: str) -> InputError:
        """Return the error for content that makes no sense."""
        return InputError(f"{self.path} is cut off or corrupt ({detail}): copy it again, or run COLMAP's mapper again.")

    def count(self) -> int:
        """Return the next number of items."""
        (number,) = self.take(_COUNT)
        return number

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
        start = self.offset
        end = self.content.find(b"\0", start, start + 4096)
        if end < 0:
            raise self.corrupt(f"at byte {start} there is no image's name")
        self.offset = end + 1
        try:
            return self.content[start:end].decode("utf8")
        except UnicodeDecodeError:
            raise self.corrupt(f"at byte {start} there is no image's name") from None


_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<iiQQ")
_POSE = struct.Struct("<i7di")
_POINT = np.dtype([("id", "<u8"), ("position", "<f8", 3), ("color", "u1", 3), ("error", "<f8"), ("track", "<u8")])
_TRACK = np.dtype([("image", "<u4"), ("keypoint", "<u4")])
KEYPOINT = np.dtype([("place", "<f8", 2), ("point", "<i8")])
"""A keypoint in an `images.bin`: its place in px, and the id of its point, −1 without."""


def _read_binary_cameras(path: Path) -> Iterator[tuple[int, Camera]]:
    file = _Binary(path)
    models = list(CAMERA_PARAMETERS)
    for _ in range(file.count()):
        camera_id, model_id, width, height = file.take(_CAMERA)
        if not 0 <= model_id < len(models):
            problem = f"{path}: camera {camera_id} has COLMAP's model {model_id}, which nerfstudio does not know"
            remedy = "undistort the images with `colmap image_undistorter`, or copy it again if damaged"
            raise InputError(f"{problem}: {remedy}.")
        model = models[model_id]
        params = file.take(struct.Struct(f"<{CAMERA_PARAMETERS[model]}d"))
        yield camera_id, Camera(model, width, height, params)


class Keypoints(NamedTuple):
    """Where the keypoints of an image lie in an `images.bin`."""

    camera_id: int
    start: int  # Of the first one, in bytes
    count: int


def _read_binary_images(path: Path) -> Iterator[tuple[int, Pose, Keypoints]]:
    file = _Binary(path)
    for _ in range(file.count()):
        image_id, *pose, camera_id = file.take(_POSE)
        name = file.text()
        count = file.count()
        keypoints = Keypoints(camera_id, file.offset, count)
        file.skip(KEYPOINT.itemsize * count)
        yield image_id, (name, camera_id, np.array(pose)), keypoints


def _read_binary_poses(path: Path) -> Iterator[tuple[int, Pose]]:
    for image_id, pose, _ in _read_binary_images(path):
        yield image_id, pose


def _split_binary_points(path: Path) -> tuple[list[bytes], list[bytes]]:
    """Return the record of each point, and the bytes of its track."""
    file = _Binary(path)
    count = file.count()
    content = file.content
    start = file.offset
    records = []
    tracks = []
    for _ in range(count):  # There may be millions, so no function of this module is called in here.
        end = start + _POINT.itemsize
        record = content[start:end]
        records.append(record)
        track_length = int.from_bytes(record[-8:], "little")
        start = end + 8 * track_length  # The track follows the record.
        if start > len(content):
            break
        tracks.append(content[end:start])
    file.skip(start - file.offset)  # This raises the error if the file ends too early.
    return records, tracks


def _read_binary_points(path: Path) -> Points:
    records, _ = _split_binary_points(path)
    points = np.frombuffer(b"".join(records), _POINT)
    return points["position"], points["color"].copy()


def _read_binary_tracks(path: Path) -> Tracks:
    _, tracks = _split_binary_points(path)
    lengths = [len(track) // _TRACK.itemsize for track in tracks]
    images = np.frombuffer(b"".join(tracks), _TRACK)["image"]
    return images.astype(np.int64), np.repeat(np.arange(len(tracks)), lengths)


def _read_text(path: Path, minimum: int, numbered: bool = True) -> Iterator[tuple[list[str], Iterator[str]]]:
    """Yield the fields of each line that is no comment, and an iterator over the lines after it.

    Lines that the caller takes from this iterator are not yielded. Raise ValueError for a line with fewer fields than
    the minimum, and, if lines are numbered by their first fields, for two lines with the same number.
    """
    numbers = set[str]()
    with path.open(encoding="utf8") as file:
        check_byte_order_mark(file.read(1), path)
        file.seek(0)
        for line in file:
            fields = line.split()
            if not fields or fields[0].startswith("#"):
                continue
            if len(fields) < minimum:
                raise ValueError(f"{minimum} fields expected in {line.strip()[:60]!r}")
            if numbered:
                if fields[0] in numbers:
                    raise ValueError(f"two lines have the number {fields[0]}")
                numbers.add(fields[0])
            yield fields, file


def _read_text_cameras(path: Path) -> Iterator[tuple[int, Camera]]:
    for fields, _ in _read_text(path, 5):
        params = tuple(float(field) for field in fields[4:])
        yield int(fields[0]), Camera(fields[1], int(fields[2]), int(fields[3]), params)


def _read_text_poses(path: Path) -> Iterator[tuple[int, Pose]]:
    for fields, following in _read_text(path, 10):
        if len(fields) > 10:
            name = " ".join(fields[9:])
            problem = f"{path}: image {name!r} has a space in its name, where nerfstudio takes the name to end"
            remedy = "write the model in binary (`colmap model_converter --output_type BIN`), or rename the image"
            raise InputError(f"{problem}: {remedy}.")
        keypoints = next(following, "").split()
        if len(keypoints) % 3 != 0:  # Each has x, y and the number of its point.
            problem = f"{path}: the line after image {fields[9]!r} does not hold its keypoints"
            raise InputError(f"{problem}: each image needs such a line, which may be empty.")
        yield int(fields[0]), (fields[9], int(fields[8]), np.array(fields[1:8], dtype=np.float64))


def _read_text_points(path: Path) -> Points:
    lines = [fields[1:7] for fields, _ in _read_text(path, 8, numbered=False)]
    values = np.array(lines, np.float64).reshape(-1, 6)
    positions, colors = np.hsplit(values, 2)
    if not ((colors >= 0) & (colors <= 255)).all():
        raise ValueError("a colour is not in 0 … 255")
    return positions, colors.astype(np.uint8)


def _read_text_tracks(path: Path) -> Tracks:
    tracks = [fields[8::2] for fields, _ in _read_text(path, 8, numbered=False)]
    lengths = [len(track) for track in tracks]
    images = np.array(list(chain.from_iterable(tracks)), np.int64)
    return images, np.repeat(np.arange(len(tracks)), lengths)


@contextlib.contextmanager
def _errors_as_sentences(path: Path) -> Iterator[None]:
    try:
        yield
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"{path} cannot be read ({reason(error)}): copy the whole reconstruction.") from error
    except ValueError as error:
        problem = f"{path} is not COLMAP's text ({reason(error)})"
        raise InputError(f"{problem}: copy it again, or run COLMAP's mapper again.") from error


def model_kind(model: Path) -> str | None:
    """Return the kind of a folder's reconstruction, "txt", which nerfstudio prefers, or "bin"; None if it has none."""
    for kind in ("txt", "bin"):
        if (model / f"cameras.{kind}").is_file():
            return kind
    return None


def image_names(model: Path) -> list[str]:
    """Return the names of the images of a reconstruction in a folder; raises as `read_cameras`."""
    kind = model_kind(model) or "bin"
    return [name for name, _, _ in read_poses(model / f"images.{kind}")]


def read_cameras(path: Path) -> dict[int, Camera]:
    """Return the cameras of a `cameras.bin` or `cameras.txt` by their ids; raise InputError if it cannot be read."""
    with _errors_as_sentences(path):
        if path.suffix == ".bin":
            return dict(_read_binary_cameras(path))
        return dict(_read_text_cameras(path))


def read_poses(path: Path) -> list[Pose]:
    """Return the poses of an `images.bin` or `images.txt`; raises as `read_cameras`."""
    return [pose for _, pose in _read_numbered_poses(path)]


def read_image_ids(path: Path) -> dict[int, str]:
    """Return the images' names of an `images.bin` or `images.txt` by their ids; raises as `read_cameras`."""
    return {image_id: name for image_id, (name, _, _) in _read_numbered_poses(path)}


def find_keypoints(path: Path) -> list[Keypoints]:
    """Return where the keypoints of each image lie in an `images.bin`; raises as `read_cameras`."""
    with _errors_as_sentences(path):
        return [keypoints for _, _, keypoints in _read_binary_images(path)]


def _read_numbered_poses(path: Path) -> list[tuple[int, Pose]]:
    with _errors_as_sentences(path):
        if path.suffix == ".bin":
            return list(_read_binary_poses(path))
        return list(_read_text_poses(path))


def points_file(model: Path) -> Path | None:
    """Return a reconstruction's file of points, or None.

    A file of the same kind as that of the cameras is taken first, as it is sure to be of the same model.
    """
    for kind in (model_kind(model), "bin", "txt", "ply"):
        path = model / f"points3D.{kind}"
        if path.is_file():
            return path
    return None


def read_points(path: Path) -> Points:
    """Return the points of a `points3D.bin`, `.txt` or `.ply`; raises as `read_cameras`."""
    readers = {".bin": _read_binary_points, ".txt": _read_text_points, ".ply": ply.read_points}
    with _errors_as_sentences(path):
        return readers[path.suffix](path)


def read_tracks(path: Path) -> Tracks:
    """Return which images see which points of a `points3D.bin` or `.txt`; raises as `read_cameras`.

    The points are numbered in the order of `read_points`. Other files have no tracks.
    """
    with _errors_as_sentences(path):
        if path.suffix == ".bin":
            return _read_binary_tracks(path)
        if path.suffix == ".txt":
            return _read_text_tracks(path)
    return np.zeros(0, np.int64), np.zeros(0, np.int64)
