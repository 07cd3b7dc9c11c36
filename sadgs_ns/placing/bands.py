"""Photos of other bands of light (thermal, near infrared, red alone) beside photos in colour of the same.

Cameras of drones take several at a time, and a splat of all of them would mix their values. A photo counts as one of
another band only if two things tell it: its look or XMP, and a photo in colour that was taken with it.
"""

from __future__ import annotations

import contextlib
import dataclasses
import datetime
import functools
import itertools
import re
from collections import defaultdict
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image

from sadgs_ns.data.images import UNREADABLE

_THERMAL = "thermal images beside photos in colour"
_SINGLE = "images of single bands, such as near infrared, beside photos in colour"
_THERMAL_ENDINGS = {"t", "ir", "lwir", "thermal"}
_SINGLE_ENDINGS = {"nir", "red", "green", "blue", "gre", "reg", "rededge", "ms_nir", "ms_r", "ms_g", "ms_b", "ms_re"}
_COLOUR_ENDINGS = {"w", "v", "z", "d", "rgb", "vis", "visible"}  # Wide, visible, zoom, …
_ENDINGS = _THERMAL_ENDINGS | _SINGLE_ENDINGS | _COLOUR_ENDINGS
_NAME = re.compile(r"(?P<shot>.*\d)_(?P<ending>(ms_)?[a-z]+)")
_TIME_IN_NAME = re.compile(r"(?<!\d)\d{14}_")  # A shot's files may differ in it by a second.
_ONE_CHANNEL = {"L", "LA", "I;16", "I;16B", "I;16L", "I", "F"}  # Pillow's modes
_INFRARED_CAMERA = re.compile(rb"ImageSource\W+InfraredCamera")  # In DJI's XMP
_MOST_THERMAL_PIXELS = 1280 * 1024
_LEAST_RATIO = 4  # Of the pixels of a photo in colour to those of a thermal image; drones have 9 and more
_LEAST_COLOURED = 3  # Photos in colour that must remain, since a scene takes as many
_GREY_SPREAD = 8  # Largest difference of a grey pixel's channels, as JPEG leaves it
_LEAST_SHARE = 0.01  # Of the pixels of a photo in colour, those that are not grey

CameraTime = tuple[str, int]
"""Maker and model of a camera, and a time in seconds."""


@dataclasses.dataclass(frozen=True)
class _Picture:
    """The name of a photo and the content of its header."""

    file: Path
    shot: str  # The stem of its name without its ending, equal for images that were taken together
    ending: str  # The end of its name that tells of a band; empty for most
    pixels: int
    has_one_channel: bool
    is_tiff: bool
    is_infrared: bool
    camera_time: CameraTime | None  # By whom and when it was taken

    @property
    def may_be_other(self) -> bool:
        """Whether its name or header allows that it is of another band."""
        return self.is_infrared or self.has_one_channel or self.ending in _THERMAL_ENDINGS | _SINGLE_ENDINGS

    @functools.cached_property
    def is_coloured(self) -> bool:
        """Whether it shows colours; False for a damaged photo, which is named when it is read."""
        if self.has_one_channel:
            return False
        try:
            with Image.open(self.file) as image:
                image.draft("RGB", (64, 64))
                small = image.convert("RGB").resize((64, 64), Image.Resampling.NEAREST)
        except UNREADABLE:
            return False
        pixels = np.asarray(small, np.int16)
        spread = pixels.max(axis=2) - pixels.min(axis=2)
        return bool((spread > _GREY_SPREAD).mean() >= _LEAST_SHARE)


def other_bands(folder: Path, photos: Sequence[str], known: Collection[str]) -> dict[str, list[str]]:
    """Return the photos of other bands by what they are, the end of a sentence on why they are left out.

    Those that are `known` stay. All stay if fewer than three photos in colour would remain, because a whole capture may
    be thermal or grey.
    """
    doubtful = {}
    others = []
    for name in photos:
        picture = _read(folder / name)
        if picture is None:
            continue
        if not picture.may_be_other:
            others.append(picture)
        elif name not in known:
            doubtful[name] = picture
    shots = _Shots(others)
    found = defaultdict(list)
    for name, picture in doubtful.items():
        kind = _kind(picture, shots)
        if kind:
            found[kind].append(name)
    if not found:
        return {}
    coloured = (picture for picture in others if picture.is_coloured)
    if len(list(itertools.islice(coloured, _LEAST_COLOURED))) < _LEAST_COLOURED:
        return {}
    return dict(found)


class _Shots:
    """Finds the photos that were taken together with another one, by their names, or by camera and time."""

    def __init__(self, pictures: Iterable[_Picture]) -> None:
        self._by_shot: dict[str, list[_Picture]] = defaultdict(list)
        self._by_stem: dict[Path, list[_Picture]] = defaultdict(list)
        self._by_time: dict[CameraTime, list[_Picture]] = defaultdict(list)
        for picture in pictures:
            self._by_shot[picture.shot].append(picture)
            self._by_stem[picture.file.with_suffix("")].append(picture)
            if picture.camera_time is not None:
                self._by_time[picture.camera_time].append(picture)

    def with_name_of(self, picture: _Picture) -> list[_Picture]:
        """Return photos whose names differ in the ending that tells the band, or else in the suffix alone."""
        if picture.ending:
            return self._by_shot[picture.shot]
        return self._by_stem[picture.file.with_suffix("")]

    def with_time_of(self, picture: _Picture) -> list[_Picture]:
        """Return photos that a camera of the same name took within a second."""
        found: list[_Picture] = []
        if picture.camera_time is not None:
            camera, time = picture.camera_time
            for second in (time - 1, time, time + 1):
                found += self._by_time[camera, second]
        return found


def _kind(picture: _Picture, shots: _Shots) -> str:
    """Return what a doubtful photo is if it is of another band, empty if it may as well be an ordinary one."""
    siblings = shots.with_name_of(picture)
    if picture.is_infrared or picture.is_tiff:  # Photos of other kinds may be taken in one second, too.
        siblings = siblings + shots.with_time_of(picture)
    if picture.is_infrared or picture.ending in _THERMAL_ENDINGS:
        if any(_is_thermal_beside(picture, sibling) for sibling in siblings):
            return _THERMAL
    elif any(_is_grey_beside(picture, sibling) for sibling in siblings):
        return _SINGLE
    return ""


def _is_thermal_beside(picture: _Picture, sibling: _Picture) -> bool:
    """Return whether an image that may be thermal by its XMP or name is so beside a photo.

    A name alone may be that of a phone's tele lens. It counts if the image is grey, or has as few pixels as thermal
    sensors have and the photo is named as the other of a pair.
    """
    if picture.is_infrared:
        return sibling.is_coloured
    is_small = picture.pixels <= _MOST_THERMAL_PIXELS and picture.pixels * _LEAST_RATIO < sibling.pixels
    if is_small and sibling.ending in _COLOUR_ENDINGS:
        return True
    return _is_grey_beside(picture, sibling)


def _is_grey_beside(picture: _Picture, sibling: _Picture) -> bool:
    return sibling.is_coloured and not picture.is_coloured


def _read(file: Path) -> _Picture | None:
    """Read the header of a photo, None for a damaged one, which is named when it is read."""
    stem = _TIME_IN_NAME.sub("", file.stem.lower())
    shot = stem
    ending = ""
    name = _NAME.fullmatch(stem)
    if name and name["ending"] in _ENDINGS:
        shot = name["shot"]
        ending = name["ending"]
    try:
        image = Image.open(file)
    except UNREADABLE:
        return None
    with image:
        xmp = image.info.get("xmp")  # None for some HEIC files
        return _Picture(
            file=file,
            shot=shot,
            ending=ending,
            pixels=image.width * image.height,
            has_one_channel=image.mode in _ONE_CHANNEL,
            is_tiff=image.format == "TIFF",
            is_infrared=isinstance(xmp, bytes) and bool(_INFRARED_CAMERA.search(xmp)),
            camera_time=_camera_time(image),
        )


def _camera_time(image: Image.Image) -> CameraTime | None:
    """Return which camera took a photo, and when, None if EXIF does not tell."""
    camera = ""
    text = ""
    with contextlib.suppress(*UNREADABLE):  # EXIF may be damaged.
        exif = Image.Image.getexif(image)  # A PNG's own method would decode the image.
        camera = f"{exif.get(ExifTags.Base.Make)} {exif.get(ExifTags.Base.Model)}"
        text = str(exif.get_ifd(ExifTags.IFD.Exif).get(ExifTags.Base.DateTimeOriginal))
    try:
        time = datetime.datetime.strptime(text, "%Y:%m:%d %H:%M:%S")
    except ValueError:
        return None
    return camera, int((time - datetime.datetime.min).total_seconds())
