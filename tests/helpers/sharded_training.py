"""Short runs in several processes, and what is compared of them with a run of one process."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import torch
from nerfstudio.utils.rich_utils import CONSOLE

from helpers.kill_and_resume import configure
from sadgs_ns.distributed.world import World
from sadgs_ns.training.config import SadgsTrainerConfig
from sadgs_ns.training.run.trainer import SadgsTrainer

STRUCTURE_EVERY = 6


def few_steps(scene: Path, output: Path, views: int) -> SadgsTrainerConfig:
    """A run whose first half ends with a structure step; every step before that is observed by all statistics."""
    config = configure(scene, output, 2 * STRUCTURE_EVERY, save_every=0)
    config.pipeline.views_per_iteration = views
    # Gaussians start as spheres: their rotations have no gradient, and Adam would make steps of what rounding leaves.
    config.optimizers["quats"]["optimizer"].lr = 0.0
    config.pipeline.model.strategy = dataclasses.replace(
        config.pipeline.model.strategy,
        structure_every=STRUCTURE_EVERY, absgs_every=4, refine_start_iter=1, refine_stop_iter=STRUCTURE_EVERY,
        eta_every=1, min_observations=1, split_min_opacity=0.0, clone_grad2d=1e3, split_absgrad2d=1e3,
    )  # fmt: skip
    return config


def record(trainer: SadgsTrainer) -> dict[str, Any]:
    """Train, and note each step's loss, and the statistics before the structure step."""
    losses: list[float] = []
    statistics: dict[str, torch.Tensor] = {}
    model = trainer.pipeline.model

    def before(step: int) -> None:
        if step == STRUCTURE_EVERY - 1:
            state = {key: value for key, value in model.strategy_state.items() if isinstance(value, torch.Tensor)}
            statistics.update({key: value.clone() for key, value in state.items()})

    iterate = trainer.train_iteration

    def noted(step: int) -> Any:
        before(step)
        result = iterate(step)
        losses.append(float(result[0]))
        return result

    trainer.train_iteration = noted  # type: ignore[method-assign]
    trainer.train()
    steps = model.strategy_state["structure_steps"]
    return {"losses": losses, "statistics": statistics, "steps": steps, "gaussians": model.num_gaussians}


def set_up_together(world: World, config: SadgsTrainerConfig) -> SadgsTrainer:
    """The trainer of this process, which prints nothing."""
    CONSOLE.quiet = True
    trainer = config.setup(local_rank=world.rank, world_size=world.num_ranks)
    trainer.setup()
    return trainer


def record_together(world: World, config: SadgsTrainerConfig) -> dict[str, Any]:
    return record(set_up_together(world, config))
