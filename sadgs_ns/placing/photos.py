"""Reads photos, checks that they are whole, and groups them by camera."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import re
import shutil
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image, UnidentifiedImageError

from sadgs_ns.data.images import NOT_UPRIGHT, SIDEWAYS
from sadgs_ns.errors import InputError, reason
from sadgs_ns.host import available_host_bytes, num_cores
from sadgs_ns.placing.bit_depth import largest_value
from sadgs_ns.placing.colours import profile_of
from sadgs_ns.placing.folder import COLMAP_FORMATS
from sadgs_ns.placing.panoramas import VIEWS, is_fisheye_pair, is_panorama

_FOCAL_LENGTHS = (ExifTags.Base.FocalLength, ExifTags.Base.FocalLengthIn35mmFilm, ExifTags.Base.DigitalZoomRatio)
"""Of a phone's digital zoom one of the last two alone tells, by its make."""
_NO_FOCAL_LENGTH = ("None", "nan")  # A focal length in `Photo.camera` that EXIF does not tell
_LARGE_FOLDER = 10  # Least number of photos of a folder that has a camera of its own
_PAIRS_SHARE = 0.5  # Share of the photos that look like pairs of fisheye circles from which they are refused
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
    is_fisheye_pair: bool = False  # Whether it shows two fisheye circles, of which no panorama was made yet
    has_focal_length: bool = False  # Whether EXIF tells one
    largest_value: int | None = None  # Of its colours if its file has more than 8 bits a value
    bit_depth: int | None = None  # Bits that its values use if these are to be scaled

    @property
    def views(self) -> list[Photo]:
        """The views that a panorama is cut into, without a camera of their own; another photo is its own view."""
        if not self.is_panorama:
            return [self]
        suffix = "jpg"
        if self.has_alpha:
            suffix = "png"
        side = self.size[1] // 2
        names = [f"{self.name}/{i}.{suffix}" for i in range(VIEWS)]
        return [Photo(name, (side, side), (), self.has_alpha) for name in names]


def read_photos(folder: Path, names: Sequence[str], report: Callable[[str, int, int], None]) -> list[Photo]:
    """Read and decode photos, since COLMAP takes a missing end for black; raise InputError that names broken ones."""
    photos: list[Photo] = []
    broken: list[str] = []

    def read(name: str) -> Photo | str:
        try:
            return _read_photo(folder, name)
        except UnidentifiedImageError:
            problem = "no image that Pillow knows"
            if (folder / name).stat().st_size == 0:
                problem = "0 bytes"
        except Exception as error:  # Decoders raise whatever they stumble over.
            problem = reason(error)
        return f"{name} ({problem})"

    with threads() as pool:
        for done, found in enumerate(pool.map(read, names), 1):
            if isinstance(found, Photo):
                photos.append(found)
            else:
                broken.append(found)
            report("photos", done, len(names))
    if broken:
        raise InputError(_explain_broken(folder, broken, len(names)))
    pairs = [photo.name for photo in photos if photo.is_fisheye_pair]
    if len(pairs) >= _PAIRS_SHARE * len(photos) > 0:
        raise InputError(_explain_fisheye_pairs(folder, pairs, len(names)))
    looks: dict[tuple[int, int], list[bool]] = defaultdict(list)
    for photo in photos:
        looks[photo.size].append(photo.is_panorama)
    # Of one size all are panoramas or none is, because single ones may look otherwise.
    sizes_of_panoramas = {size for size, votes in looks.items() if np.mean(votes) >= 0.5}
    return [dataclasses.replace(photo, is_panorama=photo.size in sizes_of_panoramas) for photo in photos]


def _explain_broken(folder: Path, broken: Sequence[str], total: int) -> str:
    """Return the sentence on photos that cannot be read, given each one's name and problem."""
    shown = list(broken[:_NAMED])
    if len(broken) > _NAMED:
        shown.append(f"{len(broken) - _NAMED} more")
    them = "them"
    if len(broken) == 1:
        them = "it"
    problem = f"{len(broken)} of the {total} photos in {folder} cannot be read as a whole image"
    return f"{problem}: {', '.join(shown)}; copy {them} again or remove {them}."


def _explain_fisheye_pairs(folder: Path, pairs: Sequence[str], total: int) -> str:
    """Return the sentence on photos that are pairs of fisheye circles, given their names."""
    found = f"{len(pairs)} of the {total} photos in {folder}, such as {pairs[0]}, show two fisheye circles side by side"
    remedy = "stitch them to panoramas of 2:1 with the camera's program, or let it export flat photos, and give those"
    return f"{found}, whose cameras come out wrong: {remedy}."


@contextlib.contextmanager
def threads(number: int | None = None) -> Iterator[ThreadPoolExecutor]:
    """Make threads that drop their waiting work when the block raises, as at an interrupt."""
    pool = ThreadPoolExecutor(number)
    try:
        yield pool
    finally:
        pool.shutdown(cancel_futures=True)


def threads_in_memory(bytes_of_photo: float) -> int:
    """Return how many photos are worked on at a time: one on each core, if half of the free memory holds them."""
    at_a_time = 0.5 * available_host_bytes() / bytes_of_photo
    return max(1, int(min(num_cores(), at_a_time)))


def _read_photo(folder: Path, name: str) -> Photo:
    with Image.open(folder / name) as image:
        exif = image.getexif()
        orientation = exif.get(ExifTags.Base.Orientation)
        width, height = image.size
        size = (width, height)
        if orientation in SIDEWAYS and image.format != "TIFF":
            size = (height, width)
        lens = exif.get_ifd(ExifTags.IFD.Exif)
        focals = [str(lens.get(tag) or None) for tag in _FOCAL_LENGTHS]  # as text: 0/0 is not equal to itself
        has_focal_length = any(focal not in _NO_FOCAL_LENGTH for focal in focals[:2])
        camera = (size, exif.get(ExifTags.Base.Make), exif.get(ExifTags.Base.Model), *focals)
        has_alpha = image.has_transparency_data
        is_read = image.format in COLMAP_FORMATS and image.mode not in ("CMYK", "LAB")  # A TIFF would stay CMYK.
        if profile_of(image) is not None:
            is_read = False
        # An eighth of a JPEG's size tells whether it is whole, but not whether it is a panorama.
        draft_width = width // 8
        draft_height = height // 8
        if width == 2 * height:
            draft_width = max(512, draft_width)
            draft_height = max(256, draft_height)
        image.draft("RGB", (draft_width, draft_height))
        image.load()
        is_turned = orientation in NOT_UPRIGHT
        is_whole_view = is_panorama(image, size)
        is_pair = not is_whole_view and is_fisheye_pair(image, size)
        largest = largest_value(image, folder / name)
        return Photo(
            name, size, camera, has_alpha, is_read, is_turned, is_whole_view, is_pair, has_focal_length, largest
        )


def empty_folder(folder: Path) -> Path:
    """Make a folder anew, and return it."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder


def photos_by_camera(photos: Sequence[Photo]) -> list[list[str]]:
    """Group the names of photos by their camera, as far as size and EXIF tell."""
    groups: dict[tuple, list[str]] = defaultdict(list)
    for photo in photos:
        groups[photo.camera].append(photo.name)
    return list(groups.values())


def photos_by_camera_and_folder(photos: Sequence[Photo]) -> list[list[str]]:
    """Group the names of photos as `photos_by_camera` does, and by folder where EXIF tells no focal length.

    Two cameras of one size often have a folder each. Folders of fewer than ten photos tell too little of a camera: they
    share one, and where a single folder has more, they share its camera.
    """
    counts = Counter((photo.camera, _folder(photo)) for photo in photos)
    large_folders = Counter(camera for (camera, _), count in counts.items() if count >= _LARGE_FOLDER)
    groups: dict[tuple, list[str]] = defaultdict(list)
    for photo in photos:
        folder = ""
        is_large = counts[photo.camera, _folder(photo)] >= _LARGE_FOLDER
        if is_large and large_folders[photo.camera] > 1 and not photo.has_focal_length:
            folder = f"{_folder(photo)}/"
        groups[(photo.camera, folder)].append(photo.name)
    return list(groups.values())


def _folder(photo: Photo) -> str:
    """Return the folder of a photo, relative to the folder of all."""
    return os.path.dirname(photo.name)


def in_order(names: Sequence[str]) -> list[str]:
    """Sort names so that photo 10 comes after photo 9."""
    return sorted(names, key=_parts)


def _parts(name: str) -> list[str | int]:
    """Divide a name into its numbers and what stands between them."""
    parts: list[str | int] = list(re.split(r"(\d+)", name))
    for i in range(1, len(parts), 2):  # Every other part is a number.
        parts[i] = int(parts[i])
    return parts
