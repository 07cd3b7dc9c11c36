"""Tracks of COLMAP's models, binary and text, tell which image sees which point."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from examples.drawn_scene.scene import describe_scene
from helpers.refusals import refusal
from helpers.small_scenes import HEIGHT, POINTS, VIEWS, WIDTH
from sadgs_ns.data import colmap
from sadgs_ns.data.tracks import points_seen


def text_model(model: Path, folder: Path) -> Path:
    """Write a binary model as text, and return its file of points."""
    from nerfstudio.data.utils import colmap_parsing_utils

    folder.mkdir()
    read: Any = colmap_parsing_utils.read_model(str(model))
    cameras, images, points = read
    colmap_parsing_utils.write_model(cameras, images, points, str(folder), ext=".txt")
    return folder / "points3D.txt"


@pytest.mark.parametrize("kind", ["bin", "txt"])
def test_each_image_sees_the_points_of_its_tracks(scene: Path, tmp_path: Path, kind: str):
    source = scene / "sparse/0/points3D.bin"
    if kind == "txt":
        source = text_model(source.parent, tmp_path / "text")
    description = describe_scene(WIDTH, HEIGHT, VIEWS, POINTS, 0)
    positions, _ = colmap.read_points(source)
    assert_allclose(positions, description.points)
    files = [tmp_path / "images_2" / view.name for view in reversed(description.views)]
    seen = points_seen(source, [*files, tmp_path / "other.png"])
    assert seen is not None
    for index, points in enumerate(reversed(seen[:-1])):
        assert points.tolist() == np.flatnonzero(description.tracks[:, index]).tolist()
    assert len(seen[-1]) == 0


def test_a_model_without_tracks_tells_nothing(scene: Path, tmp_path: Path):
    assert points_seen(tmp_path / "points3D.ply", [tmp_path / "a.png"]) is None


def test_damaged_tracks_are_named(scene: Path, tmp_path: Path):
    damaged = tmp_path / "points3D.bin"
    damaged.write_bytes((scene / "sparse/0/points3D.bin").read_bytes()[:-4])
    with refusal(r"points3D\.bin is cut off or corrupt"):
        points_seen(damaged, [])
