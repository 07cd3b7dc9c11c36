"""Photos in Adobe RGB that EXIF alone tells get the colours that their cameras meant, and others keep theirs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import ExifTags, Image

from helpers.drawn_photos import color_profile
from sadgs_ns.placing.conversion import convert_photos
from sadgs_ns.placing.photos import read_photos

ADOBE_TO_SRGB = {(200, 30, 30): (233, 24, 24), (100, 150, 200): (66, 151, 203), (60, 90, 40): (36, 90, 31)}
"""By the primaries, white and gamma of both standards in float64."""


def exif_of(color_space: int, index: str, orientation: int = 1) -> Image.Exif:
    exif = Image.Exif()
    exif[0x112] = orientation
    exif[0x8769] = {0xA001: color_space, 0xA005: {1: index}}
    return exif


DAMAGED = exif_of(65535, "R03").tobytes().replace(b"\xa0\x05\0\4\0\0\0\1\0\0", b"\xa0\x05\0\4\0\0\0\1\0\xff")
"""EXIF whose index lies behind its end."""


def converted(folder: Path, name: str) -> tuple[bool, np.ndarray]:
    """Convert a photo, and return whether it is used as it was, and its pixels. [H, W, 3]"""
    photos = read_photos(folder, [name], lambda *step: None)
    target, (photo,) = convert_photos(folder, photos, folder / "converted")
    with Image.open(target / photo.name) as image:
        return target == folder, np.asarray(image.convert("RGB"))


@pytest.mark.hard_case("photos in Adobe RGB that EXIF alone tells (uncalibrated, R03)", "become sRGB, as viewers show")
@pytest.mark.parametrize("colour", [*ADOBE_TO_SRGB])
@pytest.mark.parametrize("orientation", [1, 6])
def test_adobe_rgb_that_exif_tells_becomes_srgb(colour: Any, orientation: int, tmp_path: Path):
    Image.new("RGB", (32, 16), colour).save(tmp_path / "a.jpg", exif=exif_of(65535, "R03", orientation), quality=97)
    is_unchanged, pixels = converted(tmp_path, "a.jpg")
    width = 32 if orientation == 1 else 16
    assert not is_unchanged
    assert pixels.shape[1] == width
    assert np.abs(pixels[8, 8].astype(int) - ADOBE_TO_SRGB[colour]).max() <= 3


@pytest.mark.hard_case(
    "photos whose EXIF tells of another colour space, or none (`_DSC1.jpg`)", "keep their colours as they are"
)
@pytest.mark.parametrize(
    ("name", "mode", "options"),
    [
        ("_DSC1.jpg", "RGB", {}),
        ("a.jpg", "RGB", {"exif": exif_of(65535, "R98")}),
        ("a.jpg", "RGB", {"exif": exif_of(1, "R03")}),
        ("a.jpg", "RGB", {"exif": exif_of(65535, "R03"), "icc_profile": color_profile(swapped=False)}),
        ("a.jpg", "L", {"exif": exif_of(65535, "R03")}),
        ("a.jpg", "RGB", {"exif": DAMAGED}),
    ],
)
@pytest.mark.filterwarnings("ignore:Corrupt EXIF data")
def test_other_photos_keep_their_colours(name: str, mode: str, options: dict[str, Any], tmp_path: Path):
    Image.new(mode, (32, 16), (200, 30, 30) if mode == "RGB" else 90).save(tmp_path / name, **options)
    is_unchanged, _ = converted(tmp_path, name)
    assert is_unchanged


def test_photos_keep_their_colours_where_pillow_11_finds_no_part_on_interoperability(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    get_ifd = Image.Exif.get_ifd

    def get_ifd_of_pillow_11(exif: Image.Exif, tag: int) -> dict[int, Any]:
        if tag == ExifTags.IFD.Interop:
            raise KeyError(tag)
        return get_ifd(exif, tag)

    Image.new("RGB", (32, 16), (200, 30, 30)).save(tmp_path / "a.jpg", exif=exif_of(65535, "R98"))
    monkeypatch.setattr(Image.Exif, "get_ifd", get_ifd_of_pillow_11)
    is_unchanged, _ = converted(tmp_path, "a.jpg")
    assert is_unchanged
