"""Models that few points hold together are settled and compared with other placings, on photos of a drawn room."""

from __future__ import annotations

import copy
import math
import shutil
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from helpers.drawn_photos import VIEWS, WIDTH, draw_photos
from sadgs_ns.placing import reconstruct
from sadgs_ns.placing.adjustment import is_firm, leave_out_unheld, settle
from sadgs_ns.placing.agreement import disagreement, most_agreed
from sadgs_ns.placing.features import extract


@pytest.fixture(scope="module")
def placed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with photos, their database, and their model, which is not firm because the photos are small."""
    folder = tmp_path_factory.mktemp("room")
    photos = folder / "photos"
    photos.mkdir()
    names = [f"{i:02d}.png" for i in range(VIEWS)]
    for name, photo in zip(names, draw_photos(), strict=True):
        photo.save(photos / name)
    extract(photos, [names], folder / "database.db")
    reconstruct.match(names, folder / "database.db", "exhaustive", None)
    reconstruct.place_cameras(photos, names, folder / "database.db", folder / "model", None)
    return folder


@pytest.fixture
def model(placed: Path) -> pycolmap.Reconstruction:
    return pycolmap.Reconstruction(placed / "model")


def misplaced(model: pycolmap.Reconstruction, step: float) -> pycolmap.Reconstruction:
    """A copy of which three photos lie elsewhere, by so much of the distance to the points."""
    moved = copy.deepcopy(model)
    for frame_id in sorted(moved.frames)[-3:]:
        pose = moved.frames[frame_id].rig_from_world
        depth = np.median([(pose * point.xyz)[2] for point in moved.points3D.values()])
        shift = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([step * depth, 0, 0]))
        moved.frames[frame_id].rig_from_world = shift * pose
    return moved


def inliers(database: Path) -> dict[int, int]:
    """The number of verified matches of each pair of photos."""
    with pycolmap.Database.open(database) as opened:
        return dict(zip(*opened.read_two_view_geometry_num_inliers(), strict=True))


def rank(model: pycolmap.Reconstruction) -> tuple[bool, int]:
    return True, model.num_reg_images()


def test_equal_models_agree_and_misplaced_photos_disagree(model: pycolmap.Reconstruction):
    assert disagreement(model, model) < 1e-6
    similar = copy.deepcopy(model)
    similar.transform(pycolmap.Sim3d(2.5, pycolmap.Rotation3d(np.array([0.3, -0.2, 0.5])), np.array([4.0, -1.0, 2.0])))
    assert disagreement(model, similar) < 1e-6
    # A focal length of WIDTH px, so that three of ten photos move by a fifth of their width.
    actual = disagreement(model, misplaced(model, 0.2))
    expected = pytest.approx(0.3 * 0.2, rel=0.2)
    assert actual == expected


def test_points_behind_a_camera_count_as_moved_across_the_photo(model: pycolmap.Reconstruction):
    turned = copy.deepcopy(model)
    frame = turned.frames[max(turned.frames)]
    frame.rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([0, np.pi, 0])), np.zeros(3)) * (
        frame.rig_from_world
    )
    assert disagreement(model, turned) == pytest.approx(1 / VIEWS, rel=0.05)


def test_models_with_nothing_in_common_disagree_as_far_as_can_be(model: pycolmap.Reconstruction):
    empty = copy.deepcopy(model)
    for point_id in list(empty.points3D):
        empty.delete_point3D(point_id)
    assert disagreement(model, empty) == 1


@pytest.mark.hard_case(
    "photos that few points hold together, whose model is wrong by chance though all register",
    "they are placed again with other random samples; of up to three models one of the two most alike is kept",
)
def test_of_three_models_one_of_those_that_agree_is_kept(model: pycolmap.Reconstruction):
    numbers: list[int] = []

    def place_again(number: int) -> pycolmap.Reconstruction:
        numbers.append(number)
        return copy.deepcopy(model)

    wrong = misplaced(model, 0.3)
    kept, moved = most_agreed(wrong, place_again, rank)
    assert numbers == [1, 2]
    assert moved < 1e-6
    assert disagreement(kept, model) < 1e-6
    numbers.clear()
    kept, moved = most_agreed(model, place_again, rank)
    assert numbers == [1]
    assert moved < 1e-6
    assert kept is model


@pytest.mark.hard_case("photos that few points hold together, placed otherwise each time", "told as doubtful or wrong")
def test_models_that_never_agree_are_told(model: pycolmap.Reconstruction):
    others = {1: misplaced(model, 0.1), 2: misplaced(model, -0.15)}
    _, moved = most_agreed(model, others.get, rank)
    assert 0.02 < moved == disagreement(model, others[1]) < 0.05
    others = {1: misplaced(model, 0.4), 2: misplaced(model, -0.4)}
    _, far = most_agreed(model, others.get, rank)
    assert far > 0.05


def test_a_model_with_far_fewer_photos_confirms_but_does_not_replace(model: pycolmap.Reconstruction):
    few = copy.deepcopy(model)
    for frame_id in list(few.frames)[-2:]:
        few.deregister_frame(frame_id)
    wrong = misplaced(model, 0.3)
    kept, _ = most_agreed(wrong, lambda number: copy.deepcopy(few), rank)
    assert kept is wrong
    kept, moved = most_agreed(model, lambda number: copy.deepcopy(few), rank)
    assert kept is model
    assert moved < 1e-6


def test_photos_that_cannot_be_placed_again_are_not_judged_by_that(model: pycolmap.Reconstruction):
    kept, moved = most_agreed(model, lambda number: None, rank)
    assert kept is model
    assert math.isnan(moved)


def test_the_disagreement_reaches_the_summary(placed: Path, model: pycolmap.Reconstruction):
    assert float((placed / "model/disagreement.txt").read_text()) < 0.02
    names = [image.name for image in model.images.values()]
    database = placed / "database.db"
    assert not reconstruct.summarize(names, model, database, "exhaustive", "", 0.015).doubts
    doubted = reconstruct.summarize(names, model, database, "exhaustive", "", 0.03)
    (doubt,) = doubted.doubts
    assert "placed again with other random samples they move by 3 % of a photo's size" in doubt
    assert not doubted.is_poor
    assert reconstruct.summarize(names, model, database, "exhaustive", "", 0.15).is_poor


def test_a_firm_model_is_placed_once(placed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    shutil.copy(placed / "database.db", tmp_path)
    monkeypatch.setattr(reconstruct, "is_firm", lambda model: True)
    monkeypatch.delattr(reconstruct._Search, "place_again")
    names = [f"{i:02d}.png" for i in range(VIEWS)]
    reconstruct.place_cameras(placed / "photos", names, tmp_path / "database.db", tmp_path / "model", None)
    assert math.isnan(float((tmp_path / "model/disagreement.txt").read_text()))


def test_other_samples_verify_the_matches_in_a_copy(placed: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    shutil.copy(placed / "database.db", tmp_path)
    seeds: list[int] = []
    verify = pycolmap.geometric_verification

    def record(database: Path, two_view_geometry_options: pycolmap.TwoViewGeometryOptions) -> None:
        seeds.append(two_view_geometry_options.ransac.random_seed)
        verify(database, two_view_geometry_options=two_view_geometry_options)

    monkeypatch.setattr(pycolmap, "geometric_verification", record)
    before = inliers(tmp_path / "database.db")
    names = [f"{i:02d}.png" for i in range(VIEWS)]
    reconstruct.place_cameras(placed / "photos", names, tmp_path / "database.db", tmp_path / "model", None)
    assert seeds == [1000]
    assert inliers(tmp_path / "database.db") == before
    assert not (tmp_path / "again.db").exists()


def test_settling_brings_back_a_focal_length_and_the_observations(placed: Path, model: pycolmap.Reconstruction):
    assert not is_firm(model)
    count = model.compute_num_observations()
    slid = copy.deepcopy(model)
    for camera in slid.cameras.values():
        camera.focal_length_x *= 1.2
        camera.focal_length_y *= 1.2
    for point_id in sorted(slid.points3D)[::3]:
        slid.delete_point3D(point_id)
    settle(slid, placed / "database.db", pycolmap.IncrementalPipelineOptions())
    (camera,) = slid.cameras.values()
    assert camera.mean_focal_length() == pytest.approx(WIDTH, rel=0.02)
    assert slid.compute_num_observations() > 0.95 * count
    assert disagreement(model, slid) < 0.005


def keep_observations(model: pycolmap.Reconstruction, image: pycolmap.Image, number: int) -> None:
    """Take all but some of a photo's observations away."""
    observed = [place for place, point in enumerate(image.points2D) if point.has_point3D()]
    for place in observed[number:]:
        model.delete_observation(image.image_id, place)


@pytest.mark.hard_case("a photo that hardly any point holds, as one in which things stand before the rest", "left out")
def test_a_photo_that_keeps_few_observations_is_left_out_and_others_stay(model: pycolmap.Reconstruction):
    loose, held, *_ = [model.images[image_id] for image_id in sorted(model.reg_image_ids())]
    keep_observations(model, loose, 14)
    keep_observations(model, held, 15)
    kept = copy.deepcopy(model)
    leave_out_unheld(kept, [loose.frame_id])
    assert kept.num_reg_images() == model.num_reg_images(), "photos of an earlier model stay"
    before = {image.name for image in model.images.values() if image.has_pose}
    leave_out_unheld(model)
    after = {image.name for image in model.images.values() if image.has_pose}
    assert before - after == {loose.name}
    for point in model.points3D.values():
        assert all(model.images[element.image_id].has_pose for element in point.track.elements)
