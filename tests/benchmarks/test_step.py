"""The benchmarks of a training step, as far as they run without CUDA: the step, its parts, its plan."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from benchmarks import __main__ as bench
from benchmarks import step as steps
from benchmarks.step import REPEATS, Step, milliseconds
from helpers import gsplat_stub
from sadgs_ns.render.step_memory import StepSize, kept_bytes, step_bytes

CPU = torch.device("cpu")


def test_a_time_is_the_median_of_rounds_after_the_first(monkeypatch: pytest.MonkeyPatch):
    clock = iter([0.0, 9.0, 10.0, 10.2, 20.0, 20.4, 30.0, 30.6])
    monkeypatch.setattr("time.perf_counter", lambda: next(clock))
    calls: list[int] = []
    actual = milliseconds(lambda: calls.append(1), 3)
    assert actual == pytest.approx(400 / REPEATS)
    assert len(calls) == 4 * REPEATS


@pytest.mark.skipif(torch.cuda.is_available(), reason="here it would measure")
def test_without_a_gpu_one_sentence_says_what_it_needs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.chdir(tmp_path)
    status = bench.main(["step"])
    assert status == 2
    told = "python -m benchmarks step: this needs a CUDA device, and torch finds none.\n"
    assert capsys.readouterr() == ("", told)
    assert not list(tmp_path.iterdir())


def plan(step: Step) -> dict[str, float]:
    """Bytes of all that a step has at its peak in each phase, as the memory plan counts them."""
    n = len(step.params["means"])
    size = StepSize.of([step.info])
    kept = kept_bytes(step.params, step.state) * n + step.images.numel() + step.structure_tensors.numel()  # type: ignore[arg-type]
    return {name: kept + value for name, value in step_bytes(n, size, step.images.device).items()}


def test_a_step_goes_through_the_phases_of_the_plan_and_has_their_size():
    step = Step(200, 40, 30, 2, CPU)
    before = step.params["means"].detach().clone()
    phases: list[str] = []
    step(phases.append)
    assert phases == list(step_bytes(0, StepSize(), CPU))
    size = StepSize.of([step.info])
    assert size.views == 2
    assert size.pixels == 2 * 40 * 30
    assert size.pairs > 400
    assert not torch.equal(step.params["means"], before)
    assert step.state["n_total"].sum() > 0
    assert step.state["absgrad2d"].sum() > 0
    kept = 200 * (4 * 4 * 59 + 4 * 13) + 2 * 2 * 3 * 40 * 30
    expected = {name: kept + value for name, value in step_bytes(200, size, CPU).items()}
    assert plan(step) == expected


def test_the_parts_of_a_step_can_be_called_alone():
    with steps.kernels.triton_switched(False):
        step = Step(200, 40, 30, 1, CPU)
    for part in (step, step.render, step.compare, step.observe, step.optimize):
        part()
    assert step.params["means"].grad is not None
    assert step.rendered.grad is not None


def test_the_forward_projection_can_be_called_alone(monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("triton", reason="Triton is not installed")
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")  # Where there is a GPU, Triton needs it.
    monkeypatch.setattr(steps.gsplat_compat, "project", gsplat_stub.project)
    drawn = []
    for triton in (False, True):
        step = Step(200, 40, 30, 1, device)
        with steps.kernels.triton_switched(triton):
            radii, means2d, _, _ = step.project()
        drawn.append(steps.gsplat_compat.drawn(radii, means2d))
    assert drawn[0].any()
    assert (drawn[0] != drawn[1]).sum() <= 1


@pytest.mark.skipif(not torch.cuda.is_available(), reason="peaks are measured on CUDA")
@pytest.mark.parametrize("views", [1, 4])
def test_the_plan_is_near_the_peaks(views: int):
    step = Step(300_000, 1732, 1155, views)
    peaks = []

    def note(phase: str) -> None:
        peaks.append(torch.cuda.max_memory_allocated())
        torch.cuda.reset_peak_memory_stats()

    for _ in range(2):  # Kernels are compiled, and Adam's moments are made.
        step()
    step.count = 0  # The step that is measured observes η.
    torch.cuda.synchronize()
    torch.cuda.reset_peak_memory_stats()
    step(note)
    assert 0.9 < max(plan(step).values()) / max(peaks) < 1.5
