"""Steps that are replayed as graphs train as steps whose kernels are launched one by one."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from interpreted import use_our_rasterizer
from kill_and_resume import set_up
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from runs import TRAIN_VIEWS, configure
from torch import Tensor

from sadgs_ns.plugin import graphed_steps, optimizers
from sadgs_ns.plugin.graphed_steps import GraphedSteps, Results
from sadgs_ns.plugin.trainer import SadgsTrainer, SadgsTrainerConfig

ITERATIONS = 30
on_cpu = pytest.mark.skipif(torch.cuda.is_available(), reason="on the CPU Triton is interpreted")


class Rerun:
    """A graph that calls what was captured again, and puts its results where those of the first replay are."""

    def __init__(self, function: Callable[[], Results]) -> None:
        self.function = function
        self.results: Results | None = None

    def replay(self) -> Results:
        now = self.function()
        if self.results is None:
            self.results = now
        for tensor, value in zip(self.results, now, strict=True):
            tensor.copy_(value)
        return self.results


class Reruns:
    """In the place of `CudaGraphs`."""

    def __init__(self, device: torch.device) -> None:
        self.captured: list[Rerun] = []

    def capture(self, function: Callable[[], Results]) -> Rerun:
        self.captured.append(Rerun(function))
        return self.captured[-1]

    def wait(self) -> None:
        """Nothing runs beside the host."""


@pytest.fixture
def without_cuda(monkeypatch: pytest.MonkeyPatch) -> None:
    """Our rasterizer and Adam in Triton's interpreter, and graphs that are called again."""
    use_our_rasterizer(monkeypatch)
    working = SimpleNamespace(available=lambda device: True)
    monkeypatch.setattr(optimizers, "kernels", working)
    monkeypatch.setattr(graphed_steps, "kernels", working)
    monkeypatch.setattr(graphed_steps, "CudaGraphs", Reruns)


@pytest.fixture
def short(colmap: ColmapDataParserConfig, tmp_path: Path) -> SadgsTrainerConfig:
    """A run with an AbsGS step, a reset, a structure step, and steps after all of them."""
    schedule = {"absgs_every": 8, "structure_every": 20, "reset_every": 12, "refine_stop_iter": 20, "eta_every": 5}
    config = configure(tmp_path, colmap, ITERATIONS, **schedule)
    config.machine.device_type = "cpu"
    config.pipeline.views_per_iteration = 1
    return config


def run(config: SadgsTrainerConfig, graphed: bool) -> tuple[SadgsTrainer, list[Any]]:
    """Train to the end; also return the loss, PSNR, views and rates of each step, as they are after the whole run."""
    config = copy.deepcopy(config)
    config.graphed_steps = graphed
    trainer, trace = set_up(config), []
    iterate, begin = trainer.train_iteration, trainer.pipeline.log.begin_step

    def noted(step: int) -> Any:
        result = iterate(step)
        rates = [scheduler.get_last_lr() for scheduler in trainer.optimizers.schedulers.values()]
        trace.append((result[0].detach(), result[2]["psnr"], result[2]["gaussian_count"], rates))
        return result

    def begun(step: int, views: list[int], loss: Tensor) -> None:
        trace.append((step, views))
        begin(step, views, loss)

    trainer.train_iteration, trainer.pipeline.log.begin_step = noted, begun  # type: ignore[method-assign]
    trainer.train()
    return trainer, trace


def tensors(trainer: SadgsTrainer) -> dict[str, Tensor]:
    """Copies of parameters, moments, statistics, the mean of the parameters, and the log of gradients."""
    model = trainer.pipeline.model
    values: dict[str, Any] = {**model.gauss_params, **model.strategy_state, **model.average.means}
    for name, optimizer in trainer.optimizers.optimizers.items():
        for state in optimizer.state.values():
            values |= {f"{name}.{key}": value for key, value in state.items()}
    values["log"] = trainer.pipeline.log._gradients
    return {name: value.detach().clone() for name, value in values.items() if isinstance(value, Tensor)}


def assert_equal(one: dict[str, Tensor], other: dict[str, Tensor]) -> None:
    assert one.keys() == other.keys()
    assert not [name for name, value in one.items() if not torch.equal(value, other[name])]


@on_cpu
@pytest.mark.parametrize("views", [1, 2])
def test_a_run_of_graphs_equals_one_of_launches_bit_for_bit(without_cuda: None, short: SadgsTrainerConfig, views: int):
    short.pipeline.views_per_iteration = views
    (launched, expected), (replayed, found) = run(short, False), run(short, True)
    assert launched.graphed is None and replayed.graphed is not None and not replayed.graphed.failure
    assert replayed.graphed.replayed > ITERATIONS / 3
    assert expected == found
    assert_equal(tensors(launched), tensors(replayed))
    assert len({count for *_, count, _ in expected[1::2]}) > 2
