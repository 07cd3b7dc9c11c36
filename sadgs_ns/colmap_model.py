"""What a COLMAP model must be before nerfstudio may read it: of counts that its files hold, and of harmless names.

nerfstudio allocates what a count in `images.bin` or `points3D.bin` asks for before it looks for the data (a flipped bit
is then gigabytes), and passes the images' names to a shell and to the file system when it downscales or renders.
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from os.path import commonpath
from pathlib import Path, PurePosixPath

_SHELL = set('"$`\\')
"""What a shell reads within double quotes, which are all that nerfstudio puts around a name."""


def check(folder: Path) -> None:
    """Walk through the files of a model that are there, without keeping what they hold.

    Args:
        folder: Of `images.bin` and `points3D.bin`, or `images.txt`.

    Raises:
        ValueError: A file ends within an entry, or an image has a name that leaves the images' folder or that a shell
            would act on; one sentence that names the file.
    """
    images, text, points = folder / "images.bin", folder / "images.txt", folder / "points3D.bin"
    if (folder / "cameras.txt").exists():  # nerfstudio prefers it
        if text.is_file():
            _check_names(_names_in_text(text), text)
    elif images.is_file():
        with _mapped(images) as data:
            _check_names(_names_in(data, images), images)
    if points.is_file():
        with _mapped(points) as data:
            _check_points(data, points)


def check_paths(paths: Sequence[Path]) -> None:
    """Refuse images of which one lies outside the folder that all have in common, by way of "..".

    `ns-render dataset` writes each below its output folder under its path from there.

    Raises:
        ValueError: Names the first such path.
    """
    if not paths or len({path.is_absolute() for path in paths}) > 1:
        return
    shared = commonpath(paths)
    for path in paths:
        if ".." in path.relative_to(shared).parts:
            raise ValueError(f"{path} leads out of {shared}, where the other images are; name it without '..'.")


@contextmanager
def _mapped(path: Path) -> Iterator[mmap.mmap]:
    with path.open("rb") as file:
        try:
            data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        except ValueError as error:  # nothing to map
            raise ValueError(f"{path} is empty; copy or reconstruct the COLMAP model again.") from error
        with data:
            yield data


def _ends_early(path: Path, what: str) -> ValueError:
    return ValueError(f"{path} ends within {what}, so it is damaged; copy or reconstruct the COLMAP model again.")


def _count(data: mmap.mmap, at: int, path: Path, what: str) -> int:
    try:
        return struct.unpack_from("<Q", data, at)[0]
    except struct.error as error:
        raise _ends_early(path, what) from error


def _names_in(data: mmap.mmap, path: Path) -> Iterator[str]:
    images, at = _count(data, 0, path, "its header"), 8
    for index in range(images):
        what = f"image {index + 1} of {images}"
        start = at + 64  # number, pose and camera
        end = data.find(b"\0", start)
        if end < 0:
            raise _ends_early(path, what)
        at = end + 9 + 24 * _count(data, end + 1, path, what)
        if at > len(data):
            raise _ends_early(path, what)
        try:
            yield data[start:end].decode()
        except UnicodeDecodeError as error:
            raise ValueError(f"{path}: the name of {what} is not UTF-8; rename it and reconstruct again.") from error


def _check_points(data: mmap.mmap, path: Path) -> None:
    points, at, size, read = _count(data, 0, path, "its header"), 8, len(data), struct.Struct("<Q").unpack_from
    for index in range(points):  # there may be millions
        if at + 51 > size:
            raise _ends_early(path, f"point {index + 1} of {points}")
        at += 51 + 8 * read(data, at + 43)[0]
    if at > size:
        raise _ends_early(path, f"the tracks of its {points} points")


def _names_in_text(path: Path) -> Iterator[str]:
    # Line by line as nerfstudio reads it, so that both see the same names: an image, then its keypoints.
    with path.open(encoding="utf8", errors="replace") as file:
        for line in file:
            words = line.split()
            if not words or words[0].startswith("#"):
                continue
            if len(words) < 10:
                raise ValueError(f"{path}: {line[:80]!r} is not a line of an image; reconstruct the model again.")
            yield words[9]
            next(file, None)


def _check_names(names: Iterable[str], path: Path) -> None:
    for name in names:
        if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
            raise ValueError(f"{path}: the image {name!r} lies outside the folder of images; move it in, or rename it.")
        if _SHELL & set(name) or not name.isprintable():
            raise ValueError(f"{path}: the image's name {name!r} holds what a shell would act on; rename the image.")
