"""Panoramas of a drawn hall, from their views to the scene that these make."""

from __future__ import annotations

import itertools
import shutil
from collections import defaultdict
from pathlib import Path

import av
import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image

from helpers.drawn_photos import draw_panorama, draw_photo, draw_photos, panorama_centres
from helpers.json_files import read_json
from sadgs_ns.cli.process import Process, main, process
from sadgs_ns.placing.panoramas import VIEWS, cut, is_fisheye_pair, is_panorama, rotations
from sadgs_ns.placing.photos import read_photos
from sadgs_ns.placing.reconstruct import choose_pairs

COUNT = 12
HEIGHT = 256
TURN = 0.2


@pytest.fixture(scope="module")
def panoramas() -> list[Image.Image]:
    """Panoramas of a camera that moves and turns."""
    centres = panorama_centres(COUNT)
    return [Image.fromarray(draw_panorama(centre, HEIGHT, TURN * i)) for i, centre in enumerate(centres)]


def centres_of(model: pycolmap.Reconstruction) -> dict[str, np.ndarray]:
    """Where the panoramas of a model were taken, by their names, which all their views agree on."""
    found: dict[str, list[np.ndarray]] = defaultdict(list)
    for image in model.images.values():
        if "/" in image.name:
            found[image.name.partition("/")[0]].append(image.projection_center())
    for views in found.values():
        assert len(views) == VIEWS
        assert np.ptp(views, axis=0).max() < 1e-9
    return {name: views[0] for name, views in sorted(found.items())}


def errors_of_centres(model: pycolmap.Reconstruction) -> np.ndarray:
    """Distances of all panoramas from where they are, as shares of the largest from their centre. [COUNT]"""
    found = np.stack([*centres_of(model).values()])
    expected = panorama_centres(COUNT)
    assert len(found) == COUNT
    similarity = pycolmap.estimate_sim3d(found, expected)
    assert similarity is not None
    aligned = np.stack([similarity * centre for centre in found])
    return np.linalg.norm(aligned - expected, axis=1) / np.linalg.norm(expected - expected.mean(0), axis=1).max()


@pytest.mark.hard_case(
    "360° panoramas (2:1, with or without GPano in XMP)",
    'said to be such, and cut into a rig of eight pinhole views without tripod and zenith; before, "take more of them"',
)
@pytest.mark.hard_case(
    "panoramas and ordinary photos in one folder, some added later",
    "the panoramas alone are cut, poses that are there stay, and no panorama is divided between training and test",
)
def test_panoramas_become_views_and_more_are_added(panoramas: list[Image.Image], tmp_path: Path, capsys):
    source = tmp_path / "photos"
    out = tmp_path / "out"
    source.mkdir()
    for i, panorama in enumerate(panoramas):
        panorama.save(source / f"{i:02d}.jpg", quality=95)
    last = shutil.move(source / "11.jpg", tmp_path)
    summary = process(Process(source, out, matching="sequential"))
    assert summary.photos == 11 * VIEWS
    assert summary.registered == 11 * VIEWS
    printed = capsys.readouterr().out
    assert "11 of the 11 photos are panoramas: each is cut into 8 views of 90°" in printed
    described = read_json(out / "transforms.json")
    assert described["val_filenames"] == described["test_filenames"] == [f"images/04.jpg/{i}.jpg" for i in range(VIEWS)]
    assert len(described["train_filenames"]) == 10 * VIEWS
    assert len(described["frames"]) == 11 * VIEWS
    for frame in described["frames"]:
        assert frame["w"] == HEIGHT // 2
        assert frame["h"] == HEIGHT // 2
        actual = [frame[key] for key in ("fl_x", "fl_y", "cx", "cy")]
        assert actual == [HEIGHT / 4] * 4
    shutil.move(last, source)
    middle = panorama_centres(COUNT)[3:9:5]
    for name, centre, rotation in zip(("a.jpg", "b.jpg"), middle, rotations()[1:3], strict=True):
        Image.fromarray(draw_photo(centre + 0.1, rotation, 256)).save(source / name, quality=95)
    summary = process(Process(source, out, matching="exhaustive"))
    assert summary.photos == COUNT * VIEWS + 2
    assert summary.registered == COUNT * VIEWS + 2
    printed = capsys.readouterr().out
    assert "12 of the 14 photos are panoramas" in printed
    grown = read_json(out / "transforms.json")
    frames = {frame["file_path"]: frame for frame in grown["frames"]}
    assert all(frames[frame["file_path"]] == frame for frame in described["frames"])
    assert grown["test_filenames"] == described["test_filenames"]
    new = [f"images/11.jpg/{i}.jpg" for i in range(VIEWS)] + ["images/a.jpg", "images/b.jpg"]
    assert grown["train_filenames"] == described["train_filenames"] + new
    assert all((out / name).is_file() for name in frames)
    assert errors_of_centres(pycolmap.Reconstruction(out / "sparse/0")).max() < 0.01


@pytest.mark.hard_case(
    "a 360° video", "its frames are cut like panoramas, and views that look the same way are matched"
)
@pytest.mark.slow
def test_a_video_of_panoramas_becomes_views(panoramas: list[Image.Image], tmp_path: Path):
    with av.open(str(tmp_path / "film.mp4"), "w") as film:
        stream = film.add_stream("libx264", rate=10, options={"crf": "14"})
        stream.width = 2 * HEIGHT
        stream.height = HEIGHT
        stream.pix_fmt = "yuv420p"
        for panorama in panoramas:
            film.mux(stream.encode(av.VideoFrame.from_image(panorama)))
        film.mux(stream.encode())
    summary = process(Process(tmp_path / "film.mp4", tmp_path / "out"))
    assert summary.matching == "sequential"
    assert summary.registered >= 0.9 * summary.photos == 0.9 * COUNT * VIEWS
    assert errors_of_centres(pycolmap.Reconstruction(tmp_path / "out/sparse/0")).max() < 0.01


def test_views_are_those_of_a_pinhole_camera_across_the_seam(panoramas: list[Image.Image]):
    centre = panorama_centres(COUNT)[0]
    for view, rotation in zip(cut(panoramas[0]), rotations(), strict=True):
        expected = draw_photo(centre, rotation, HEIGHT // 2).astype(float)
        difference = np.abs(np.asarray(view) - expected).mean()
        assert difference < 0.15 * np.abs(expected[::-1] - expected).mean()
    up = rotations()[:, :, 2] @ [0, -1, 0]
    assert np.degrees(np.arcsin(up)).max() + 45 < 68  # no pole


def test_what_is_a_panorama(panoramas: list[Image.Image], tmp_path: Path):
    photo = next(draw_photos()).resize((512, 384)).crop((0, 64, 512, 320))
    eye = Image.fromarray(np.uint8(255 * (np.hypot(*np.mgrid[-127.5:128, -127.5:128]) < 120)))
    pair = Image.new("RGB", (512, 256))  # of a camera's two fisheyes
    for x in (0, 256):
        pair.paste(panoramas[0].crop((x, 0, x + 256, 256)), (x, 0), eye)
    wide = panoramas[0].crop((0, 100, 512, 156))
    for image, expected in ((photo, False), (pair, False), (wide, False), *((each, True) for each in panoramas)):
        assert is_panorama(image, image.size) == expected
    xmp = b'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf GPano:ProjectionType="equirectangular"/></x:xmpmeta>'
    photo.save(tmp_path / "told.jpg", xmp=xmp)
    wide.save(tmp_path / "wide.jpg", xmp=xmp)
    for i, panorama in enumerate(panoramas):
        panorama.resize((1024, 512)).save(tmp_path / f"{i}.jpg", quality=80)
        assert read_photos(tmp_path, [f"{i}.jpg"], lambda *step: None)[0].is_panorama
    told, part = read_photos(tmp_path, ["told.jpg", "wide.jpg"], lambda *step: None)
    assert told.is_panorama
    assert not part.is_panorama


def fisheye_pair(panorama: Image.Image, radius: float = 0.97, glare: int = 0) -> Image.Image:
    """The two circles of 200° of a 360° camera, of which a panorama was made, with a radius in halves of the height."""
    side = panorama.height
    across = (np.arange(side) + 0.5) / side * 2 - 1
    x, y = np.meshgrid(across, across)
    distance = np.hypot(x, y)
    angle = np.radians(100) * distance / radius
    ahead = np.cos(angle)
    right = np.sin(angle) * x / distance
    down = np.sin(angle) * y / distance
    row = (0.5 + np.arcsin(np.clip(down, -1, 1)) / np.pi) * side - 0.5
    circles = []
    for sign in (1, -1):
        column = (1 + np.arctan2(sign * right, sign * ahead) / np.pi) * side - 0.5
        places = (column.astype(np.float32), row.astype(np.float32))
        circle = cv2.remap(np.asarray(panorama), *places, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)
        circle[distance > radius] = glare
        circles.append(circle)
    return Image.fromarray(np.concatenate(circles, axis=1))


@pytest.mark.parametrize(("radius", "glare"), [(0.97, 0), (1.1, 0), (0.92, 25)])
def test_pairs_of_fisheye_circles_are_told(panoramas: list[Image.Image], radius: float, glare: int):
    for panorama in panoramas:
        pair = fisheye_pair(panorama, radius, glare)
        assert is_fisheye_pair(pair, pair.size)
        assert not is_panorama(pair, pair.size)


def test_other_wide_photos_are_no_pairs_of_fisheye_circles(panoramas: list[Image.Image]):
    photo = next(draw_photos()).resize((512, 384))
    wide = photo.crop((0, 64, 512, 320))
    small = Image.new("RGB", (512, 256))  # A thing before a black background
    small.paste(photo.resize((256, 192)), (128, 32))
    rows = np.linspace(-1, 1, 256)[:, None, None]
    night = Image.fromarray(np.uint8(np.asarray(panoramas[0]) * (np.abs(rows) < 0.35)))  # Sky and floor are dark.
    pair = fisheye_pair(panoramas[0])
    for image in (*panoramas, photo, wide, small, night, Image.new("RGB", (512, 256)), pair.resize((512, 384))):
        assert not is_fisheye_pair(image, image.size)


@pytest.mark.hard_case(
    "pairs of fisheye circles, as a 360° camera stores them", "refused before any work, with the remedy: stitch them"
)
def test_pairs_of_fisheye_circles_are_refused(panoramas: list[Image.Image], tmp_path: Path, capsys):
    source = tmp_path / "photos"
    source.mkdir()
    for i, panorama in enumerate(panoramas[:4]):
        fisheye_pair(panorama).resize((1024, 512)).save(source / f"{i}.jpg", quality=80)
    next(draw_photos()).save(source / "phone.jpg")
    out = tmp_path / "scene"
    status = main([str(source), str(out)])
    assert status == 2
    problem = f"4 of the 5 photos in {source}, such as 0.jpg, show two fisheye circles side by side"
    printed = capsys.readouterr().err
    assert problem in printed
    assert "stitch them to panoramas of 2:1 with the camera's program" in printed
    assert not out.exists()


def test_a_few_pairs_of_circles_among_other_photos_are_left_to_colmap(panoramas: list[Image.Image], tmp_path: Path):
    fisheye_pair(panoramas[0]).save(tmp_path / "0.png")
    for i, photo in enumerate(itertools.islice(draw_photos(), 2), 1):
        photo.save(tmp_path / f"{i}.png")
    photos = read_photos(tmp_path, ["0.png", "1.png", "2.png"], lambda *step: None)
    is_fisheye_pairs = [photo.is_fisheye_pair for photo in photos]
    assert is_fisheye_pairs == [True, False, False]


def test_views_are_paired_with_those_of_other_panoramas():
    rigs = [[f"{i}.jpg/{view}.jpg" for view in range(VIEWS)] for i in range(20)]
    names = ["a.jpg", *itertools.chain(*rigs)]
    every = choose_pairs(names, rigs, "exhaustive")
    assert len(every) == 190 * VIEWS**2 + 20 * VIEWS
    for a, b in every:
        assert a.split("/")[0] != b.split("/")[0]
    some = choose_pairs(names, rigs, "sequential")
    assert ("0.jpg/0.jpg", "2.jpg/0.jpg") in some
    assert ("0.jpg/0.jpg", "1.jpg/4.jpg") in some
    assert ("0.jpg/0.jpg", "1.jpg/2.jpg") not in some
    assert ("19.jpg/7.jpg", "a.jpg") in some
    assert len(some) < 16 * 160
