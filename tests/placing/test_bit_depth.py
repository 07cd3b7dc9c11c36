"""Photos whose values use 10, 12 or 14 of 16 bits get their brightness, all of a scene the same."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from helpers.drawn_photos import color_profile
from helpers.json_files import read_json, write_json
from sadgs_ns.cli.process import main
from sadgs_ns.placing import place
from sadgs_ns.placing.bit_depth import depth_of, read_scaled
from sadgs_ns.placing.plan import Summary

SIZE = (12, 8)  # Width and height in px


def stored(*colour: int) -> np.ndarray:
    """An image of 16 bits with a colour on the left, BGR or grey, and black on the right. [H, W, C]"""
    pixels = np.zeros((SIZE[1], SIZE[0], len(colour)), np.uint16)
    pixels[:, : SIZE[0] // 2] = colour
    return pixels


def write(folder: Path, **photos: np.ndarray) -> Path:
    """Write photos of 16 bits as PNG."""
    folder.mkdir(exist_ok=True)
    for name, pixels in photos.items():
        assert cv2.imwrite(str(folder / f"{name}.png"), pixels)
    return folder


@dataclasses.dataclass
class Taken:
    """What COLMAP was given in a run."""

    pixels: dict[str, np.ndarray]  # In RGB, [H, W, C]
    unchanged: set[str]  # Photos as the user has them


@pytest.fixture
def taken(monkeypatch: pytest.MonkeyPatch) -> list[Taken]:
    """What was given to COLMAP in each run; it then says that all photos registered."""
    runs: list[Taken] = []

    def stand_in(colmap: object, photos: Path, groups: list[list[str]], *arguments: Any, **others: Any) -> Any:
        names = [name for group in groups for name in group]
        pixels = {name: np.asarray(Image.open(photos / name)) for name in names}
        model = arguments[2]
        out = model.parents[1].resolve()
        runs.append(Taken(pixels, {name for name in names if out not in (photos / name).resolve().parents}))
        model.mkdir()
        (model.parent / "database.db").touch()
        (model.parents[1] / "transforms.json").write_text("{}")
        return dataclasses.asdict(Summary(len(names), len(names), 100, 0.5, {}, arguments[0]))

    monkeypatch.setattr(place, "make_model", stand_in)
    monkeypatch.setattr(place, "publish", lambda *others: None)
    return runs


def left(pixels: np.ndarray) -> list[int]:
    return pixels[2, 2].tolist()


@pytest.mark.hard_case(
    "values of 10, 12 or 14 bits in PNG or TIFF of 16 bits, as scientific and machine vision cameras store them",
    "all photos are scaled by the bits that the largest value of them all needs, with a line",
)
@pytest.mark.parametrize(
    ("largest", "depth"), [(200, 8), (256, 10), (1023, 10), (1024, 12), (4095, 12), (4096, 14), (16383, 14)]
)
def test_values_of_few_bits_are_scaled_by_the_largest_of_all_photos(
    largest: int, depth: int, tmp_path: Path, taken: list[Taken], capsys
):
    photos = write(tmp_path / "photos", a=stored(0, 99, 150), b=stored(largest), c=stored(150, 99, 0))
    Image.fromarray(stored(150)[:, :, 0]).save(photos / "d.tif")
    Image.new("RGB", SIZE, (1, 2, 3)).save(photos / "e.png")
    status = main([str(photos), str(tmp_path / "out")])
    assert status == 0
    white = 2**depth - 1
    middle = round(255 * 150 / white)
    low = round(255 * 99 / white)
    pixels = taken[0].pixels
    assert left(pixels["a.png"]) == [middle, low, 0]
    assert left(pixels["b.png"]) == [round(255 * largest / white)] * 3
    assert left(pixels["c.png"]) == [0, low, middle]
    assert left(pixels["d.tif"]) == [middle] * 3
    assert left(pixels["e.png"]) == [1, 2, 3]
    assert taken[0].unchanged == {"e.png"}
    for image in pixels.values():
        assert image.dtype == np.uint8
        assert image[:, 8:].max() <= 3
    told = f"4 photos of 16 bits use {depth} of them (largest value {largest:,}): {white:,} becomes white.\n"
    printed = capsys.readouterr().out
    assert told in printed


@pytest.mark.hard_case("photos whose values use all of 16 bits", "are read as they are, without a line")
def test_photos_of_16_bits_are_taken_as_they_are(tmp_path: Path, taken: list[Taken], capsys):
    photos = write(tmp_path / "photos", a=stored(0, 99, 150), b=stored(16384), c=stored(1))
    status = main([str(photos), str(tmp_path / "out")])
    assert status == 0
    assert taken[0].unchanged == {"a.png", "b.png", "c.png"}
    printed = capsys.readouterr().out
    assert "photos of 16 bits" not in printed


@pytest.mark.hard_case(
    "photos of 16 bits added to a scene of 12 bits, some brighter than 12 bits",
    "are scaled as the first ones, also if the run is interrupted; a line tells of those that are too bright",
)
def test_the_bits_that_were_chosen_first_stay(tmp_path: Path, taken: list[Taken], monkeypatch, capsys):
    photos = write(tmp_path / "photos", a=stored(4095), b=stored(819), c=stored(1))
    command = [str(photos), str(tmp_path / "out")]
    with monkeypatch.context() as patched:
        patched.setattr(place, "make_model", interrupt)
        assert main(command) == 130
        assert main(command) == 130
    assert main(command) == 0
    write(photos, d=stored(0, 0, 819), e=stored(60000))
    capsys.readouterr()
    assert main(command) == 0
    assert left(taken[0].pixels["b.png"]) == [51, 51, 51]
    assert left(taken[1].pixels["d.png"]) == [51, 0, 0]
    assert left(taken[1].pixels["e.png"]) == [255, 255, 255]
    told = (
        "use 12 of them (largest value 60,000): 4,095 becomes white. The first photos of the scene decided this; 1 of"
    )
    printed = capsys.readouterr().out
    assert told in printed
    write(photos, f=stored(819, 0, 0))
    assert main(command) == 0
    assert left(taken[2].pixels["f.png"]) == [0, 0, 51]


def interrupt(*arguments: object, **others: object) -> None:
    raise KeyboardInterrupt


@pytest.mark.hard_case(
    "a scene of photos of 12 bits that an earlier version began", "goes on as it was begun, and new photos with it"
)
def test_a_scene_of_an_earlier_version_is_as_dark_as_before(tmp_path: Path, taken: list[Taken]):
    photos = write(tmp_path / "photos", a=stored(4095), b=stored(819), c=stored(1))
    command = [str(photos), str(tmp_path / "out")]
    assert main(command) == 0
    settings = tmp_path / "out" / "work/settings.json"
    described = read_json(settings)
    assert described.pop("bit_depth") == 12
    write_json(settings, described)
    write(photos, d=stored(0, 0, 819))
    assert main(command) == 0
    assert taken[1].unchanged == {"a.png", "b.png", "c.png", "d.png"}


def test_the_first_photos_of_16_bits_decide_also_if_they_are_added(tmp_path: Path, taken: list[Taken]):
    photos = tmp_path / "photos"
    photos.mkdir()
    for i in range(3):
        Image.new("RGB", SIZE, (i, 20, 30)).save(photos / f"{i}.png")
    command = [str(photos), str(tmp_path / "out")]
    assert main(command) == 0
    write(photos, a=stored(4095), b=stored(819))
    assert main(command) == 0
    actual = left(taken[1].pixels["b.png"])
    assert actual == [51, 51, 51]


@pytest.mark.parametrize("opaque", [65535, 4095])
def test_opacity_is_scaled_by_the_bits_that_it_uses(opaque: int, tmp_path: Path):
    pixels = stored(0, 819, 4095, opaque)
    pixels[:, 8:, 3] = opaque // 5
    file = write(tmp_path, a=pixels) / "a.png"
    with Image.open(file) as image:
        scaled = np.asarray(read_scaled(image, file, 12))
    assert left(scaled) == [255, 51, 0, 255]
    assert (scaled[:, 8:] == [0, 0, 0, 51]).all()


def test_scaled_photos_are_turned_and_their_profile_is_used(tmp_path: Path, taken: list[Taken]):
    photos = write(tmp_path / "photos", a=stored(4095), b=stored(0, 0, 4095), c=stored(1))
    exif = Image.Exif()
    exif[0x112] = 6  # Its left is above.
    Image.open(photos / "a.png").save(photos / "a.png", exif=exif)
    Image.fromarray(stored(4095)[:, :, 0]).save(photos / "d.tif", exif=exif, compression="tiff_lzw")
    with_profile(photos / "b.png", color_profile(swapped=True))
    status = main([str(photos), str(tmp_path / "out")])
    assert status == 0
    for name in ("a.png", "d.tif"):
        turned = taken[0].pixels[name]
        assert turned.shape == (12, 8, 3)
        assert (turned[:6] == 255).all()
        assert not turned[6:].any()
    red, green, blue = left(taken[0].pixels["b.png"])
    assert red <= 6
    assert green >= 249
    assert blue <= 6


def with_profile(file: Path, profile: bytes) -> None:
    """Put a colour profile into a PNG, all of whose bits stay: Pillow would write 8."""
    small = Image.new("RGB", (1, 1))
    other = file.with_name("profile.png")
    small.save(other, icc_profile=profile)
    chunks = other.read_bytes()
    other.unlink()
    start = chunks.index(b"iCCP") - 4
    length = int.from_bytes(chunks[start : start + 4], "big")
    content = file.read_bytes()
    header_end = 33
    file.write_bytes(content[:header_end] + chunks[start : start + 12 + length] + content[header_end:])


def test_black_photos_have_a_depth():
    assert depth_of([0, 0]) == 8
    assert depth_of([3, 65535]) == 16
