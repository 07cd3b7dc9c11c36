"""Known gains of exposure are found again."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks import __main__ as bench
from benchmarks.known_gains import errors, find_gains, known_gains, read_scene
from examples.drawn_scene.scene import write_scene
from helpers.small_scenes import HEIGHT, POINTS, WIDTH

VIEWS = 24


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The drawn room with enough photos for one to be held out in each part of it; to be read only."""
    folder = tmp_path_factory.mktemp("gains") / "room"
    write_scene(folder, WIDTH, HEIGHT, VIEWS, POINTS)
    return folder


def test_known_gains_are_found_in_fitted_and_held_out_photos(drawn: Path):
    dataset, points = read_scene(drawn)
    before = find_gains(dataset, points, np.zeros(len(dataset)))
    assert before.known.all()
    assert before.fitted.deviation < 0.1
    for stops in known_gains(len(dataset)).values():
        after = find_gains(dataset, points, stops)
        fitted, held_out = errors(before, after, stops)
        assert fitted < 0.06
        assert held_out < 0.06


def test_the_command_prints_a_line_for_each_scene(drawn: Path, capsys: pytest.CaptureFixture[str]):
    assert bench.main(["gains", str(drawn)]) == 0
    *_, line = capsys.readouterr().out.strip().splitlines()
    assert line.startswith("| room | ")


def test_a_folder_without_a_scene_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert bench.main(["gains", str(tmp_path)]) == 2
    assert f"{tmp_path} holds neither transforms.json nor" in capsys.readouterr().err
