"""The pictures of a structure step show what the method computes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.patches import Ellipse
from PIL import Image

from examples.drawn_scene import split


def test_both_pictures_are_written_and_small(tmp_path: Path):
    assert split.main([str(tmp_path / "new")]) == 0
    for name in ("split.png", "eta-step.png"):
        path = tmp_path / "new" / name
        with Image.open(path) as image:
            assert image.width > 1000 and np.asarray(image.convert("L")).std() > 10
        assert path.stat().st_size < 180_000


def test_the_children_of_the_picture_lie_in_a_grid_and_their_axes_shrink_as_often_as_there_are_cells():
    before, children, longer = split.draw_split().axes
    (parent,) = [patch for patch in before.patches if isinstance(patch, Ellipse)]
    assert parent.width == pytest.approx(2 * split.AXES[0]) and parent.height == pytest.approx(2 * split.AXES[1])
    for axes, scale in ((children, 1.0), (longer, split.CHILD_SCALE)):
        # The first is the parent, dotted.
        _, *shown = [patch for patch in axes.patches if isinstance(patch, Ellipse)]
        assert len(shown) == 3 * 2
        for child in shown:
            # The image of a Gaussian beside the axis is a little longer than its axes.
            assert child.width == pytest.approx(parent.width / 3 * scale, rel=0.01)
            assert child.height == pytest.approx(parent.height / 2 * scale, rel=0.01)


def test_eta_falls_by_a_step():
    *_, before, after = split.eta_panels()
    # Orange is over 1 and violet below: the colours of before are further from white.
    distances = [(255.0 - panel.picture.min(axis=-1)).mean() for panel in (before, after)]
    assert distances[0] > 2 * distances[1]


def test_a_folder_that_cannot_be_written_is_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "file").write_text("")
    assert split.main([str(tmp_path / "file" / "new")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
