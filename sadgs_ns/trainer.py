"""nerfstudio glue: a trainer whose schedules follow the run's length and whose checkpoints resume."""

from __future__ import annotations

import copy
import os
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from nerfstudio.configs.base_config import MachineConfig, ViewerConfig
from nerfstudio.engine.optimizers import Optimizers
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.utils.rich_utils import CONSOLE

from sadgs_ns import checkpoints
from sadgs_ns.interrupts import Interrupted, Interrupts, resume_command
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
    viewer: ViewerConfig = field(default_factory=lambda: ViewerConfig(websocket_host="127.0.0.1"))
    """The viewer. It listens on this machine only; a websocket_host of 0.0.0.0 opens it to the network."""
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
        self._stepping = False
        self._completed_step = self._saved_step = -1
        # Paused or done, nerfstudio waits for the viewer's user.
        self._interrupts = Interrupts(waiting=lambda: self.training_state != "training" and not self._stepping)

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
        """Train up to `max_num_iterations` in all; nerfstudio 1.1.5 trains that many more after resuming.

        Raises:
            SystemExit: SIGINT or SIGTERM came: with a checkpoint saved, a line printed that says how to go on, and the
                exit code that shells give these signals.
        """
        total = self.config.max_num_iterations
        self.step = max(self._start_step - 1, 0)  # names the checkpoint when nothing is left to do
        self._completed_step = self._saved_step = self._start_step - 1
        self.config.max_num_iterations = max(total - self._start_step, 0)
        try:
            with self._interrupts:
                super().train()
        except Interrupted as interrupted:
            self._stop(interrupted, total)
        finally:
            self.config.max_num_iterations = total

    def train_iteration(self, step: int) -> Any:
        """nerfstudio's; from here to `_update_viewer_state` no signal may stop the run."""
        self._stepping = True
        return super().train_iteration(step)

    def _update_viewer_state(self, step: int) -> None:
        """nerfstudio calls this after every step, when densification is done."""
        self._completed_step, self._stepping = step, False
        self._interrupts.poll()
        super()._update_viewer_state(step)

    def _train_complete_viewer(self) -> None:
        """nerfstudio waits here for the viewer's user, for ever."""
        self._interrupts.poll()
        super()._train_complete_viewer()

    def _stop(self, interrupted: Interrupted, total: int) -> None:
        """Save what was trained and leave; a run that had only its viewer left just ends."""
        if self._completed_step > self._saved_step:
            self.save_checkpoint(self._completed_step)
        done = self._completed_step + 1
        if done >= total:
            return
        if done == self._start_step:
            text = f"{interrupted}: stopped before an iteration was done; the same command starts again."
        else:
            command = resume_command(sys.argv, self.config.method_name or "", self.checkpoint_dir)
            text = f"{interrupted}: stopped and saved after {done} of {total} iterations; resume with: {command}"
        CONSOLE.print(text, markup=False, highlight=False, soft_wrap=True)
        raise SystemExit(128 + interrupted.number)

    def _load_checkpoint(self) -> None:
        """Resume as nerfstudio does, but with the safe loader, and from an earlier checkpoint if the latest is damaged.

        Raises:
            ValueError: No checkpoint can be read, in one sentence.
        """
        config = self.config
        if config.load_dir is None and config.load_checkpoint is None:
            return super()._load_checkpoint()
        if config.load_dir is not None and config.load_step is None:
            path, state = checkpoints.read_latest(config.load_dir)
        elif config.load_dir is not None:
            path = config.load_dir / f"step-{config.load_step:09d}.ckpt"
            state = checkpoints.read(path)
        else:
            path = config.load_checkpoint
            assert path is not None
            state = checkpoints.read(path)
        self._start_step = state["step"] + 1
        self.pipeline.load_pipeline(state["pipeline"], state["step"])
        self.optimizers.load_optimizers(state["optimizers"])
        if "schedulers" in state and config.load_scheduler:
            self.optimizers.load_schedulers(state["schedulers"])
        self.grad_scaler.load_state_dict(state["scalers"])
        CONSOLE.print(f"Resuming after step {state['step']} of {path}", markup=False, soft_wrap=True)

    def save_checkpoint(self, step: int) -> None:
        """Save under a temporary name, then rename: a killed save leaves the previous checkpoint as it was.

        The temporary file lies beside the folder of checkpoints: nerfstudio takes every file inside for one.
        """
        self.checkpoint_dir.mkdir(parents=True, exist_ok=True)
        path: Path = self.checkpoint_dir / f"step-{step:09d}.ckpt"
        partial = self.checkpoint_dir.with_name(f"{self.checkpoint_dir.name}.partial")
        others = [other for other in self.checkpoint_dir.glob("*.ckpt") if other != path]
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
            if others:  # about to be deleted: the new one must be on the disk, lest a power cut takes both
                with partial.open("rb+") as file:
                    os.fsync(file.fileno())
            os.replace(partial, path)
        finally:
            partial.unlink(missing_ok=True)
        self._saved_step = step
        if self.config.save_only_latest_checkpoint:
            for other in others:
                other.unlink()
