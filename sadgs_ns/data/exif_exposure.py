"""Exposure that a camera wrote into a photo's EXIF data."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from PIL import ExifTags, Image


def exposure_stops(path: Path) -> float | None:
    """Return log₂ of shutter time in s times ISO over the squared f-number; None if the file lacks one of them."""
    # Decoders raise anything where EXIF is damaged, which matters to no one.
    with suppress(Exception), Image.open(path) as image:
        tags = Image.Image.getexif(image).get_ifd(ExifTags.IFD.Exif)
        time = float(tags[ExifTags.Base.ExposureTime])
        aperture = float(tags[ExifTags.Base.FNumber])
        sensitivity = float(tags[ExifTags.Base.ISOSpeedRatings])
        stops = math.log2(time * sensitivity / aperture**2)
        if math.isfinite(stops):
            return stops
    return None


def exposures_of(paths: Sequence[Path]) -> list[float] | None:
    """Return `exposure_stops` of all photos, or None if one of them has none."""
    stops = []
    for path in paths:
        value = exposure_stops(path)
        if value is None:
            return None
        stops.append(value)
    return stops
