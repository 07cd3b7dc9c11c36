"""Exposure is read from EXIF data if it is whole."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from PIL import ExifTags, Image

from sadgs_ns.data.exif_exposure import exposure_stops, exposures_of

TAGS = {ExifTags.Base.ExposureTime: 1 / 50, ExifTags.Base.FNumber: 2.0, ExifTags.Base.ISOSpeedRatings: 200}


def photo(path: Path, tags: Mapping[Any, float]) -> Path:
    exif = Image.Exif()
    exif.get_ifd(ExifTags.IFD.Exif).update(dict(tags))
    Image.new("RGB", (8, 8), "grey").save(path, exif=exif)
    return path


def test_shutter_aperture_and_iso_make_stops(tmp_path: Path):
    actual = exposure_stops(photo(tmp_path / "a.jpg", TAGS))
    assert actual == pytest.approx(0.0)  # 200 / 50 / 2²
    longer = photo(tmp_path / "b.jpg", TAGS | {ExifTags.Base.ExposureTime: 1 / 25})
    actual = exposures_of([tmp_path / "a.jpg", longer])
    assert actual == pytest.approx([0.0, 1.0])


@pytest.mark.hard_case("EXIF data without shutter, aperture or ISO, or with zeros", "tells no exposure")
def test_a_photo_without_one_of_them_tells_nothing(tmp_path: Path):
    whole = photo(tmp_path / "whole.jpg", TAGS)
    for index, tag in enumerate(TAGS):
        lacking = photo(tmp_path / f"{index}.jpg", {key: value for key, value in TAGS.items() if key != tag})
        zero = photo(tmp_path / f"{index}0.jpg", TAGS | {tag: 0})
        for path in (lacking, zero, tmp_path / "absent.jpg"):
            assert exposure_stops(path) is None
            assert exposures_of([whole, path]) is None
