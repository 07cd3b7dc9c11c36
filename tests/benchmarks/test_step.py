"""The benchmarks of a training step, as far as they run without CUDA: the step, its parts, its plan, two processes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from ranks import run_ranks

from benchmarks import __main__ as bench
from benchmarks import step as steps
from benchmarks.step import REPEATS, Step, milliseconds, plan, step_time
from sadgs_ns.distributed.world import World
from sadgs_ns.method.memory import StepSize, step_bytes
from sadgs_ns.render.rasterization import visible

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


def train_together(world: World) -> dict[str, Any]:
    step = Step(300, 48, 32, 3, CPU, world)
    before = step.params["means"].detach().clone()
    time, _ = step_time(step, 1)
    moved = not torch.equal(step.params["means"], before)
    sums = {name: float(step.state[name].sum()) for name in ("n_total", "absgrad2d", "grad_count")}
    return {"milliseconds": time, "moved": moved, **sums}


def test_processes_train_what_they_have(tmp_path: Path):
    results = run_ranks(train_together, 2, tmp_path)
    for result in results:
        assert result["moved"] and result["milliseconds"] > 0
        assert result["n_total"] > 0 and result["absgrad2d"] > 0 and result["grad_count"] > 0


def test_a_view_sees_one_block(monkeypatch: pytest.MonkeyPatch):
    seen = []
    monkeypatch.setattr(steps, "accumulate_gradients", lambda state, info, views: seen.append(visible(info)))
    Step(300, 48, 32, 4, CPU, None, blocks=2)()
    for view, gaussians in enumerate(seen[0]):
        blocks = gaussians.nonzero()[:, 0] % 2
        assert len(blocks) > 50 and bool((blocks == view % 2).all())


@pytest.mark.skipif(torch.cuda.is_available(), reason="here it would measure")
def test_one_process_prints_a_row_for_each_size(capsys: pytest.CaptureFixture[str]):
    sizes = ["--gaussians", "200", "--megapixels", "0.001", "0.002", "--views", "1", "--repeats", "1"]
    assert bench.main(["shards", *sizes]) == 0
    rows = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| 1 | 200 |")]
    assert [row.split(" | ")[2] for row in rows] == ["0.001", "0.002"]


def test_no_block_at_all_is_refused(capsys: pytest.CaptureFixture[str]):
    assert bench.main(["shards", "--blocks", "0"]) == 2
    assert "--blocks must be at least 1, got 0." in capsys.readouterr().err
