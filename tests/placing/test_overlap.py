"""Stages of placing that overlap: what comes out is the same as without."""

from __future__ import annotations

import importlib
import threading
import time
from concurrent.futures import Future
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from numpy.testing import assert_array_equal

from helpers.colmap_database import rows_of
from helpers.drawn_photos import draw_photos
from sadgs_ns.placing.plan import Matching


@pytest.fixture(scope="module")
def ahead() -> ModuleType:
    """The modules are imported after Pillow, as in the command, where they have a process of their own."""
    from sadgs_ns.placing import matching_ahead

    return matching_ahead


def future_of(device: torch.device | None) -> Future[torch.device | None]:
    future: Future[torch.device | None] = Future()
    future.set_result(device)
    return future


def features_of(ahead: ModuleType, number: int, rng: np.random.Generator, shared: np.ndarray | None = None) -> Any:
    """Made-up features of photo `number`, of which some are shared with others."""
    values = rng.exponential(size=(40, 128))
    descriptors = np.round(512 * np.sqrt(values / values.sum(axis=1, keepdims=True))).clip(0, 255).astype(np.uint8)
    if shared is not None:
        descriptors[: len(shared)] = shared
    keypoints = np.c_[rng.uniform(0, 100, (40, 2)), rng.uniform(1, 9, 40), np.zeros(40)].astype(np.float32)
    return ahead.PhotoFeatures(f"{number:02}.png", number + 1, keypoints, descriptors)


def ring_of_photos(ahead: ModuleType, number: int) -> list[Any]:
    """Photos of a ring, each of which shares features with the next ones, in a mixed order."""
    rng = np.random.default_rng(0)
    scene = features_of(ahead, 0, rng).descriptors
    scene = np.concatenate([scene, *(features_of(ahead, 0, rng).descriptors for _ in range(number))])
    photos = [features_of(ahead, i, rng, np.roll(scene, -10 * i, axis=0)[:30]) for i in range(number)]
    return [photos[i] for i in rng.permutation(number)]


def test_each_pair_of_a_plan_is_matched_in_its_order(ahead: ModuleType):
    from sadgs_ns.placing.matching import match_descriptors

    photos = ring_of_photos(ahead, 6)
    by_name = {photo.name: photo for photo in photos}
    pairs = [("00.png", "01.png"), ("02.png", "01.png"), ("05.png", "03.png"), ("05.png", "absent.png")]
    with ahead.MatchingAhead(future_of(torch.device("cpu")), ahead.PlannedPartners(pairs)) as work:
        for photo in photos:
            work.add(photo)
        work.add(None)  # The thread ends when it has matched all.
        work._work.result(60)
        work.stop()
        matches = dict(work.matches)
    assert not work.matches
    assert not work.descriptors
    assert set(matches) == {(1, 2), (3, 2), (6, 4)}
    for one, other in pairs[:3]:
        expected = match_descriptors(*(torch.from_numpy(by_name[name].descriptors) for name in (one, other)))
        found = matches[by_name[one].image_id, by_name[other].image_id]
        assert_array_equal(found, expected.numpy())
    assert len(matches[1, 2]) >= 15


def test_the_pairs_that_look_most_alike_in_the_end_are_among_those_of_any_order(ahead: ModuleType, monkeypatch):
    from sadgs_ns.placing.matching import largest_descriptors, similar_pairs

    monkeypatch.setattr(ahead, "NEIGHBORS", 4)
    photos = ring_of_photos(ahead, 14)
    partners = ahead.AlikePartners([])
    largest = {}
    matched = []
    for photo in photos:
        largest[photo.image_id] = largest_descriptors(photo.keypoints, photo.descriptors, None)
        matched += partners(photo, largest)
    ordered = sorted(photos, key=lambda photo: photo.name)
    chosen = similar_pairs([largest[photo.image_id] for photo in ordered], 4)
    expected = {(ordered[i].image_id, ordered[j].image_id) for i, j in chosen}
    is_alike = {pair for pair in expected if abs(pair[0] - pair[1]) in (1, 2, 12, 13)}
    assert len(is_alike) == 28
    assert is_alike <= {*matched}
    assert len(matched) == len({*matched}) < 14 * 13 / 2
    for one, other in matched:
        assert one < other


def test_views_of_one_panorama_and_photos_without_features_are_not_matched(ahead: ModuleType):
    from sadgs_ns.placing.matching import largest_descriptors

    photos = sorted(ring_of_photos(ahead, 4), key=lambda photo: photo.name)
    empty = ahead.PhotoFeatures("09.png", 10, np.zeros((0, 4), np.float32), np.zeros((0, 128), np.uint8))
    partners = ahead.AlikePartners([[photos[0].name, photos[1].name]])
    largest = {}
    matched = []
    for photo in [empty, *photos, empty]:
        largest[photo.image_id] = largest_descriptors(photo.keypoints, photo.descriptors, None)
        matched += partners(photo, largest)
    assert (1, 2) not in matched
    assert {(1, 3), (2, 3), (3, 4)} <= {*matched}


def test_without_a_gpu_nothing_is_matched_and_no_photo_is_kept(ahead: ModuleType):
    gpu: Future[torch.device | None] = Future()
    photo = ring_of_photos(ahead, 2)[0]
    with ahead.MatchingAhead(gpu, ahead.AlikePartners([])) as work:
        work.add(photo)
        gpu.set_result(None)
        work._work.result(60)
        work.add(photo)
        assert work._photos.empty()
        work.stop()
        assert not work.matches
        assert not work.descriptors


def test_photos_that_wait_too_long_are_left_out_and_none_is_matched_after_the_end(
    ahead: ModuleType, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(ahead, "_MOST_WAITING", 3)
    photos = ring_of_photos(ahead, 5)
    gpu: Future[torch.device | None] = Future()
    with ahead.MatchingAhead(gpu, ahead.AlikePartners([])) as work:
        for photo in photos:
            work.add(photo)
        gpu.set_result(torch.device("cpu"))
        while not work._photos.empty():
            time.sleep(0.01)
        work.stop()
        assert set(work.descriptors) <= {photo.image_id for photo in photos[:3]}
    gpu = Future()
    with ahead.MatchingAhead(gpu, ahead.AlikePartners([])) as work:
        for photo in photos:
            work.add(photo)
        threading.Timer(0.1, gpu.set_result, [torch.device("cpu")]).start()
        work.stop()
        assert not work.descriptors


def test_an_error_of_the_thread_is_raised_and_an_error_of_the_block_ends_it(ahead: ModuleType):
    gpu: Future[torch.device | None] = Future()
    gpu.set_exception(RuntimeError("no memory"))
    with ahead.MatchingAhead(gpu, ahead.AlikePartners([])) as work, pytest.raises(RuntimeError, match="no memory"):
        work.stop()
    work = ahead.MatchingAhead(future_of(torch.device("cpu")), ahead.AlikePartners([]))
    with pytest.raises(ValueError, match="broken"), work:
        raise ValueError("broken")
    assert work._work.done()


@pytest.mark.parametrize("way", ["exhaustive", "sequential", "similar"])
def test_the_database_is_the_same_as_without(ahead: ModuleType, tmp_path: Path, way: Matching):
    from sadgs_ns.placing import reconstruct
    from sadgs_ns.placing.features import extract

    names = []
    for i, photo in enumerate(draw_photos()):
        names.append(f"{i}.png")
        photo.save(tmp_path / names[-1])
    gpu = future_of(torch.device("cpu"))
    groups = [names[5:], names[:5]]  # So numbers of images are not in the order of their names.
    extract(tmp_path, groups, tmp_path / "after.db")
    reconstruct.match(names, tmp_path / "after.db", way, gpu.result())
    with ahead.MatchingAhead(gpu, reconstruct.partners_of(names, (), way)) as work:
        extract(tmp_path, groups, tmp_path / "ahead.db", (), work.add)
        work.add(None)
        work._work.result(60)
        count = len(work.matches)
        reconstruct.match(names, tmp_path / "ahead.db", way, gpu.result(), ahead=work)
        assert not work.matches, "all were used"
    after = rows_of(tmp_path / "after.db", "matches")
    assert count == len(after) > 20
    assert rows_of(tmp_path / "ahead.db", "matches") == after
    geometries = rows_of(tmp_path / "after.db", "two_view_geometries")
    assert rows_of(tmp_path / "ahead.db", "two_view_geometries") == geometries


def test_images_are_undistorted_while_the_model_is_written_and_again_after_an_interruption(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """With a GPU, whose place the processor takes."""
    from sadgs_ns.placing import reconstruct
    from sadgs_ns.placing.undistortion import Undistortion

    (tmp_path / "photos").mkdir()
    names = []
    for i, photo in enumerate(draw_photos()):
        names.append(f"{i}.png")
        photo.save(tmp_path / "photos" / names[-1])
    writer: Future[ModuleType] = Future()
    writer.set_result(importlib.import_module("nerfstudio.process_data.colmap_utils"))
    monkeypatch.setattr(reconstruct, "begin_imports", lambda: (future_of(torch.device("cpu")), writer))
    model = tmp_path / "work/model"
    model.parent.mkdir()
    had_model = []
    begin = Undistortion.begin

    def noting(undistortion: Undistortion, made: Any) -> None:
        had_model.append(model.exists())
        begin(undistortion, made)

    monkeypatch.setattr(Undistortion, "begin", noting)
    arguments = (tmp_path / "photos", [names], "exhaustive", 0, model, None, [])
    summary = reconstruct.make_model(*arguments)
    undistorted = model.with_name("undistorted")
    files = ["transforms.json", "sparse/0/cameras.bin", "sparse/0/images.bin", "sparse/0/points3D.bin"]
    files += [f"images/{name}" for name in names]
    written = {file: (undistorted / file).read_bytes() for file in files}
    (undistorted / "images" / names[0]).unlink()
    assert reconstruct.make_model(*arguments) == summary
    assert summary.registered == len(names)
    assert had_model == [False, True]
    theirs = tmp_path / "theirs"
    theirs.mkdir()
    writer.result().colmap_to_json(undistorted / "sparse/0", theirs)
    for file in ("transforms.json", "sparse_pc.ply"):
        assert (undistorted / file).read_bytes() == (theirs / file).read_bytes()
    actual = {file: (undistorted / file).read_bytes() for file in files}
    assert actual == written
