"""nerfstudio glue: a trainer whose schedules follow the run's length and whose checkpoints resume."""

from __future__ import annotations

import copy
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from nerfstudio.configs.base_config import MachineConfig
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.engine.trainer import Trainer, TrainerConfig

from sadgs_ns.optimizers import FusedAdamOptimizerConfig, RunLengthDecaySchedulerConfig
from sadgs_ns.pipeline import SadgsPipeline, SadgsPipelineConfig


def available_machine() -> MachineConfig:
    """CUDA where there is a device, the CPU elsewhere."""
    return MachineConfig(device_type="cuda" if torch.cuda.is_available() else "cpu")


@dataclass
class SadgsTrainerConfig(TrainerConfig):
    """nerfstudio's trainer with this method's defaults."""

    _target: type = field(default_factory=lambda: SadgsTrainer)
    machine: MachineConfig = field(default_factory=available_machine)
    """Machine; the device is CUDA where there is one."""
    pipeline: SadgsPipelineConfig = field(default_factory=SadgsPipelineConfig)
    """Data and model."""
    max_num_iterations: int = 3000
    """Length of the run in optimizer steps; schedules stretch to it."""
    steps_per_eval_batch: int = 0
    """Steps between losses on a held-out view; 0 is never."""
    steps_per_eval_image: int = 500
    """Steps between metrics of one held-out view, where a logger such as tensorboard is on."""
    steps_per_eval_all_images: int = 0
    """Steps between metrics of all held-out views; 0 is never. `ns-eval` measures them after training."""
    scale_position_lr: bool = True
    """Multiply the position learning rate with the cameras' extent, as 3DGS does; splatfacto does not."""


class SadgsTrainer(Trainer):
    """Trains one model on one device.

    Raises:
        ValueError: If several devices are asked for.
    """

    config: SadgsTrainerConfig
    pipeline: SadgsPipeline

    def __init__(self, config: SadgsTrainerConfig, local_rank: int = 0, world_size: int = 1) -> None:
        if world_size > 1:
            raise ValueError(f"sadgs trains on one device; set machine.num_devices to 1, not {world_size}.")
        super().__init__(config, local_rank, world_size)

    def setup_optimizers(self) -> Optimizers:
        """Build the optimizers with schedules as long as the run, fused where the model is."""
        optimizers: dict[str, Any] = copy.deepcopy(dict(self.config.optimizers))
        for group in optimizers.values():
            scheduler, optimizer = group["scheduler"], group["optimizer"]
            if isinstance(optimizer, FusedAdamOptimizerConfig):
                optimizer.fused &= self.config.pipeline.model.fused
            if isinstance(scheduler, RunLengthDecaySchedulerConfig) and scheduler.max_steps is None:
                scheduler.max_steps = self.config.max_num_iterations
        if self.config.scale_position_lr:
            optimizers["means"]["optimizer"].lr *= self.pipeline.model.strategy_state["scene_scale"]
        return Optimizers(optimizers, self.pipeline.get_param_groups())

    def train(self) -> None:
        """Train up to `max_num_iterations` in all; nerfstudio 1.1.5 trains that many more after resuming."""
        total = self.config.max_num_iterations
        self.step = max(self._start_step - 1, 0)  # names the checkpoint when nothing is left to do
        self.config.max_num_iterations = max(total - self._start_step, 0)
        try:
            super().train()
        finally:
            self.config.max_num_iterations = total

    def save_checkpoint(self, step: int) -> None:
        """Save under a temporary name, then rename: a killed save leaves the previous checkpoint as it was.

        The temporary file lies beside the folder of checkpoints: nerfstudio takes every file inside for one.
        """
        self.checkpoint_dir.mkdir(parents=True, exist_ok=True)
        path: Path = self.checkpoint_dir / f"step-{step:09d}.ckpt"
        partial = self.checkpoint_dir.with_name(f"{self.checkpoint_dir.name}.partial")
        try:
            torch.save(
                {
                    "step": step,
                    "pipeline": self.pipeline.state_dict(),
                    "optimizers": {name: o.state_dict() for name, o in self.optimizers.optimizers.items()},
                    "schedulers": {name: s.state_dict() for name, s in self.optimizers.schedulers.items()},
                    "scalers": self.grad_scaler.state_dict(),
                },
                partial,
            )
            os.replace(partial, path)
        finally:
            partial.unlink(missing_ok=True)
        if self.config.save_only_latest_checkpoint:
            for other in self.checkpoint_dir.glob("*.ckpt"):
                if other != path:
                    other.unlink()
