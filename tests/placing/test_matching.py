"""Matches of features by a matrix product, beside a loop over all pairs of descriptors and beside COLMAP's own."""

from __future__ import annotations

import itertools
import shutil
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.ndimage import gaussian_filter

from helpers.colmap_database import rows_of


@pytest.fixture(scope="module")
def matching() -> ModuleType:
    """The module is imported after Pillow, as in the command, where it has a process of its own."""
    from sadgs_ns.placing import matching

    return matching


def random_descriptors(number: int, generator: np.random.Generator) -> np.ndarray:
    values = generator.exponential(size=(number, 128))
    return np.round(512 * np.sqrt(values / values.sum(axis=1, keepdims=True))).clip(0, 255).astype(np.uint8)


def by_hand(one: np.ndarray, other: np.ndarray) -> set[tuple[int, int]]:
    """Mutual matches, one descriptor after the other."""

    def best(of: np.ndarray, among: np.ndarray) -> int:
        cosines = among.astype(float) @ of.astype(float) / 512**2
        angles = np.arccos(np.minimum(cosines, 1.0))
        order = np.argsort(angles, kind="stable")
        near = angles[order[0]] <= 0.7 and (len(order) == 1 or angles[order[0]] < 0.8 * angles[order[1]])
        return int(order[0]) if near else -1

    if not len(one) or not len(other):
        return set()
    matches = set()
    for i, x in enumerate(one):
        j = best(x, other)
        if j >= 0 and best(other[j], one) == i:
            matches.add((i, j))
    return matches


@pytest.mark.parametrize(("number", "others"), [(40, 60), (1, 5), (7, 1), (0, 3), (3, 0)])
def test_matches_are_those_of_a_loop_over_all_pairs(matching: ModuleType, number: int, others: int):
    generator = np.random.default_rng(number)
    one = random_descriptors(number, generator)
    other = random_descriptors(others, generator)
    shared = min(number, others) // 2
    noise = generator.integers(-3, 4, (shared, 128))
    other[:shared] = (one[:shared].astype(int) + noise).clip(0, 255)
    if shared > 3:
        other[shared] = other[0]  # Two are as near as each other, so that neither is a match.
    found = matching.match_descriptors(torch.from_numpy(one), torch.from_numpy(other))
    assert found.shape[1] == 2
    actual = {(i, j) for i, j in found.tolist()}
    assert actual == by_hand(one, other)
    assert len(found) >= shared - 1


def test_photos_are_paired_with_those_that_look_most_alike(matching: ModuleType):
    """Of a ring of photos, each of which shares features with the next ones, and of another that shares none."""
    generator = np.random.default_rng(0)
    scene = random_descriptors(12 * 20, generator)
    ring = [scene[(20 * i + np.arange(60)) % len(scene)] for i in range(12)]
    photos = [*ring, random_descriptors(60, generator), scene[:0]]
    pairs = matching.similar_pairs([torch.from_numpy(photo) for photo in photos], 4)
    near = {(i, j) for i in range(12) for j in range(i + 1, 12) if min(j - i, 12 + i - j) <= 2}
    assert near <= {*pairs}
    assert len(pairs) == len({*pairs}) <= 4 * len(photos)
    for i, j in pairs:
        assert i < j


def test_groups_of_photos_that_hardly_look_alike_are_joined(matching: ModuleType):
    generator = np.random.default_rng(0)
    one = random_descriptors(40, generator)
    other = random_descriptors(40, generator)
    photos = [one] * 4 + [other] * 4
    photos[2] = np.r_[one, other[:1]]
    photos[5] = np.r_[other, other[:1]]
    pairs = matching.similar_pairs([torch.from_numpy(photo) for photo in photos], 3)
    assert any(i < 4 <= j for i, j in pairs)
    assert matching.similar_pairs([torch.zeros(0, 128, dtype=torch.uint8)] * 3, 1)  # as of photos without texture


def parts_of_a_wall(folder: Path) -> list[str]:
    """Write three overlapping photos of a blotchy wall; returns their names."""
    wall = gaussian_filter(np.random.default_rng(0).normal(size=(400, 700)), 2.5)
    wall = np.clip(127 + 60 * wall / wall.std(), 0, 255).astype(np.uint8)
    folder.mkdir()
    names = []
    for i in range(3):
        names.append(f"part {i}.png")
        Image.fromarray(wall[20 * i : 20 * i + 320, 90 * i : 90 * i + 460]).save(folder / names[-1])
    return names


def verification_options():
    import pycolmap

    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.random_seed = 0
    return options


def test_photos_are_related_as_by_colmap_s_own_matches(matching: ModuleType, tmp_path: Path):
    import pycolmap

    from sadgs_ns.placing import features

    names = parts_of_a_wall(tmp_path / "photos")
    inliers = []
    for ours in (False, True):
        database = tmp_path / f"{ours}.db"
        features.extract(tmp_path / "photos", [names], database)
        pairs = [(names[0], names[1]), (names[0], names[2]), (names[1], names[2])]
        if ours:
            # It takes names with spaces, as a list of pairs does not.
            matching.write_matches(database, pairs, torch.device("cpu"), "matches", verification_options())
        else:
            pycolmap.match_exhaustive(database)
        with pycolmap.Database.open(database) as opened:
            ids = {image.name: image.image_id for image in opened.read_all_images()}
            matches = opened.read_matches(ids[names[0]], ids[names[1]])
            one, other = (torch.from_numpy(opened.read_descriptors(ids[name]).data.copy()) for name in names[:2])
            same = {*map(tuple, matches.tolist())} == {*map(tuple, matching.match_descriptors(one, other).tolist())}
            assert same or not ours
            geometries = [opened.read_two_view_geometry(ids[a], ids[b]) for a, b in pairs]
        inliers.append([len(geometry.inlier_matches) for geometry in geometries])
    colmaps, our = inliers
    assert min(colmaps) > 50
    assert our == pytest.approx(colmaps, rel=0.1)


@pytest.fixture(scope="module")
def searched(matching: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[tuple[str, str]]]:
    """A database with the features of three parts of a wall, and of two photos without relation, and pairs of them.

    Some pairs are not in the order of their numbers in the database. One photo has no features at all.
    """
    from sadgs_ns.placing import features

    folder = tmp_path_factory.mktemp("searched")
    names = parts_of_a_wall(folder / "photos")
    noise = gaussian_filter(np.random.default_rng(1).normal(size=(320, 460)), 2.5)
    Image.fromarray((127 + 60 * noise / noise.std()).clip(0, 255).astype(np.uint8)).save(folder / "photos/noise.png")
    Image.new("L", (460, 320)).save(folder / "photos/black.png")
    names += ["noise.png", "black.png"]
    features.extract(folder / "photos", [names], folder / "database.db")
    pairs = list(itertools.combinations(reversed(names), 2))
    return folder / "database.db", pairs


@pytest.mark.parametrize("has_focal_length", [False, True])
def test_matches_are_verified_as_by_colmap_bit_for_bit(
    matching: ModuleType, searched, tmp_path: Path, has_focal_length: bool
):
    import pycolmap

    database, pairs = searched
    shutil.copyfile(database, tmp_path / "ours.db")
    with pycolmap.Database.open(tmp_path / "ours.db") as opened:
        for camera in opened.read_all_cameras():
            camera.has_prior_focal_length = has_focal_length  # Then it looks for an essential matrix.
            opened.update_camera(camera)
    matching.write_matches(tmp_path / "ours.db", pairs, torch.device("cpu"), "matches", verification_options())
    shutil.copyfile(tmp_path / "ours.db", tmp_path / "colmap.db")
    with pycolmap.Database.open(tmp_path / "colmap.db") as opened:
        opened.clear_two_view_geometries()
    pycolmap.geometric_verification(tmp_path / "colmap.db", two_view_geometry_options=verification_options())
    ours = rows_of(tmp_path / "ours.db", "two_view_geometries")
    has_matches = {pair_id: rows > 0 for pair_id, rows, *_ in rows_of(tmp_path / "ours.db", "matches")}
    of_matched = [row for row in ours if has_matches[row[0]]]  # COLMAP writes nothing of pairs without any.
    assert of_matched == rows_of(tmp_path / "colmap.db", "two_view_geometries")
    actual = sum(rows > 0 for _, rows, *_ in ours)
    assert actual == 3
    assert len(ours) == len(pairs) == 10, "those that failed have a row, too"


def test_pairs_that_were_interrupted_end_as_if_they_were_not(matching: ModuleType, searched, tmp_path, monkeypatch):
    database, pairs = searched
    for name in ("whole.db", "parts.db"):
        shutil.copyfile(database, tmp_path / name)
    arguments = (pairs, torch.device("cpu"), "matches", verification_options())
    matching.write_matches(tmp_path / "whole.db", *arguments)
    monkeypatch.setattr(matching, "_SAVED_AT_ONCE", 3)
    matched = []
    match = matching.match_descriptors

    def interrupted(one, other):
        matched.append(1)
        if len(matched) == 8:
            raise KeyboardInterrupt
        return match(one, other)

    monkeypatch.setattr(matching, "match_descriptors", interrupted)
    with pytest.raises(KeyboardInterrupt):
        matching.write_matches(tmp_path / "parts.db", *arguments)
    saved = rows_of(tmp_path / "parts.db", "two_view_geometries")
    assert len(saved) == len(rows_of(tmp_path / "parts.db", "matches")) == 3
    matching.write_matches(tmp_path / "parts.db", *arguments)
    assert len(matched) == 8 + 7, "those that were saved are not matched again"
    matching.write_matches(tmp_path / "parts.db", *arguments)
    assert len(matched) == 8 + 7, "neither are pairs that failed"
    for table in ("matches", "two_view_geometries"):
        actual = rows_of(tmp_path / "parts.db", table)
        assert actual == rows_of(tmp_path / "whole.db", table)


def test_stored_matches_are_verified_again_without_geometries(matching: ModuleType, searched, tmp_path, monkeypatch):
    """As those of a run of an earlier version, or of another seed."""
    import pycolmap

    database, pairs = searched
    shutil.copyfile(database, tmp_path / "database.db")
    arguments = (pairs, torch.device("cpu"), "matches", verification_options())
    matching.write_matches(tmp_path / "database.db", *arguments)
    before = rows_of(tmp_path / "database.db", "two_view_geometries")
    with pycolmap.Database.open(tmp_path / "database.db") as opened:
        opened.clear_two_view_geometries()
    monkeypatch.setattr(matching, "match_descriptors", None)
    matching.write_matches(tmp_path / "database.db", *arguments)
    assert rows_of(tmp_path / "database.db", "two_view_geometries") == before
