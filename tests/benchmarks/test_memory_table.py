"""`python -m benchmarks memory` as far as it runs without CUDA: its step, and the plan of it."""

from __future__ import annotations

import pytest
import torch

from benchmarks import memory as bench
from sadgs_ns.method.memory import StepSize, step_bytes


def test_its_step_goes_through_the_phases_of_the_plan_and_has_their_size():
    training = bench.Training(200, 40, 30, 2, torch.device("cpu"))
    before = training.params["means"].detach().clone()
    phases: list[str] = []
    training.step(phases.append)
    assert phases == list(step_bytes(0, StepSize()))
    assert (training.size.views, training.size.pixels) == (2, 2 * 40 * 30) and training.size.pairs > 400
    assert not torch.equal(training.params["means"], before)
    assert training.state["n_total"].sum() > 0 and training.state["absgrad2d"].sum() > 0
    kept = 200 * (4 * 4 * 59 + 4 * 13) + 2 * 2 * 3 * 40 * 30
    assert bench.plan(training) == {name: kept + value for name, value in step_bytes(200, training.size).items()}


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a CUDA device")
def test_without_cuda_it_says_so(capsys: pytest.CaptureFixture[str]):
    assert bench.main([]) == 1
    assert capsys.readouterr().out == "This comparison needs a CUDA device, and torch finds none.\n"


@pytest.mark.skipif(not torch.cuda.is_available(), reason="peaks are measured on CUDA")
def test_the_plan_is_near_the_peaks(capsys: pytest.CaptureFixture[str]):
    assert bench.main(["--gaussians", "300000", "--megapixels", "2", "--views", "1", "4"]) == 0
    ratios = [float(line.split("|")[-2]) for line in capsys.readouterr().out.splitlines() if line.startswith("| 300,")]
    assert len(ratios) == 2 and all(0.9 < ratio < 1.5 for ratio in ratios)
