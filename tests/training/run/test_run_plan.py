"""The plan of a run: decided once, written, kept in checkpoints, and never changed in its place."""

from __future__ import annotations

import ast
import copy
import dataclasses
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

import sadgs_ns
from examples.drawn_scene.scene import write_scene
from helpers.kill_and_resume import configure, set_up
from helpers.small_scenes import HEIGHT, ITERATIONS, VIEWS, WIDTH
from sadgs_ns.cli import export
from sadgs_ns.method import schedule
from sadgs_ns.method.strategy import StructureAwareStrategy
from sadgs_ns.render.types import RenderOptions
from sadgs_ns.training.config import SadgsTrainerConfig
from sadgs_ns.training.run.run_plan import Rate, RunPlan
from sadgs_ns.training.run.trainer import SadgsTrainer

OPTIONS = {field.name for field in dataclasses.fields(StructureAwareStrategy)}
RATES = {field.name for field in dataclasses.fields(Rate)}


def assigned(source: str) -> set[str]:
    """What a module assigns to options of a strategy or to rates, which Python does not forbid."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store) and node.attr in OPTIONS | RATES:
            found.add(ast.unparse(node))
        elif isinstance(node, ast.Subscript) and isinstance(node.ctx, ast.Store):
            found |= {ast.unparse(node)} if getattr(node.slice, "value", None) in RATES else set()
        elif isinstance(node, ast.Call) and ast.unparse(node.func) == "setattr":
            others = ("parser", "sys.modules[parent]")  # nerfstudio's parser of data, and a package
            found |= {ast.unparse(node)} if ast.unparse(node.args[0]) not in others else set()
    return found


def test_nothing_assigns_to_a_strategy_s_options_or_to_rates():
    for source in ("a.b.tau_split = 1", "s.eta_every, s.x = 1, 2", "o.lr *= 2", 'g["lr"] = 1', "setattr(s, n, 1)"):
        assert assigned(source), source
    assert not assigned("lr = replace(strategy, tau_split=1)")
    files = Path(sadgs_ns.__file__).parent.rglob("*.py")
    for path in files:
        assert not assigned(path.read_text("utf8")), path.name


@pytest.fixture
def config(tmp_path: Path) -> SadgsTrainerConfig:
    write_scene(tmp_path / "scene", WIDTH, HEIGHT, VIEWS, points=100)
    return configure(tmp_path / "scene", tmp_path, iterations=ITERATIONS, save_every=0)


def plan_of(trainer: SadgsTrainer) -> RunPlan:
    return trainer.pipeline.model.plan


def test_a_run_is_planned_once_and_its_options_stay_as_they_were_asked_for(
    config: SadgsTrainerConfig, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(schedule, "MORE_GROWTH_FROM", (1, 2))  # A scene of few views counts as one of many.
    config.pipeline.effort = 4.0
    asked = copy.deepcopy(config)
    trainer = set_up(config)
    plan = plan_of(trainer)
    model = trainer.pipeline.model
    began: Any = copy.deepcopy((plan, model.strategy))
    trainer.train()
    assert plan_of(trainer) is plan
    assert (plan, model.strategy) == began
    assert config.pipeline.model == asked.pipeline.model
    assert config.optimizers == asked.optimizers
    for changed in (plan, plan.rates["means"]):
        with pytest.raises(dataclasses.FrozenInstanceError):
            changed.iterations = changed.lr = 1  # type: ignore[misc]

    given = config.pipeline.model.strategy
    assert plan.strategy.clone_grad2d == pytest.approx(4**-0.32 * given.clone_grad2d)
    assert plan.iterations == ITERATIONS
    assert plan.devices == 1
    assert plan.images == "gpu"
    assert None not in vars(plan.strategy).values()
    assert plan.near_plane == model.drawing.near_plane
    assert plan.rates.keys() == trainer.optimizers.optimizers.keys()
    for name, optimizer in trainer.optimizers.optimizers.items():
        actual = optimizer.param_groups[0]["initial_lr" if plan.rates[name].max_steps else "lr"]
        assert actual == plan.rates[name].lr
        assert (plan.rates[name].max_steps == ITERATIONS) == (name in trainer.optimizers.schedulers)


def test_the_plan_is_written_beside_config_yml_and_kept_in_the_checkpoint(config: SadgsTrainerConfig):
    config.pipeline.model.max_off_axis = 2.5
    trainer = set_up(config)
    trainer.save_checkpoint(0)
    written = yaml.safe_load((trainer.base_dir / "plan.yml").read_text("utf8"))
    (file,) = trainer.checkpoint_dir.iterdir()
    kept = torch.load(file, weights_only=True)["pipeline"]["_extra_state"]["plan"]
    assert written == kept == dataclasses.asdict(plan_of(trainer))
    assert RunPlan.of(kept) == plan_of(trainer)
    _, drawing = export.read_checkpoint(file)
    assert drawing == RenderOptions(near_plane=plan_of(trainer).near_plane, max_off_axis=2.5)
    actual = [path.name for path in trainer.base_dir.iterdir() if ".partial" in path.name]
    assert actual == []


def test_whoever_loads_a_run_has_its_plan_and_a_resumed_run_makes_one_of_its_own(
    config: SadgsTrainerConfig, tmp_path: Path
):
    trainer = set_up(config)
    model = trainer.pipeline.model
    strategy = dataclasses.replace(model.plan.strategy, tau_split=0.25, max_gaussians=777)  # as the viewer does
    model.follow(dataclasses.replace(model.plan, strategy=strategy))
    trainer.save_checkpoint(0)
    (file,) = trainer.checkpoint_dir.iterdir()
    loaded = config.pipeline.setup(device="cpu", test_mode="test")
    state = torch.load(file, weights_only=True)
    loaded.load_pipeline(state["pipeline"], state["step"])
    assert loaded.model.plan == model.plan
    assert loaded.model.strategy == strategy.for_run(ITERATIONS)
    assert loaded.structure.set_max_gaussians.value == 777
    assert loaded.structure.set_tau_split.value == 0.25

    config.load_dir = trainer.checkpoint_dir
    config.output_dir = tmp_path / "resumed"
    resumed = plan_of(set_up(config)).strategy
    assert resumed.max_gaussians == 777, "what the run had in effect"
    assert resumed.tau_split == config.pipeline.model.strategy.tau_split, "what is asked for"
