"""Images of other bands beside photos in colour are left out, and no ordinary photo is."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageOps

from helpers.drawn_photos import draw_photos
from helpers.json_files import write_json
from sadgs_ns.placing.folder import look_into

INFRARED = b'<rdf:Description drone-dji:ImageSource="InfraredCamera"/>'
THERMAL = "Left out as thermal images beside photos in colour: {}, such as {}."
SINGLE = "Left out as images of single bands, such as near infrared, beside photos in colour: {}, such as {}."
SHOTS = 4


def exif_of(second: int, model: str = "FC6360") -> bytes:
    exif = Image.Exif()
    exif[0x110] = model
    exif[0x8769] = {0x9003: f"2026:05:01 10:00:{second:02d}"}
    return exif.tobytes()


def grey_16(photo: Image.Image, strength: int = 150) -> Image.Image:
    """A photo's luminance in 16 bits, as cameras store a band."""
    return Image.fromarray(np.asarray(photo.convert("L"), np.uint16) * np.uint16(strength))


def like_heat(photo: Image.Image) -> Image.Image:
    """A small image in the colours of heat, as a thermal camera stores one."""
    small = ImageOps.invert(photo).resize((64, 51)).convert("L")
    return ImageOps.colorize(small, "black", "yellow", "red")


def save(folder: Path, name: str, image: Image.Image, **options: Any) -> None:
    (folder / name).parent.mkdir(parents=True, exist_ok=True)
    image.save(folder / name, **options)


def thermal_drone(folder: Path, i: int, photo: Image.Image) -> None:
    save(folder, f"DJI_2026050110000{i}_000{i}_W.JPG", photo)
    save(folder, f"DJI_2026050110000{i}_000{i}_Z.JPG", photo.rotate(5))
    save(folder, f"DJI_2026050110000{i + 1}_000{i}_T.JPG", like_heat(photo))  # a second later


def thermal_drone_with_equal_sizes(folder: Path, i: int, photo: Image.Image) -> None:
    """White is hot, and all were scaled to one size."""
    save(folder, f"visible/{i}_V.jpg", photo)
    save(folder, f"thermal/{i}_T.jpg", ImageOps.invert(photo).convert("L").convert("RGB"))


def renamed_thermal_drone(folder: Path, i: int, photo: Image.Image) -> None:
    save(folder, f"{2 * i}.jpg", photo, exif=exif_of(2 * i))
    save(folder, f"{2 * i + 1}.jpg", like_heat(photo), exif=exif_of(2 * i + 1), xmp=INFRARED)


def mavic_multispectral(folder: Path, i: int, photo: Image.Image) -> None:
    save(folder, f"DJI_2026050110000{i}_000{i}_D.JPG", photo)
    for strength, band in enumerate(("G", "R", "RE", "NIR"), 100):
        save(folder, f"DJI_2026050110000{i}_000{i}_MS_{band}.TIF", grey_16(photo, strength))


def phantom_multispectral(folder: Path, i: int, photo: Image.Image) -> None:
    save(folder, f"DJI_00{i}0.JPG", photo, exif=exif_of(10 * i + 1))
    for band in range(1, 6):
        save(folder, f"DJI_00{i}{band}.TIF", grey_16(photo, 100 + band), exif=exif_of(10 * i + band % 3))


def sequoia(folder: Path, i: int, photo: Image.Image) -> None:
    save(folder, f"IMG_260501_10000{i}_0001_RGB.JPG", photo)
    for strength, band in enumerate(("GRE", "RED", "REG", "NIR"), 100):
        save(folder, f"IMG_260501_10000{i}_0001_{band}.TIF", grey_16(photo, strength))


def bands_of_one_name(folder: Path, i: int, photo: Image.Image) -> None:
    save(folder, f"{i}.jpg", photo)
    save(folder, f"{i}.tif", grey_16(ImageOps.invert(photo)))


Draw = Callable[[Path, int, Image.Image], None]


def draw(folder: Path, shot: Draw) -> list[str]:
    """Draw a capture of some shots, and return all its names."""
    for i, photo in enumerate(itertools.islice(draw_photos(), SHOTS)):
        shot(folder, i, photo)
    return sorted(path.relative_to(folder).as_posix() for path in folder.rglob("*.*"))


@pytest.mark.hard_case(
    "thermal images (`_T.JPG` beside `_W.JPG`), or those of bands (NIR, red edge) beside photos in colour, as drones "
    "store them",
    "left out, with a line that counts them",
)
@pytest.mark.parametrize(
    ("shot", "is_other", "told"),
    [
        (thermal_drone, lambda name: "_T." in name, THERMAL.format(4, "DJI_20260501100001_0000_T.JPG")),
        (thermal_drone_with_equal_sizes, lambda name: "_T." in name, THERMAL.format(4, "thermal/0_T.jpg")),
        (renamed_thermal_drone, lambda name: int(name[0]) % 2 == 1, THERMAL.format(4, "1.jpg")),
        (mavic_multispectral, lambda name: "_MS_" in name, SINGLE.format(16, "DJI_20260501100000_0000_MS_G.TIF")),
        (phantom_multispectral, lambda name: name.endswith(".TIF"), SINGLE.format(20, "DJI_0001.TIF")),
        (sequoia, lambda name: name.endswith(".TIF"), SINGLE.format(16, "IMG_260501_100000_0001_GRE.TIF")),
        (bands_of_one_name, lambda name: name.endswith(".tif"), SINGLE.format(4, "0.tif")),
    ],
)
def test_images_of_other_bands_are_left_out(shot: Draw, is_other: Callable[[str], bool], told: str, tmp_path: Path):
    names = draw(tmp_path, shot)
    expected = ([name for name in names if not is_other(name)], {}, [told])
    assert look_into(tmp_path, tmp_path / "out") == expected


def all_grey(folder: Path, i: int, photo: Image.Image) -> None:
    save(folder, f"IMG_{i}_NIR.tif", grey_16(photo), exif=exif_of(i))
    save(folder, f"IMG_{i}_RED.tif", grey_16(ImageOps.invert(photo)), exif=exif_of(i))


def all_thermal(folder: Path, i: int, photo: Image.Image) -> None:
    save(folder, f"DJI_000{i}_T.JPG", like_heat(photo), exif=exif_of(i), xmp=INFRARED)


def few_in_colour(folder: Path, i: int, photo: Image.Image) -> None:
    all_thermal(folder, i, photo)
    if i < 2:
        save(folder, f"DJI_000{i}_W.JPG", photo)


def black_and_white_among_colour(folder: Path, i: int, photo: Image.Image) -> None:
    """A photographer's, some of which are grey, one with the name of a shot."""
    save(folder, f"DSC_{i}.jpg", photo, exif=exif_of(i))
    save(folder, f"DSC_{10 + i}.jpg", photo.convert("L").rotate(3), exif=exif_of(i))
    save(folder, f"scan {i}.tif", grey_16(photo))
    save(folder, f"{i}_T.jpg", photo.convert("L").rotate(7))


def grey_in_two_formats(folder: Path, i: int, photo: Image.Image) -> None:
    """Two cameras' photos in black and white with the same numbers, and others in colour."""
    save(folder, f"{i}.jpg", photo.convert("L").convert("RGB"))
    save(folder, f"{i}.tif", grey_16(photo.rotate(20)))
    save(folder, f"colour {i}.jpg", photo)


def two_cameras_in_a_second(folder: Path, i: int, photo: Image.Image) -> None:
    save(folder, f"phone{i}.jpg", photo, exif=exif_of(i, "phone"))
    save(folder, f"machine{i}.tif", grey_16(photo), exif=exif_of(i, "machine vision"))


def rig_of_grey_and_colour(folder: Path, i: int, photo: Image.Image) -> None:
    save(folder, f"image_00/{i:06d}.png", photo.convert("L").rotate(3))
    save(folder, f"image_02/{i:06d}.png", photo)


def tele_and_wide(folder: Path, i: int, photo: Image.Image) -> None:
    save(folder, f"IMG_{i}_W.jpg", photo)
    save(folder, f"IMG_{i}_T.jpg", photo.rotate(5))


def tele_of_fewer_pixels(folder: Path, i: int, photo: Image.Image) -> None:
    save(folder, f"IMG_{i}_W.jpg", photo.resize((3200, 2400)))
    save(folder, f"IMG_{i}_T.jpg", photo.rotate(5).resize((1400, 1000)))


def small_ones_without_a_pair(folder: Path, i: int, photo: Image.Image) -> None:
    save(folder, f"IMG_{i}.jpg", photo)
    save(folder, f"IMG_{i}_T.jpg", photo.rotate(5).resize((60, 45)))


def colours_in_names(folder: Path, i: int, photo: Image.Image) -> None:
    save(folder, f"chair_{i}.jpg", photo)
    save(folder, f"chair_{i}_red.jpg", photo.rotate(5))
    save(folder, f"chair_{i}_green.tif", photo.rotate(9))


@pytest.mark.hard_case("a capture that is grey or thermal as a whole", "stays")
@pytest.mark.hard_case(
    "photos in black and white among others; a rig of grey and colour cameras; a phone's `_T` (tele) and `_W` (wide)",
    "no photo is taken for one of another band",
)
@pytest.mark.parametrize(
    "shot",
    [
        all_grey,
        all_thermal,
        few_in_colour,
        black_and_white_among_colour,
        grey_in_two_formats,
        two_cameras_in_a_second,
        rig_of_grey_and_colour,
        tele_and_wide,
        tele_of_fewer_pixels,
        small_ones_without_a_pair,
        colours_in_names,
    ],
)
def test_ordinary_photos_stay(shot: Draw, tmp_path: Path):
    names = draw(tmp_path, shot)
    actual = look_into(tmp_path, tmp_path / "out")
    assert actual == (names, {}, [])


def test_photos_that_a_scene_has_stay(tmp_path: Path):
    names = draw(tmp_path, thermal_drone)
    known = [name for name in names if "_T." in name][:2]
    settings = tmp_path / "out" / "work/settings.json"
    settings.parent.mkdir(parents=True)
    write_json(settings, {"photos": known})
    found, _, told = look_into(tmp_path, tmp_path / "out")
    actual = [name for name in found if "_T." in name]
    assert actual == known
    assert told == [THERMAL.format(2, "DJI_20260501100003_0002_T.JPG")]


def test_thermal_images_that_are_added_to_thermal_ones_stay(tmp_path: Path):
    names = draw(tmp_path, all_thermal)
    settings = tmp_path / "out" / "work/settings.json"
    settings.parent.mkdir(parents=True)
    write_json(settings, {"photos": names[:3]})
    actual = look_into(tmp_path, tmp_path / "out")
    assert actual == (names, {}, [])


def test_a_damaged_photo_among_bands_is_left_to_be_named(tmp_path: Path):
    names = draw(tmp_path, thermal_drone)
    thermal, *_ = (name for name in names if "_T." in name)
    (tmp_path / thermal).write_bytes((tmp_path / thermal).read_bytes()[:10])
    found, _, told = look_into(tmp_path, tmp_path / "out")
    assert thermal in found
    assert told == [THERMAL.format(3, "DJI_20260501100002_0001_T.JPG")]
