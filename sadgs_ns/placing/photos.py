"""Checks that photos are whole, and converts those that COLMAP does not read."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import re
import shutil
import zlib
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image, ImageCms, ImageOps, UnidentifiedImageError

from sadgs_ns.data.images import NOT_UPRIGHT, SIDEWAYS, color_profile
from sadgs_ns.errors import InputError, reason
from sadgs_ns.placing.folder import COLMAP_FORMATS
from sadgs_ns.placing.panoramas import VIEWS, cut, is_panorama

_KEPT_SUFFIXES = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp"}  # COLMAP writes by these, and reads by content.
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
        suffix, size = "png" if self.has_alpha else "jpg", (self.size[1] // 2, self.size[1] // 2)
        names = [f"{self.name}/{i}.{suffix}" for i in range(VIEWS)]
        return [Photo(name, size, (), self.has_alpha) for name in names] if self.is_panorama else [self]


def photo_stamps(folder: Path, names: Sequence[str]) -> dict[str, list[int]]:
    """Return size in bytes, time of the last change in ns and checksum of the beginning of each photo or video."""

    def stamp(name: str) -> list[int]:
        status = (folder / name).stat()
        with (folder / name).open("rb") as file:
            return [status.st_size, status.st_mtime_ns, zlib.crc32(file.read(1 << 26))]

    with threads() as pool:
        return dict(zip(names, pool.map(stamp, names), strict=True))


def changes_of(folder: Path, stamps: Mapping[str, Sequence[int]], names: Sequence[str]) -> dict[str, str]:
    """Return what is "changed", "added" or "removed" among these photos since they were stamped, as ends of sentences.

    Those of the same size and time are not read. The same content at another time, as in a copy, is no change.
    """
    there = {name: (folder / name).stat() for name in names if name in stamps and (folder / name).exists()}
    touched = [name for name, now in there.items() if [now.st_size, now.st_mtime_ns] != list(stamps[name][:2])]
    now = photo_stamps(folder, touched)
    changed = {name for name in touched if (now[name][0], now[name][2]) != (stamps[name][0], stamps[name][2])}
    changes = {"changed": changed, "added": {*names} - stamps.keys(), "removed": stamps.keys() - {*names}}
    return {verb: f"{verb}: {len(n)}, such as {min(n) or folder.name}" for verb, n in changes.items() if n}


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


def convert_photos(folder: Path, photos: Sequence[Photo], converted: Path) -> tuple[Path, list[Photo]]:
    """Convert photos that COLMAP does not read, turn those that are not upright, and cut panoramas.

    The folder `converted` then holds conversions, and links to the other photos, unless it exists already. Return the
    folder of photos that COLMAP reads, and the photos and views in it. Raise InputError if one would replace another.
    """

    def converted_name(photo: Photo) -> str:
        suffix = Path(photo.name).suffix.lower()
        if suffix in _KEPT_SUFFIXES and not (photo.has_alpha and suffix in (".jpg", ".jpeg")):
            return photo.name
        return photo.name + (".png" if photo.has_alpha else ".jpg")

    new = [dataclasses.replace(view, name=converted_name(view)) for photo in photos for view in photo.views]
    if doubles := [name for name, number in Counter(view.name for view in new).items() if number > 1]:
        raise InputError(f"{folder}: converted, two photos would be called {doubles[0]}; rename one of them.")
    if new == list(photos) and all(photo.is_read and not photo.is_turned for photo in photos):
        return folder, new
    if converted.exists():
        return converted, new
    partial = empty_folder(converted.with_name(f"{converted.name}.partial"))

    def convert(photo: Photo) -> None:
        source = Path(os.path.realpath(folder / photo.name))
        targets = [partial / converted_name(view) for view in photo.views]
        targets[0].parent.mkdir(parents=True, exist_ok=True)
        if photo.is_turned or not photo.is_read or photo.is_panorama:
            with Image.open(source) as image:
                exif = Image.Exif() if image.format == "TIFF" else image.getexif()  # A TIFF's tells of its pixels, too.
                image.info.pop("exif", None)  # Pillow would write it anew, which fails where it is damaged.
                pixels = ImageOps.exif_transpose(image) if photo.is_turned else image
                exif.pop(ExifTags.Base.Orientation, None)
                kept = b""
                with contextlib.suppress(Exception):  # Pillow raises anything where EXIF is damaged.
                    kept = exif.tobytes()
                if pixels.mode != "I;16":
                    pixels = _in_srgb(pixels, "RGBA" if photo.has_alpha else "RGB")
                for part, target in zip(cut(pixels) if photo.is_panorama else [pixels], targets, strict=True):
                    part.save(target, exif=kept, quality=97, subsampling=0)  # the latter two for JPEG alone
            return
        try:
            targets[0].symlink_to(source)
        except OSError:  # Some file systems hold no links.
            shutil.copyfile(source, targets[0])

    with threads() as pool:
        list(pool.map(convert, photos))
    partial.rename(converted)
    return converted, new


def _in_srgb(image: Image.Image, mode: str) -> Image.Image:
    """Convert an image to RGB or RGBA in sRGB, since training and viewers know no profiles."""
    if (profile := color_profile(image)) is None:
        return image.convert(mode)
    image = image if image.mode == "CMYK" else image.convert(mode)
    with contextlib.suppress(ImageCms.PyCMSError):  # The profile is of another kind of pixels.
        image = ImageCms.profileToProfile(image, profile, ImageCms.createProfile("sRGB"), outputMode=mode) or image
    return image.convert(mode)


def write_alpha(folder: Path, photos: Sequence[Photo], alphas: Path) -> int:
    """Empty `alphas`, write the opacity of each partly transparent photo `NAME` there as `NAME.png`, and count them."""
    empty_folder(alphas)
    for photo in photos:
        if photo.has_alpha:
            with Image.open(folder / photo.name) as image:
                alpha = image.convert("RGBA").getchannel("A")
            if alpha.getextrema() != (255, 255):
                target = alphas / f"{photo.name}.png"
                target.parent.mkdir(parents=True, exist_ok=True)
                alpha.save(target)
    return sum(1 for _ in alphas.rglob("*.png"))


def write_masks(
    folder: Path, masks: Mapping[str, str], photos: Sequence[Photo], converted: Sequence[Photo], target: Path
) -> None:
    """Write a mask for each photo `NAME` as it was `converted`, `NAME.png` in `target`, a white one if it has none.

    Raise InputError if a mask has another shape than its photo.
    """
    names = iter(f"{photo.name}.png" for photo in converted)
    for photo in photos:
        mask = Image.new("L", photo.size, 255)
        if photo.name in masks:
            with Image.open(folder / masks[photo.name]) as image, Image.open(folder / photo.name) as stored:
                grey = np.asarray(image.convert("L"))
                mask = Image.fromarray(np.uint8(255 * (grey > grey.max() // 2)))
                if photo.is_turned and (mask.width > mask.height) != (photo.size[0] > photo.size[1]):
                    mask.getexif()[ExifTags.Base.Orientation] = stored.getexif()[ExifTags.Base.Orientation]
                    mask = ImageOps.exif_transpose(mask)
        if not 0.97 < mask.width * photo.size[1] / (mask.height * photo.size[0]) < 1.03:
            problem = f"{folder / masks[photo.name]} has another shape than {photo.name}, whose mask it is by its name"
            raise InputError(f"{problem}: make it of the whole photo, or take it out of the folder.")
        mask = mask.resize(photo.size, Image.Resampling.NEAREST)
        for part, name in zip(cut(mask) if photo.is_panorama else [mask], names, strict=False):
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            part.save(target / name)


def restore_alpha(images: Path, alphas: Path) -> None:
    """Give those images that exist the opacity that `write_alpha` wrote, which has their size."""
    for path in alphas.rglob("*.png"):
        if (target := images / path.relative_to(alphas).with_suffix("")).exists():
            with Image.open(target) as image, Image.open(path) as alpha:
                pixels = image.convert("RGB")
                pixels.putalpha(alpha.convert("L"))
            pixels.save(target)


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
