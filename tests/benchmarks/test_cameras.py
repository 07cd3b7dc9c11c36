"""The benchmark of cameras: models are compared, observations left out, and errors measured where truth is known."""

from __future__ import annotations

import copy
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
import yaml
from numpy.testing import assert_allclose

from benchmarks import camera_measures, camera_run, camera_table, camera_truth, cameras, results, side_by_side
from benchmarks.camera_measures import leave_out, reprojection_errors
from helpers.drawn_photos import VIEWS, draw_photos
from helpers.json_files import write_json
from sadgs_ns.placing import reconstruct
from sadgs_ns.placing.agreement import Observed, align, common_points, displacement

SIMILARITY = pycolmap.Sim3d(2.5, pycolmap.Rotation3d(np.array([0.3, -0.2, 0.5])), np.array([4.0, -1.0, 2.0]))
CONFIG = Path(cameras.__file__).parents[1] / "configs/bench/placing.yaml"


def drawn(**fields: Any) -> tuple[pycolmap.Reconstruction, pycolmap.Reconstruction]:
    """The true model of a small drawn capture, and the perturbed one."""
    return camera_truth.draw(camera_truth.Truth(cameras=12, points=600, **fields), seed=0)


def test_points_are_the_same_if_they_share_most_observations():
    one = {("a", 0): 1, ("b", 0): 1, ("c", 0): 1, ("a", 1): 2, ("b", 1): 2, ("a", 2): 3, ("c", 7): 4, ("d", 7): 4}
    other = {("a", 0): 11, ("b", 0): 11, ("c", 0): 12, ("d", 0): 12, ("a", 1): 12, ("b", 1): 12, ("a", 2): 13}
    other |= {("c", 7): 11, ("d", 7): 11}
    # Point 3 shares one observation alone, and point 11 shares as many with 4 as with 1, which comes first.
    assert common_points(one, other) == [(1, 11), (2, 12)]
    assert common_points(one, {}) == []


def test_a_similarity_is_found_in_spite_of_points_that_moved_elsewhere():
    points = np.random.default_rng(0).uniform(-1, 1, (60, 3))
    targets = SIMILARITY * points
    targets[:10] += 3.0
    found = align(points, targets)
    assert_allclose(found.matrix(), SIMILARITY.matrix(), atol=1e-9)


def test_points_without_a_similarity_are_refused():
    line = np.outer(np.arange(5.0), [1.0, 2.0, 3.0])
    for points in (line, line[:2], line[:0]):
        with pytest.raises(ValueError, match="cannot be compared"):
            align(points, points)


def test_models_that_differ_by_a_similarity_are_equal():
    one, _ = drawn()
    other = copy.deepcopy(one)
    other.transform(SIMILARITY)
    moved = displacement(Observed.of(one), Observed.of(other))
    assert moved.points == one.num_points3D()
    assert moved.mean < 1e-6
    assert moved.worst < 1e-6


def test_points_move_by_as_many_px_as_a_camera_s_principal_point():
    one, _ = drawn()
    other = copy.deepcopy(one)
    other.transform(SIMILARITY)
    for camera in other.cameras.values():
        camera.principal_point_x += 0.3
        camera.principal_point_y -= 0.4
    moved = displacement(Observed.of(one), Observed.of(other))
    assert moved.mean == pytest.approx(0.5, abs=1e-6)
    assert moved.worst == pytest.approx(0.5, abs=1e-6)


def test_the_worst_view_is_the_one_whose_camera_turned():
    one, _ = drawn()
    other = copy.deepcopy(one)
    frame_id = other.reg_frame_ids()[3]
    pose = other.frames[frame_id].rig_from_world
    assert pose is not None
    turned = pycolmap.Rotation3d(np.array([0.0, 0.0, 1e-3])) * pose.rotation
    other.frames[frame_id].rig_from_world = pycolmap.Rigid3d(turned, pose.translation)
    (image,) = [image for image in other.images.values() if image.frame_id == frame_id]
    moved = displacement(Observed.of(one), Observed.of(other))
    assert moved.worst_view == image.name
    assert moved.worst > 0.1
    assert moved.mean == pytest.approx(moved.worst / one.num_reg_images(), rel=1e-3)


def test_models_without_common_photos_are_refused():
    one, _ = drawn()
    other = copy.deepcopy(one)
    for image in other.images.values():
        image.name = f"other {image.name}"
    with pytest.raises(ValueError, match="too few points in common"):
        displacement(Observed.of(one), Observed.of(other))


def test_a_tenth_of_the_observations_is_left_out_and_three_of_each_point_stay():
    true, _ = drawn(photos_of_point=4)
    before = true.compute_num_observations()
    points = true.num_points3D()
    left_out = leave_out(true, seed=1)
    count = len(left_out.places)
    assert 0.08 * before < count <= 0.1 * before
    assert true.compute_num_observations() == before - count
    assert true.num_points3D() == points
    assert min(point.track.length() for point in true.points3D.values()) == 3
    actual = reprojection_errors(true, left_out)
    assert_allclose(actual, 0.0, atol=1e-6)


def test_points_of_two_or_three_observations_keep_them():
    true, _ = drawn(photos_of_point=3)
    assert len(leave_out(true, seed=1).places) == 0


def test_the_error_of_what_was_left_out_is_its_distance_in_px():
    true, _ = drawn()
    left_out = leave_out(true, seed=1)
    moved = camera_measures.LeftOut(left_out.image_ids, left_out.point_ids, left_out.places + np.array([3.0, -4.0]))
    true.delete_point3D(left_out.point_ids[0])
    found = reprojection_errors(true, moved)
    lost = np.array(left_out.point_ids) == left_out.point_ids[0]
    assert np.isnan(found[lost]).all()
    assert_allclose(found[~lost], 5.0, atol=1e-6)


def test_errors_of_true_cameras_are_those_after_a_similarity():
    true, perturbed = drawn()
    moved = copy.deepcopy(true)
    moved.transform(SIMILARITY)
    found = camera_truth.errors(moved, true)
    assert found.centres < 1e-6
    assert found.rotations < 1e-4
    start = camera_truth.errors(perturbed, true)
    assert start.centres > 0.02
    assert start.rotations > 0.01


def test_a_rotation_of_a_true_camera_is_its_angle():
    true, _ = drawn()
    moved = copy.deepcopy(true)
    for frame in moved.frames.values():
        centre = frame.rig_from_world.inverse().translation
        rotation = pycolmap.Rotation3d(np.array([0.0, np.radians(0.5), 0.0])) * frame.rig_from_world.rotation
        frame.rig_from_world = pycolmap.Rigid3d(rotation, -(rotation * centre))
    found = camera_truth.errors(moved, true)
    assert found.centres < 1e-6
    assert found.rotations == pytest.approx(0.5, rel=1e-4)


def test_a_robust_adjustment_comes_nearer_to_the_truth_than_squares_if_matches_are_wrong():
    truth = {"cameras": 12, "points": 600, "wrong": 0.1, "farthest": 8.0}
    job = cameras.Job("many-wrong", "new", [0, 1, 2], ["released", "squared"], truth=truth)
    measured = camera_run.measure_truth(job)
    start = camera_truth.errors(*reversed(camera_truth.draw(camera_truth.Truth(**truth), 0)))  # type: ignore[arg-type]
    for measure in ("centres", "rotations"):
        robust = np.mean(measured["released"][measure])
        squared = np.mean(measured["squared"][measure])
        assert 1.1 * robust < squared < getattr(start, measure)


def test_variants_are_losses_of_colmap_and_the_released_one_is_the_package_s():
    assert camera_run.options_of("released").ceres.loss_function_type == pycolmap.LossFunctionType.CAUCHY
    assert camera_run.options_of("squared").ceres.loss_function_type == pycolmap.LossFunctionType.TRIVIAL
    assert camera_run.options_of("soft-l1").ceres.loss_function_type == pycolmap.LossFunctionType.SOFT_L1
    assert camera_run.options_of("cauchy-0.5").ceres.loss_function_scale == 0.5


def test_observations_that_do_not_fit_are_left_out_first_where_a_variant_says_so(monkeypatch: pytest.MonkeyPatch):
    true, _ = drawn()
    far = next(place for place in true.images[1].points2D if place.has_point3D())
    far.xy = far.xy + np.array([50.0, 0.0])
    seen: list[int] = []

    def count(model: pycolmap.Reconstruction, *others: Any) -> None:
        seen.append(model.compute_num_observations())

    monkeypatch.setattr(camera_run, "adjust_robustly", count)
    before = true.compute_num_observations()
    for variant in ("released", "soft-l1", "squared"):
        camera_run.Placing(true, (), (), {}).adjusted(variant)
    assert seen[:2] == [before, before]
    assert before > seen[2] > 0.98 * before
    assert true.compute_num_observations() == before


def test_seeds_reach_the_verification_of_matches_and_the_mapper(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    seeds: list[int] = []
    verified: list[int] = []

    def map_nothing(*others: Any, **callbacks: Any) -> dict[int, pycolmap.Reconstruction]:
        seeds.append(others[3].random_seed)
        return {}

    def verify(*others: Any, verification_options: pycolmap.TwoViewGeometryOptions, **options: Any) -> None:
        verified.append(verification_options.ransac.random_seed)

    monkeypatch.setattr(pycolmap, "incremental_mapping", map_nothing)
    monkeypatch.setattr(pycolmap, "match_image_pairs", verify)
    database = tmp_path / "database.db"
    pycolmap.Database.open(database).close()
    reconstruct.match(["a.png", "b.png"], database, "exhaustive", None, seed=7)
    with pytest.raises(ValueError, match="no two photos"):
        reconstruct.place_cameras(tmp_path, ["a.png", "b.png"], database, tmp_path / "model", None, seed=7)
    assert verified == [7]
    assert seeds == [7, 7]


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with photos of a drawn room."""
    folder = tmp_path_factory.mktemp("room")
    photos = folder / "photos"
    photos.mkdir()
    for i, photo in enumerate(draw_photos()):
        photo.save(photos / f"{i:02d}.png")
    return folder


@pytest.fixture(scope="module")
def rows(room: Path) -> list[dict[str, Any]]:
    """The rows of the photos, placed with two seeds."""
    job = cameras.Job("room", "new", [0, 1], ["released", "squared"], folder=str(room / "photos"))
    return cameras.rows_of(job, room)


def test_a_capture_has_a_row_for_each_variant_with_numbers_for_each_seed(rows: list[dict[str, Any]]):
    keys = [row["key"] for row in rows]
    assert keys == ["room/new/released", "room/new/squared"]
    for row in rows:
        assert row["status"] == "ok", row["error"]
        assert row["seeds"] == [0, 1]
        assert row["registered"] == [VIEWS, VIEWS]
        assert row["photos"] == VIEWS
        (pair,) = row["pairs"]
        assert pair["seeds"] == [0, 1]
        assert 0 <= pair["mean"] <= pair["worst"] < 1
        assert pair["points"] > 100
        for errors in row["left_out"]:
            assert 0 < errors["median"] < errors["mean"] < 2
        for stages in row["seconds"]:
            assert {*stages} == {"features", "matches", "cameras", "adjustment"}
        assert row["cores"] >= 1
        assert row["versions"]["pycolmap"] == pycolmap.__version__
    released, squared = rows
    actual = [errors["count"] for errors in released["left_out"]]
    expected = [errors["count"] for errors in squared["left_out"]]
    assert actual == expected
    assert released["left_out"] != squared["left_out"]


def test_seeds_share_matches_and_verify_them_anew(rows: list[dict[str, Any]], room: Path):
    read = []
    for folder in (room, room / "seed-0", room / "seed-1"):
        with pycolmap.Database.open(folder / "database.db") as opened:
            _, matches = opened.read_all_matches()
            _, geometries = opened.read_two_view_geometries()
        inliers = [geometry.inlier_matches.tolist() for geometry in geometries]
        read.append(([found.tolist() for found in matches], inliers))
    (matches, inliers), first, second = read
    assert first == (matches, inliers), "the same seed finds the same inliers"
    assert second[0] == matches
    assert second[1] != inliers


def test_the_table_has_a_line_for_each_variant(rows: list[dict[str, Any]]):
    captures = camera_table.markdown(rows, {"new": "today's"}).splitlines()
    assert len(captures) == 4
    assert captures[2].startswith(f"| room | today's | released | {VIEWS} of {VIEWS} | ")
    assert captures[2].endswith(f" | {rows[0]['cores']} | 2 |")
    actual = camera_table.markdown(rows, {"old": "as of then"})
    assert actual == ""


def test_tables_show_means_and_the_worst_of_all_pairs_and_no_seconds_of_a_busy_machine():
    pairs = [{"mean": 0.1, "worst": 0.2}, {"mean": 0.2, "worst": 0.5}, {"mean": 0.3, "worst": 0.4}]
    errors = [{"median": 0.5, "mean": 0.75}, {"median": 0.25, "mean": 0.25}]
    shared = {"scene": "desk", "label": "new", "status": "ok", "seeds": [0, 1, 2], "cores": 16, "photos": 9}
    row = {**shared, "variant": "released", "registered": [9, 8, 9], "observations": [900.0, 1200.0, 1500.0]}
    seconds = [{"features": 1.0, "adjustment": value} for value in (0.5, 0.7, 3.0)]
    timed = {**row, "pairs": pairs, "left_out": errors, "seconds": seconds}
    untimed = {**timed, "variant": "squared", "seconds": None}
    lines = camera_table.markdown([timed, untimed]).splitlines()[2:]
    assert lines[0] == ("| desk | new | released | 8–9 of 9 | 1,200 | .200 | .500 | .375 | .500 | 0.7 | 1.7 | 16 | 3 |")
    assert lines[1].endswith(" | .375 | .500 | – | – | – | 3 |")
    drawn = {**shared, "scene": "few-wrong", "variant": "released", "centres": [0.004, 0.006], "rotations": [0.01]}
    assert camera_table.markdown_of_truths([drawn, timed]).splitlines()[2:] == [
        "| few-wrong | new | released | .0050 | .0100 | 3 |"
    ]
    assert camera_table.markdown([drawn]) == "" == camera_table.markdown_of_truths([timed])


def test_the_protocol_names_the_captures_that_losses_are_chosen_on():
    protocol = cameras.load(CONFIG)
    assert {*protocol.captures} == {"castle", "tree", "fox", "site", "lund", "plush", "train"}
    assert protocol.seeds == [0, 1, 2, 3, 4]
    for truth in protocol.truths.values():
        camera_truth.Truth(**truth)  # type: ignore[arg-type]


def test_what_is_not_there_is_refused(tmp_path: Path):
    def command(**words: Any) -> cameras.Command:
        return cameras.Command(CONFIG, tmp_path, tmp_path / "rows.jsonl", "new", **words)

    with pytest.raises(ValueError, match=r"holds no photos; check --photos\.$"):
        command(only=("fox",)).jobs()
    with pytest.raises(ValueError, match="--only names 'cat'; the protocol has castle, "):
        command(only=("cat",)).jobs()
    with pytest.raises(ValueError, match="--variant names 'cubed'; there are released, squared, "):
        command(variant=("cubed",)).jobs()
    (tmp_path / "wrong.yaml").write_text(yaml.dump({"captures": {}, "colour": "red"}))
    with pytest.raises(ValueError, match="must be YAML with captures and seeds"):
        cameras.load(tmp_path / "wrong.yaml")
    with pytest.raises(ValueError, match="cannot be read"):
        cameras.load(tmp_path / "none.yaml")


def test_photos_that_cannot_be_placed_give_failed_rows(tmp_path: Path):
    (tmp_path / "0.png").write_bytes(b"")
    job = cameras.Job("empty", "new", [0], ["released", "squared"], folder=str(tmp_path))
    statuses = [row["status"] for row in cameras.rows_of(job, tmp_path)]
    assert statuses == ["failed", "failed"]


def test_a_capture_that_ends_without_rows_is_a_failed_one_and_what_is_done_is_not_done_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    started: list[str] = []

    def start(job: cameras.Job, gpu: str | None, work: Path) -> subprocess.Popen[bytes]:
        started.append(job.name)
        if job.name == "few-wrong":
            return subprocess.Popen(["false"], start_new_session=True)
        measured = {"status": "ok", "error": None, "centres": [0.1], "rotations": [0.2]}
        rows = [job.row(variant, "2026-11-27", **measured) for variant in job.variants]
        write_json(work / "rows.json", rows)
        return subprocess.Popen(["true"], start_new_session=True)

    monkeypatch.setattr(cameras, "_start", start)
    monkeypatch.setattr(side_by_side, "POLL_SECONDS", 0.01)
    output = tmp_path / "rows.jsonl"
    only = ("no-wrong", "few-wrong")
    command = cameras.Command(CONFIG, tmp_path, output, "new", seeds=(3,), only=only, variant=("released",))
    assert command() == 1
    done, failed = results.read(output)
    assert done["key"] == "no-wrong/new/released"
    assert done["seeds"] == [3]
    assert failed["status"] == "failed"
    assert "code 1 and no rows" in failed["error"]
    command()
    assert started == ["no-wrong", "few-wrong", "few-wrong"]
    cameras.Command(CONFIG, tmp_path, output, "new", seeds=(3, 4), only=("no-wrong",), variant=("released",))()
    assert started[3:] == ["no-wrong"], "with other seeds it is measured anew"
