"""Whole runs with tile lists of a length that is foreseen: as with exact lists, and repeated where they are too short.

Triton's interpreter runs the kernels that project and make the lists. The splatter's compositing, which reads the lists
as gsplat's kernel does, stands in for the compositing.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import pytest
import torch
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from torch import Tensor

from helpers.interpreted_rasterizer import use_our_rasterizer
from helpers.kill_and_resume import set_up
from helpers.short_runs import TRAIN_VIEWS, configure
from sadgs_ns.render.tile_forecast import TileForecast
from sadgs_ns.training.config import SadgsTrainerConfig
from sadgs_ns.training.model import SadgsModel

pytestmark = pytest.mark.skipif(torch.cuda.is_available(), reason="on the CPU Triton is interpreted")

ITERATIONS = 14


@pytest.fixture
def our_rasterizer(monkeypatch: pytest.MonkeyPatch) -> None:
    use_our_rasterizer(monkeypatch)


@pytest.fixture
def short(colmap: ColmapDataParserConfig, tmp_path: Path) -> SadgsTrainerConfig:
    """A run of a few steps of two views, with densification, η and AbsGS."""
    config = configure(tmp_path, colmap, ITERATIONS, structure_every=8, absgs_every=5, refine_stop_iter=8)
    config.pipeline.views_per_iteration = 2
    config.machine.device_type = "cpu"
    return config


class Observed(TileForecast):
    """A forecast that keeps what it foresaw, and foresees far too little at the steps that it is told."""

    def __init__(self, too_short: Sequence[int] = ()) -> None:
        super().__init__()
        self.too_short = too_short
        self.capacities: list[int | None] = []
        self.views: list[list[int]] = []
        self.lost: list[int] = []

    def capacity(self, views: Sequence[int], size: tuple[int, int], num_gaussians: int) -> int | None:
        foreseen = super().capacity(views, size, num_gaussians)
        self.capacities.append(7 if len(self.capacities) in self.too_short else foreseen)
        self.views.append(list(views))
        return self.capacities[-1]

    def overflowed(self, *, wait: bool = False) -> list[int]:
        lost = super().overflowed(wait=wait)
        self.lost += lost
        return lost


def train(
    config: SadgsTrainerConfig, forecast: TileForecast | None, after_step: Callable[[SadgsModel, int], None]
) -> None:
    """Train to the end with a forecast, or waiting, and call `after_step` with the model and the step after each."""
    trainer = set_up(config)
    model = trainer.pipeline.model
    model.tile_forecast = forecast
    location = [TrainingCallbackLocation.AFTER_TRAIN_ITERATION]
    trainer.callbacks.append(TrainingCallback(location, lambda step: after_step(model, step)))
    trainer.train()


def state_of(model: SadgsModel) -> dict[str, Tensor]:
    """Copies of the parameters, of their moments and of the statistics."""
    values: dict[str, Any] = {**model.gauss_params, **model.strategy_state}
    for name, optimizer in model.optimizers.items():
        for state in optimizer.state.values():
            values |= {f"{name}.{key}": state[key] for key in ("exp_avg", "exp_avg_sq")}
    return {name: value.detach().clone() for name, value in values.items() if isinstance(value, Tensor)}


def test_a_run_that_foresees_equals_one_that_waits_bit_for_bit(our_rasterizer: None, short: SadgsTrainerConfig):
    short.max_num_iterations = 11
    forecast = Observed()
    states = []
    for way in (None, forecast):
        states.append([])
        train(short, way, lambda model, step: states[-1].append(state_of(model)))
    assert len(forecast.capacities) == 11
    assert sum(map(bool, forecast.capacities)) > 11 / 3
    assert not forecast.lost
    for expected, foreseen in zip(*states, strict=True):
        assert expected.keys() == foreseen.keys()
        for name, value in expected.items():
            assert torch.equal(foreseen[name], value)


def test_steps_whose_lists_are_too_short_change_and_count_nothing_and_their_views_come_again(
    our_rasterizer: None,
    short: SadgsTrainerConfig,
    monkeypatch: pytest.MonkeyPatch,
):
    """Parameters, moments and statistics stay as they are. Densification follows the steps 4 and 7."""
    monkeypatch.setattr("sadgs_ns.training.step.optimizers.use_triton", lambda place: True)
    too_short = (2, 6, 9)
    forecast = Observed(too_short)
    states = []

    def look(model: SadgsModel, step: int) -> None:
        states.append(state_of(model))
        if step in (2, 6):
            assert states[step]["n_total"].sum() > 0
            assert step > 4 or states[step]["grad_count"].sum() > 0
        same = [torch.equal(value, states[step - 1][name]) for name, value in states[step].items() if step > 0]
        assert all(same) if step in too_short else not all(same) or step == 0

    train(short, forecast, look)
    assert all(forecast.views[step + 1] == forecast.views[step] for step in too_short)
    assert forecast.lost == [view for step in too_short for view in forecast.views[step]]
    visits = Counter(index for step, views in enumerate(forecast.views) if step not in too_short for index in views)
    assert max(visits.values()) - min(visits.values()) <= 1
    assert len(visits) == TRAIN_VIEWS


def test_a_checkpoint_after_an_overflow_has_the_views_that_must_be_drawn_again(
    our_rasterizer: None, short: SadgsTrainerConfig
):
    short.max_num_iterations = 5
    forecast = Observed([3])
    orders = []
    trainer = set_up(short)
    trainer.pipeline.model.tile_forecast = forecast
    location = [TrainingCallbackLocation.AFTER_TRAIN_ITERATION]
    keep = lambda step: orders.append(trainer.pipeline.get_extra_state()["views"]["order"])  # noqa: E731
    trainer.callbacks.append(TrainingCallback(location, keep))
    trainer.train()
    assert orders[3][:2] == forecast.views[3]
    assert forecast.views[4] == forecast.views[3]
