"""Gaussians that a training step leaves out at random."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from torch import Tensor
from torch.testing import assert_close

from helpers.kill_and_resume import set_up
from helpers.refusals import refusal
from helpers.short_runs import configure, train
from sadgs_ns.render.types import Gaussians
from sadgs_ns.training.run.trainer import SadgsTrainer
from sadgs_ns.training.step.dropout import MOST_OPACITY, Dropout

NUMBER = 20_000


def gaussians(opacities: Tensor) -> Gaussians:
    """Gaussians of some opacities [N], alike in all else."""
    number = len(opacities)
    return Gaussians(
        torch.zeros(number, 3), torch.ones(number, 4), torch.ones(number, 3), opacities, torch.zeros(number, 3)
    )


def left_out(dropout: Dropout, step: int) -> Tensor:
    """Which Gaussians a step leaves out. bool [N]"""
    dropout.begin(step)
    return dropout.apply(gaussians(torch.full((NUMBER,), 0.5))).opacities == 0


@pytest.mark.parametrize("rate", [0.05, 0.25])
def test_some_are_left_out_and_the_others_make_up_for_it(rate: float):
    dropout = Dropout(rate, seed=3, device=torch.device("cpu"))
    opacities = torch.linspace(0.01, 0.7, NUMBER)
    dropout.begin(0)
    kept = dropout.apply(gaussians(opacities)).opacities
    is_out = kept == 0
    deviation = (rate * (1 - rate) / NUMBER) ** 0.5
    assert abs(float(is_out.float().mean()) - rate) < 4 * deviation
    expected = opacities[~is_out] / (1 - rate)
    assert_close(kept[~is_out], expected)
    expected = pytest.approx(float(opacities.mean()), rel=0.02)
    assert float(kept.mean()) == expected


def test_no_gaussian_becomes_more_than_opaque_and_gradients_reach_those_that_stay():
    dropout = Dropout(0.5, seed=3, device=torch.device("cpu"))
    opacities = torch.tensor([0.3, 0.4] * 50 + [0.9] * 100, requires_grad=True)
    dropout.begin(7)
    kept = dropout.apply(gaussians(opacities)).opacities
    assert float(kept.detach().max()) == pytest.approx(MOST_OPACITY)
    kept.sum().backward()
    assert opacities.grad is not None
    stays = kept.detach() > 0
    assert torch.equal(opacities.grad[:100], 2.0 * stays[:100])


def test_the_step_and_the_seed_alone_decide_who_is_left_out():
    device = torch.device("cpu")
    first = left_out(Dropout(0.1, seed=1, device=device), 5)
    resumed = Dropout(0.1, seed=1, device=device)
    left_out(resumed, 4)
    assert torch.equal(first, left_out(resumed, 5))
    for other in (left_out(resumed, 6), left_out(Dropout(0.1, seed=2, device=device), 5)):
        both = float((first & other).float().mean())
        assert both == pytest.approx(0.01, abs=0.004), "steps and seeds have nothing to do with each other"


def test_a_run_leaves_out_as_its_plan_says_and_pictures_show_all(colmap: ColmapDataParserConfig, tmp_path: Path):
    config = configure(tmp_path / "few", colmap, iterations=4)
    model = set_up(config).pipeline.model
    assert model.plan.dropout == 0, "few visits overfit nothing"
    assert model.dropout is None, "few visits overfit nothing"
    config = configure(tmp_path / "many", colmap, iterations=2000)
    model = set_up(config).pipeline.model
    assert model.plan.dropout == pytest.approx(0.156, abs=1e-3), "250 visits to each of 8 views"
    config.pipeline.model.dropout = 0.2
    trained = set_up(config).pipeline.model
    assert trained.plan.dropout == 0.2
    assert trained.dropout is not None
    drawn, _ = trained.gaussians()
    assert float(drawn.opacities.min()) > 0, "evaluation and viewer draw all"


def test_a_resumed_run_ends_bitwise_equal_to_one_that_nothing_disturbed(colmap: ColmapDataParserConfig, tmp_path: Path):
    saved = tmp_path / "saved"

    def save(trainer: SadgsTrainer) -> None:
        if trainer.step == 4:
            trainer.save_checkpoint(4)
            shutil.copytree(trainer.checkpoint_dir, saved)

    config = configure(tmp_path / "whole", colmap, iterations=10)
    config.machine.device_type = "cpu"
    config.pipeline.model.dropout = 0.3
    expected = train(config, after_step=save).pipeline.model.gauss_params
    config.output_dir = tmp_path / "resumed"
    config.load_dir = saved
    resumed = train(config).pipeline.model.gauss_params
    for name, value in resumed.items():
        assert torch.equal(value, expected[name]), name


def test_a_resumed_run_keeps_its_dropout_and_thresholds_whatever_the_rules_say(
    colmap: ColmapDataParserConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    trainer = set_up(configure(tmp_path / "first", colmap, iterations=8))
    plan = trainer.pipeline.model.plan
    strategy = replace(plan.strategy, clone_grad2d=3.0e-4, split_absgrad2d=6.0e-4)
    trainer.pipeline.model.plan = replace(plan, dropout=0.07, strategy=strategy)
    trainer.save_checkpoint(3)
    config = configure(tmp_path / "second", colmap, iterations=8)
    config.load_dir = trainer.checkpoint_dir
    resumed = set_up(config).pipeline.model.plan
    assert resumed.dropout == 0.07
    assert resumed.strategy.clone_grad2d == 3.0e-4
    assert resumed.strategy.split_absgrad2d == 6.0e-4
    config.pipeline.model.dropout = 0.0
    assert set_up(config).pipeline.model.plan.dropout == 0


def test_a_rate_out_of_range_is_named(colmap: ColmapDataParserConfig, tmp_path: Path):
    config = configure(tmp_path, colmap)
    config.pipeline.model.dropout = 1.0
    with refusal(r"pipeline\.model\.dropout"):
        set_up(config)
