"""The benchmarks of a training step, as far as they run without CUDA: the step, its parts, its plan."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from benchmarks import __main__ as bench
from benchmarks import step as steps
from benchmarks.step import REPEATS, Step, milliseconds, plan
from sadgs_ns.method.memory import StepSize, step_bytes

CPU = torch.device("cpu")


def test_a_time_is_the_median_of_rounds_after_the_first(monkeypatch: pytest.MonkeyPatch):
    clock = iter([0.0, 9.0, 10.0, 10.2, 20.0, 20.4, 30.0, 30.6])
    monkeypatch.setattr("time.perf_counter", lambda: next(clock))
    calls: list[int] = []
    assert milliseconds(lambda: calls.append(1), 3) == pytest.approx(400 / REPEATS)
    assert len(calls) == 4 * REPEATS


@pytest.mark.skipif(torch.cuda.is_available(), reason="here it would measure")
@pytest.mark.parametrize("command", ["step", "memory"])
def test_without_a_gpu_one_sentence_says_what_it_needs(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.chdir(tmp_path)
    assert bench.main([command]) == 2
    told = f"python -m benchmarks {command}: this needs a CUDA device, and torch finds none.\n"
    assert capsys.readouterr() == ("", told) and not list(tmp_path.iterdir())


def test_a_step_goes_through_the_phases_of_the_plan_and_has_their_size():
    step = Step(200, 40, 30, 2, CPU)
    before = step.params["means"].detach().clone()
    phases: list[str] = []
    step(phases.append)
    assert phases == list(step_bytes(0, StepSize(), CPU))
    size = StepSize.of([step.info])
    assert (size.views, size.pixels) == (2, 2 * 40 * 30) and size.pairs > 400
    assert not torch.equal(step.params["means"], before)
    assert step.state["n_total"].sum() > 0 and step.state["absgrad2d"].sum() > 0
    kept = 200 * (4 * 4 * 59 + 4 * 13) + 2 * 2 * 3 * 40 * 30
    assert plan(step) == {name: kept + value for name, value in step_bytes(200, size, CPU).items()}


def test_the_parts_of_a_step_can_be_called_alone():
    with steps.kernels.triton_switched(False):
        step = Step(200, 40, 30, 1, CPU)
    for part in (step, step.render, step.compare, step.observe, step.optimize):
        part()
    assert step.params["means"].grad is not None and step.rendered.grad is not None


@pytest.mark.skipif(not torch.cuda.is_available(), reason="peaks are measured on CUDA")
def test_the_plan_is_near_the_peaks(capsys: pytest.CaptureFixture[str]):
    assert bench.main(["memory", "--gaussians", "300000", "--megapixels", "2", "--views", "1", "4"]) == 0
    ratios = [float(line.split("|")[-2]) for line in capsys.readouterr().out.splitlines() if line.startswith("| 300,")]
    assert len(ratios) == 2 and all(0.9 < ratio < 1.5 for ratio in ratios)
