"""How a step grows is measured at every number and size that was asked for, and drawn as far as memory reached."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks import growth, plots


def time_step(gaussians: int, megapixels: float, fused: bool) -> float | None:
    if gaussians > 1_000_000 and not fused:
        return None
    return (1 if fused else 2) * (1 + gaussians / 1e6 + megapixels)


def test_all_numbers_go_with_the_first_size_and_all_sizes_with_the_first_number(tmp_path: Path):
    rows = growth.measure([1_000_000, 100_000, 4_000_000], [2.0, 8.0], time_step)
    assert rows == [
        (1_000_000, 2.0, 4.0, 8.0),
        (100_000, 2.0, 3.1, 6.2),
        (4_000_000, 2.0, 7.0, None),
        (1_000_000, 8.0, 10.0, 20.0),
    ]
    figure = plots.growth(rows)
    lines = [[np.asarray(line.get_xydata()).tolist() for line in axes.lines] for axes in figure.axes]
    assert lines[0] == [[[1e5, 3.1], [1e6, 4.0], [4e6, 7.0]], [[1e5, 6.2], [1e6, 8.0]]]
    assert lines[1] == [[[2e6, 4.0], [8e6, 10.0]], [[2e6, 8.0], [8e6, 20.0]]]
    plots.save(figure, tmp_path / "growth")
    assert {path.name for path in tmp_path.iterdir()} == {"growth.png", "growth.svg"}


@pytest.mark.skipif(torch.cuda.is_available(), reason="here it would measure")
def test_without_a_gpu_one_sentence_says_what_it_needs(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert growth.main(["--output", str(tmp_path / "new")]) == 1
    assert "needs a CUDA device" in capsys.readouterr().err and not (tmp_path / "new").exists()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="a step is timed on CUDA")
def test_a_step_is_timed_with_and_without_our_kernels():
    assert all(0 < (growth.whole_step(2_000, 0.02, fused) or 0) < 1_000 for fused in (True, False))
