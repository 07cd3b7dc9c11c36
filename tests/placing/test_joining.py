"""Photos of several cameras in a folder each: grouped apart, and joined where the focal lengths are the same."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from helpers.drawn_photos import WIDTH, camera_centres, draw_photos
from sadgs_ns.cli.process import Process, process
from sadgs_ns.placing.joining import same_cameras
from sadgs_ns.placing.photos import Photo, photos_by_camera, photos_by_camera_and_folder

COUNT = 10  # Photos of a folder


def photos_of(folder: str, count: int, size: int = 8, has_focal_length: bool = False) -> list[Photo]:
    camera = ((size, size), has_focal_length)
    names = [f"{folder}/{i}.png".removeprefix("/") for i in range(count)]
    return [Photo(name, (size, size), camera, False, has_focal_length=has_focal_length) for name in names]


@pytest.mark.parametrize(
    ("photos", "counts"),
    [
        (photos_of("cam0", 10) + photos_of("cam1", 12), [10, 12]),
        (photos_of("cam0", 10) + photos_of("cam1", 9), [19]),
        (photos_of("cam0", 10) + photos_of("cam1", 10) + photos_of("", 3) + photos_of("cam2", 4), [10, 10, 7]),
        (photos_of("", 10) + photos_of("night", 11), [10, 11]),
        (photos_of("cam0", 10, has_focal_length=True) + photos_of("cam1", 10, has_focal_length=True), [20]),
        (photos_of("cam0", 10, 8) + photos_of("cam1", 10, 9), [10, 10]),
        (photos_of("a", 10) + photos_of("b", 10) + photos_of("a", 4, 9) + photos_of("b", 4, 9), [10, 10, 8]),
    ],
)
def test_a_large_folder_has_a_camera_where_exif_tells_no_focal_length(photos: list[Photo], counts: list[int]):
    groups = photos_by_camera_and_folder(photos)
    assert [len(group) for group in groups] == counts
    alike = [set(names) for names in photos_by_camera(photos)]
    for group in groups:
        assert any(names.issuperset(group) for names in alike)


def centres(phase: float) -> np.ndarray:
    """The drawn room's centres, moved along their arc by an angle in rad. [COUNT, 3]"""
    cosine = np.cos(phase)
    sine = np.sin(phase)
    return camera_centres() @ np.array([[cosine, sine, 0], [-sine, cosine, 0], [0, 0, 1]])


def take_photos(folder: Path, phase: float, focal_length: float) -> None:
    folder.mkdir(parents=True)
    for i, photo in enumerate(draw_photos(centres(phase), focal_length)):
        photo.save(folder / f"{i:02d}.png")


def camera_of_folders(model: pycolmap.Reconstruction) -> dict[str, int]:
    """The camera of each folder, whose photos all have it."""
    cameras: dict[str, set[int]] = {}
    for image in model.images.values():
        cameras.setdefault(image.name.partition("/")[0], set()).add(image.camera_id)
    for found in cameras.values():
        assert len(found) == 1
    return {folder: min(found) for folder, found in cameras.items()}


def error_of_centres(model: pycolmap.Reconstruction, phases: dict[str, float]) -> float:
    """The largest distance of a camera from where it is, as a share of the largest from their centre."""
    images = sorted(model.images.values(), key=lambda image: image.name)
    expected = np.concatenate([centres(phases[folder]) for folder in sorted(phases)])
    found = np.stack([image.projection_center() for image in images])
    similarity = pycolmap.estimate_sim3d(found, expected)
    assert similarity is not None
    aligned = np.stack([similarity * centre for centre in found])
    errors = np.linalg.norm(aligned - expected, axis=1)
    return errors.max() / np.linalg.norm(expected - expected.mean(0), axis=1).max()


@pytest.mark.hard_case(
    "two cameras of one image size without EXIF, in a folder each",
    "each of ten photos or more has a camera; those whose focal lengths are within 1 % are joined, and photos that are "
    "added keep their folder's camera",
)
@pytest.mark.slow
def test_folders_of_two_lenses_keep_two_cameras_and_one_that_is_added_finds_its_own(tmp_path: Path):
    phases = {"cam0": 0.0, "cam1": 0.04}
    source = tmp_path / "photos"
    out = tmp_path / "out"
    take_photos(source / "cam0", phases["cam0"], WIDTH)
    take_photos(source / "cam1", phases["cam1"], 1.25 * WIDTH)
    assert process(Process(source, out)).registered == 2 * COUNT
    before = pycolmap.Reconstruction(out / "work/model")
    cameras = camera_of_folders(before)
    assert len(set(cameras.values())) == 2
    for folder, factor in (("cam0", 1), ("cam1", 1.25)):
        actual = before.cameras[cameras[folder]].mean_focal_length()
        expected = pytest.approx(factor * WIDTH, rel=0.02)
        assert actual == expected
    assert error_of_centres(before, phases) < 0.03

    take_photos(source / "cam2", 0.08, 1.25 * WIDTH)
    assert process(Process(source, out)).registered == 3 * COUNT
    after = pycolmap.Reconstruction(out / "work" / f"model-{3 * COUNT}")
    assert camera_of_folders(after) == cameras | {"cam2": cameras["cam1"]}
    for camera_id in cameras.values():
        assert (after.cameras[camera_id].params == before.cameras[camera_id].params).all()
    assert error_of_centres(after, phases | {"cam2": 0.08}) < 0.03


def test_folders_of_one_lens_have_one_camera_to_which_photos_are_added(tmp_path: Path):
    source = tmp_path / "photos"
    out = tmp_path / "out"
    later = tmp_path / "later"
    take_photos(source / "cam0", 0.0, WIDTH)
    take_photos(source / "cam1", 0.04, WIDTH)
    take_photos(later, 0.06, WIDTH)
    assert process(Process(source, out)).registered == 2 * COUNT
    before = pycolmap.Reconstruction(out / "work/model")
    assert len(before.cameras) == len(before.rigs) == 1
    assert before.is_valid()
    (camera,) = before.cameras.values()
    assert camera.mean_focal_length() == pytest.approx(WIDTH, rel=0.02)
    with pycolmap.Database.open(out / "work/database.db") as database:
        camera_ids = {image.camera_id for image in database.read_all_images()}
        assert camera_ids == {camera.camera_id}

    for name in ("03.png", "07.png"):
        shutil.move(later / name, source / "cam1" / f"added-{name}")
    assert process(Process(source, out)).registered == 2 * COUNT + 2
    after = pycolmap.Reconstruction(out / "work" / f"model-{2 * COUNT + 2}")
    assert list(after.cameras) == [camera.camera_id]
    assert (after.cameras[camera.camera_id].params == camera.params).all()


def cameras_with(focal_lengths: list[tuple[float, float]]) -> pycolmap.Reconstruction:
    """A model of a photo for each camera, called by their numbers from 1 on."""
    model = pycolmap.Reconstruction()
    for number, (fx, fy) in enumerate(focal_lengths, 1):
        camera = pycolmap.Camera(model="PINHOLE", width=8, height=8, params=[fx, fy, 4, 4], camera_id=number)
        model.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(name=str(number), image_id=number, camera_id=number)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    return model


def test_cameras_are_the_same_within_one_percent_both_ways():
    model = cameras_with([(100, 100), (100.9, 99.2), (101.1, 100), (100, 98.9)])
    actual = same_cameras(model, [["1", "2", "3", "4"]], set())
    assert actual == {2: 1}
    actual = same_cameras(model, [["1", "3", "4"], ["2"]], set())
    assert actual == {}
    assert same_cameras(model, [["1", "2"]], {2}) == {1: 2}
    assert same_cameras(model, [["1", "2"]], {1, 2}) == {}
