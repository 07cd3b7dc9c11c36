"""Reads photos, checks that they are whole, and groups them by camera."""

from __future__ import annotations

import contextlib
import dataclasses
import re
import shutil
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image, UnidentifiedImageError

from sadgs_ns.data.images import NOT_UPRIGHT, SIDEWAYS, color_profile
from sadgs_ns.errors import InputError, reason
from sadgs_ns.placing.folder import COLMAP_FORMATS
from sadgs_ns.placing.panoramas import VIEWS, is_panorama

_FOCAL_LENGTHS = (ExifTags.Base.FocalLength, ExifTags.Base.FocalLengthIn35mmFilm, ExifTags.Base.DigitalZoomRatio)
"""Of a phone's digital zoom one of the last two alone tells, by its make."""
_NAMED = 20  # How many unreadable photos a message names


@dataclasses.dataclass(frozen=True)
class Photo:
    """The content of a photo's header."""

    name: str  # Relative to the folder of the photos
    size: tuple[int, int]  # Width and height in px, upright
    camera: tuple  # Equal for photos by one camera at one focal length, as far as size and EXIF tell
    has_alpha: bool  # Whether some pixels may be transparent
    is_read: bool = True  # Whether COLMAP reads its format, and its colours need no conversion
    is_turned: bool = False  # Whether EXIF says that the pixels are to be turned or mirrored to be upright
    is_panorama: bool = False

    @property
    def views(self) -> list[Photo]:
        """The views that a panorama is cut into, without a camera of their own; another photo is its own view."""
        suffix = "png" if self.has_alpha else "jpg"
        size = (self.size[1] // 2, self.size[1] // 2)
        names = [f"{self.name}/{i}.{suffix}" for i in range(VIEWS)]
        return [Photo(name, size, (), self.has_alpha) for name in names] if self.is_panorama else [self]


def read_photos(folder: Path, names: Sequence[str], report: Callable[[str, int, int], None]) -> list[Photo]:
    """Read and decode photos, since COLMAP takes a missing end for black; raise InputError that names broken ones."""
    photos: list[Photo] = []
    broken: list[str] = []

    def read(name: str) -> Photo | str:
        try:
            return _read_photo(folder, name)
        except UnidentifiedImageError:
            why = "no image that Pillow knows" if (folder / name).stat().st_size else "0 bytes"
        except Exception as error:  # Decoders raise whatever they stumble over.
            why = reason(error)
        return f"{name} ({why})"

    with threads() as pool:
        for done, found in enumerate(pool.map(read, names), 1):
            photos.append(found) if isinstance(found, Photo) else broken.append(found)
            report("photos", done, len(names))
    if broken:
        more = [f"{len(broken) - _NAMED} more"] if len(broken) > _NAMED else []
        them = "it" if len(broken) == 1 else "them"
        problem = f"{len(broken)} of the {len(names)} photos in {folder} cannot be read as a whole image"
        raise InputError(f"{problem}: {', '.join(broken[:_NAMED] + more)}; copy {them} again or remove {them}.")
    looks: dict[tuple[int, int], list[bool]] = defaultdict(list)
    for photo in photos:
        looks[photo.size].append(photo.is_panorama)
    # Of one size all are panoramas or none is, because single ones may look otherwise.
    return [dataclasses.replace(photo, is_panorama=bool(np.mean(looks[photo.size]) >= 0.5)) for photo in photos]


@contextlib.contextmanager
def threads(number: int | None = None) -> Iterator[ThreadPoolExecutor]:
    """Make threads that drop their waiting work when the block raises, as at an interrupt."""
    pool = ThreadPoolExecutor(number)
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)


def _read_photo(folder: Path, name: str) -> Photo:
    with Image.open(folder / name) as image:
        exif = image.getexif()
        orientation = exif.get(ExifTags.Base.Orientation)
        width, height = image.size
        size = (height, width) if orientation in SIDEWAYS and image.format != "TIFF" else image.size
        lens = exif.get_ifd(ExifTags.IFD.Exif)
        focals = [str(lens.get(tag) or None) for tag in _FOCAL_LENGTHS]  # as text: 0/0 is not equal to itself
        camera = size, exif.get(ExifTags.Base.Make), exif.get(ExifTags.Base.Model), *focals
        has_alpha = image.has_transparency_data
        is_read = image.format in COLMAP_FORMATS and image.mode not in ("CMYK", "LAB")  # A TIFF would stay CMYK.
        is_read &= color_profile(image) is None
        # An eighth of a JPEG's size tells whether it is whole, but not whether it is a panorama.
        least = 512 if width == 2 * height else 0
        image.draft("RGB", (max(least, width // 8), max(least // 2, height // 8)))
        image.load()
        return Photo(name, size, camera, has_alpha, is_read, orientation in NOT_UPRIGHT, is_panorama(image, size))


def empty_folder(folder: Path) -> Path:
    """Make a folder anew, and return it."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder


def photos_by_camera(photos: Sequence[Photo]) -> list[list[str]]:
    """Group the names of photos by their camera."""
    groups: dict[tuple, list[str]] = defaultdict(list)
    for photo in photos:
        groups[photo.camera].append(photo.name)
    return list(groups.values())


def in_order(names: Sequence[str]) -> list[str]:
    """Sort names so that photo 10 comes after photo 9."""
    parts = {name: re.split(r"(\d+)", name) for name in names}
    return sorted(names, key=lambda name: [int(part) if part.isdecimal() else part for part in parts[name]])
