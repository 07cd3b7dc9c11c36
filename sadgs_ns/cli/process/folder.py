"""Finds the photos of a folder and their masks, and tells of what else is there."""

from __future__ import annotations

import contextlib
import filecmp
import math
import os
import re
from collections import defaultdict
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image, ImageOps

from sadgs_ns.cli.program import read_settings
from sadgs_ns.data import IMAGE_SUFFIXES
from sadgs_ns.data.checks.images import image_size

COLMAP_FORMATS = {"JPEG", "MPO", "PNG", "BMP", "TIFF"}
"""Pillow's names of the formats that COLMAP and OpenCV read."""
_FORMATS = COLMAP_FORMATS | {"WEBP", "AVIF"}
_NOT_READ = "images that are not read (make them .jpg or .png files)"
_UNREAD = {".heic", ".heif", ".jxl", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw"}
"""Suffixes of formats that are not read, by which programs also call JPEG; Pillow takes previews of some for TIFF."""
_SERVICE = re.compile(r"(.*/)?(@eadir|@__thumb|[@#$]recycle(\.bin)?|__macosx|lost\+found)/.*", re.IGNORECASE)
"""Files in folders that network drives and operating systems keep of thumbnails and of what was deleted."""
_MASK = re.compile(r"(.*/)?masks?(_\d+)?/.*|.*[ ._-]mask\.\w+", re.IGNORECASE)
_VARIANT = re.compile(r"(?<=^img_)e(?=\d)|[ ._-]*(mask|edited|copy|thumb|small|\(\d+\))$")
"""What programs add to a photo's name for its mask or a copy; an iPhone's IMG_E1234 is the edited IMG_1234."""
_SAME = 0.99
"""Correlation above which two images of 16 × 16 px show the same; smaller copies of photos reach .999."""


@dataclass(frozen=True)
class Found:
    """Photos of a folder and their masks, by names relative to it, and sentences on other images."""

    photos: list[str]
    masks: dict[str, str]
    told: list[str]


def look_into(source: Path, out: Path) -> Found:
    """Find the photos of a folder, and their masks, for a scene; photos that it was begun with stay photos.

    Hidden files, as macOS writes them, and those of scenes that are made in the same folder are left out.
    """
    folder, scene = Path(os.path.realpath(source)), Path(os.path.realpath(out))
    scenes = {scene, *(path.parents[1] for path in folder.glob("*/**/work/settings.json"))}
    known = {*read_settings(out / "work" / "settings.json", out).get("photos", [])}
    found, stems, masks = defaultdict(list), defaultdict(list), {}
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder).as_posix()
        if scenes.isdisjoint(path.parents) and "/." not in f"/{name}" and (kind := _kind(path)):
            if kind == "photos" and name not in known:
                kind = "thumbnails or trash" if _SERVICE.fullmatch(name) else "masks" if _MASK.fullmatch(name) else kind
            found[kind].append(name)
    maps = [name for name in found["masks"] if _is_mask(folder / name)]
    photos = sorted({*found["photos"], *found["masks"]} - {*maps})
    found["copies of others"] = copies = _copies(folder, photos, known)
    photos = [name for name in photos if name not in copies]
    for name in photos:
        stems[_stem(name)].append(name)
    for name in maps:
        parts = {*name.split("/")}
        owner = max(stems[_stem(name)], key=lambda photo: len(parts & {*photo.split("/")}), default=None)
        if owner is None:
            found["masks of no photo"].append(name)
        else:
            masks.setdefault(owner, name)
    left = ((what, names) for what, names in found.items() if names and what not in ("photos", "masks"))
    told = [f"Left out as {what}: {len(names)}, such as {names[0]}." for what, names in left]
    return Found(photos, masks, told)


def _kind(path: Path) -> str:
    """Return "photos" by a file's suffix and content, even if damaged, `_NOT_READ` for other images, or nothing."""
    suffix, kind = path.suffix.lower(), ""
    if path.exists() and not path.is_file():
        return ""
    try:
        with path.open("rb") as file:
            start = file.read(12)
    except OSError:  # It is named when it is read.
        start = b""
    if suffix in IMAGE_SUFFIXES and start[4:8] not in (b"ftyp", b"JXL ") and start[:2] != b"\xff\x0a":
        return "photos"
    with (
        contextlib.suppress(Exception),
        Image.open(path) as image,
    ):  # HEIC, AVIF, JPEG XL, or a file with another suffix
        kind = image.format
    if suffix not in IMAGE_SUFFIXES | _UNREAD:
        return _NOT_READ if kind in _FORMATS | {"GIF", "JPEG2000", "PSD", "PPM"} else ""
    return "photos" if kind in _FORMATS - {"TIFF"} else _NOT_READ


def _stem(name: str) -> str:
    """Return what a photo's name has in common with those of its mask and copies."""
    stem = Path(_VARIANT.sub("", Path(name).stem.lower()))
    return stem.stem if stem.suffix in IMAGE_SUFFIXES else stem.name


def _is_mask(path: Path) -> bool:
    """Return whether an image is black and white and hardly anything between."""
    try:
        with Image.open(path) as image:
            pixels = np.asarray(image.convert("RGB").resize((64, 64), Image.Resampling.NEAREST))
    except Exception:  # A damaged image is named when it is read.
        return False
    return bool(((pixels < 16).all(-1) | (pixels > 239).all(-1)).mean() > 0.95)


def _copies(folder: Path, photos: Sequence[str], known: Collection[str]) -> list[str]:
    """Return the photos with the bytes of another, and those with the name of another that show the same."""
    sizes, stems, copies = defaultdict(list), defaultdict(list), []

    def compare(names: Sequence[str], is_same: Callable[[Path, Path], bool]) -> None:
        kept = []
        for name in sorted(names, key=lambda name: name not in known):
            is_copy = name not in known and any(is_same(folder / other, folder / name) for other in kept)
            (copies if is_copy else kept).append(name)

    for name in sorted(photos, key=len):
        if (folder / name).is_file():
            sizes[(folder / name).stat().st_size].append(name)
            stems[_stem(name)].append(name)
    for size, names in sizes.items():
        compare(names if size else (), lambda photo, other: filecmp.cmp(photo, other, shallow=False))
    for names in stems.values():
        if len(left := [name for name in names if name not in copies]) > 1:
            left.sort(key=lambda name: -math.prod(image_size(folder / name)))
            compare(left, _shows_the_same)
    return copies


def _shows_the_same(photo: Path, other: Path) -> bool:
    """Return whether another image shows the same, in its folder, another format or another size; tones may differ."""
    try:
        with Image.open(photo) as one, Image.open(other) as two:
            if one.size == two.size and photo.parent != other.parent and photo.suffix == other.suffix:
                return False  # Cameras of a rig give their photos the same names.
            one.draft("L", (64, 64))
            two.draft("L", (64, 64))
            a, b = (ImageOps.exif_transpose(image).convert("L") for image in (one, two))
    except Exception:  # A damaged photo is named when it is read.
        return False
    small = [np.ravel(np.asarray(image.resize((16, 16), Image.Resampling.HAMMING))) for image in (a, b)]
    with np.errstate(invalid="ignore", divide="ignore"):  # of one colour
        is_same = np.corrcoef(small)[0, 1] > _SAME
    return bool(is_same and 0.97 < a.width * b.height / (a.height * b.width) < 1.03)
