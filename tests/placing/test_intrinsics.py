"""Cameras have few parameters while photos are placed, and all of them in the end."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from helpers.drawn_photos import HEIGHT, VIEWS, WIDTH, draw_photos
from sadgs_ns.placing import reconstruct
from sadgs_ns.placing.adjustment import adjust_robustly
from sadgs_ns.placing.features import extract
from sadgs_ns.placing.intrinsics import few_parameters, free_all_parameters

STRETCH = 1.1  # Width of the photos' pixels over their height


def write_cameras(database: Path) -> None:
    """Write a lens with a known focal length, one with a guess, and a camera of panoramas."""
    with pycolmap.Database.open(database) as opened:
        for focal, is_known in ((90.0, True), (120.0, False)):
            camera = pycolmap.Camera.create_from_model_name(1, "OPENCV", focal, 100, 80)
            camera.has_prior_focal_length = is_known
            opened.write_camera(camera)
        opened.write_camera(pycolmap.Camera(model="PINHOLE", width=50, height=50, params=[25.0] * 4))


def read_cameras(database: Path) -> list[tuple[str, float, bool]]:
    with pycolmap.Database.open(database) as opened:
        cameras = opened.read_all_cameras()
    return [(camera.model_name, camera.mean_focal_length(), camera.has_prior_focal_length) for camera in cameras]


def test_cameras_have_few_parameters_for_a_while_and_then_all_again(tmp_path: Path):
    database = tmp_path / "database.db"
    write_cameras(database)
    before = read_cameras(database)
    actual = [name for name, _, _ in before]
    assert actual == ["OPENCV", "OPENCV", "PINHOLE"]
    with pytest.raises(RuntimeError, match="stopped"), few_parameters(database, fixed_cameras={2}):
        within = read_cameras(database)
        raise RuntimeError("stopped")
    assert within == [("SIMPLE_RADIAL", 90.0, True), *before[1:]]
    assert read_cameras(database) == before


@pytest.mark.hard_case("a run is killed while photos are placed", "its cameras get all their parameters all the same")
def test_cameras_that_a_killed_run_left_with_few_parameters_get_all(tmp_path: Path):
    database = tmp_path / "database.db"
    write_cameras(database)
    before = read_cameras(database)
    killed = few_parameters(database, fixed_cameras=())
    killed.__enter__()
    actual = [name for name, _, _ in read_cameras(database)]
    assert actual == ["SIMPLE_RADIAL", "SIMPLE_RADIAL", "PINHOLE"]
    with few_parameters(database, fixed_cameras=()):
        pass
    assert read_cameras(database) == before


def test_cameras_with_all_parameters_project_as_those_with_few():
    model = pycolmap.Reconstruction()
    few = pycolmap.Camera(model="SIMPLE_RADIAL", width=100, height=80, params=[90, 49, 41, -0.1], camera_id=1)
    model.add_camera(few)
    rays = np.array([[0.1, 0.2, 1.0], [-0.4, 0.3, 1.0], [0.0, -0.4, 1.0]])
    expected = np.asarray(few.img_from_cam(rays))
    free_all_parameters(model)
    assert model.cameras[1].model_name == "OPENCV"
    found = np.asarray(model.cameras[1].img_from_cam(rays))
    assert np.allclose(found, expected, rtol=0, atol=1e-9)


@pytest.fixture(scope="module")
def stretched(tmp_path_factory: pytest.TempPathFactory) -> pycolmap.Reconstruction:
    """The model of photos whose pixels are wider than high."""
    folder = tmp_path_factory.mktemp("stretched")
    photos = folder / "photos"
    photos.mkdir()
    names = []
    for i, photo in enumerate(draw_photos()):
        names.append(f"{i:02d}.png")
        photo.resize((round(WIDTH * STRETCH), HEIGHT)).save(photos / names[-1])
    database = folder / "database.db"
    extract(photos, [names], database, [])
    reconstruct.match(names, database, "exhaustive", None)
    reconstruct.place_cameras(photos, names, database, folder / "model", None)
    return pycolmap.Reconstruction(folder / "model")


@pytest.mark.hard_case("photos whose pixels are 1.1 times as wide as high", "all register, with two focal lengths")
def test_photos_that_were_stretched_register_and_have_two_focal_lengths(stretched: pycolmap.Reconstruction):
    assert stretched.num_reg_images() == VIEWS
    (camera,) = stretched.cameras.values()
    assert camera.model_name == "OPENCV"
    assert camera.focal_length_x / camera.focal_length_y == pytest.approx(STRETCH, rel=0.02)


@pytest.mark.hard_case("a point that the robust adjustment leaves behind its cameras", "is left out")
def test_points_behind_their_cameras_are_left_out(stretched: pycolmap.Reconstruction):
    point_id, point = next(iter(stretched.points3D.items()))
    image = stretched.images[point.track.elements[0].image_id]
    points_before = stretched.num_points3D()
    point.xyz = image.projection_center() - 100 * (point.xyz - image.projection_center())
    adjust_robustly(stretched)
    assert point_id not in stretched.points3D
    assert stretched.num_points3D() > 0.95 * points_before
    assert max(point.error for point in stretched.points3D.values()) < 4
