"""nerfstudio glue: a trainer whose schedules follow the run's length and whose checkpoints resume."""

from __future__ import annotations

import copy
import math
import os
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
import yaml
from nerfstudio.configs.base_config import LoggingConfig, MachineConfig, ViewerConfig
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.utils.rich_utils import CONSOLE
from tyro.conf import Suppress

from sadgs_ns.atomic import atomic_path
from sadgs_ns.data.parser_validation import check_ahead
from sadgs_ns.errors import InputError, RunError, WriteError, reason
from sadgs_ns.plugin import checkpoints, older_runs
from sadgs_ns.plugin.compilation import compile_kernels
from sadgs_ns.plugin.interrupts import Interrupted, Interrupts, resume_command
from sadgs_ns.plugin.optimizers import FusedAdamOptimizerConfig, RunLengthDecaySchedulerConfig, SadgsOptimizers
from sadgs_ns.plugin.pipeline import SadgsPipeline, SadgsPipelineConfig

_LESS_MEMORY = (
    "lower --pipeline.model.strategy.max-gaussians or --pipeline.views-per-iteration, or take smaller images "
    "(`--downscale-factor 2` after `nerfstudio-data` or `colmap`)"
)
_SAVING_SHARE = 0.01
"""The most of the time from one of the clock's checkpoints to the next that the saving may take."""


def _memory(error: torch.cuda.OutOfMemoryError) -> str:
    """How much memory was asked for, and of whom: the first two of torch's many sentences."""
    return ". ".join(reason(error).split(". ")[:2]).rstrip(".")


@dataclass
class SadgsMachineConfig(MachineConfig):
    """nerfstudio's, for one machine."""

    seed: int = 42
    """Seed of everything that is drawn at random."""
    num_devices: int = 1
    """Number of devices to train on; this method trains on one."""
    device_type: Literal["cpu", "cuda", "mps"] = field(
        default_factory=lambda: "cuda" if torch.cuda.is_available() else "cpu"
    )
    """Kind of device to train on; CUDA where there is one."""
    num_machines: Suppress[int] = 1
    """Number of machines; this method trains on one."""
    machine_rank: Suppress[int] = 0
    """Rank of this machine among several."""
    dist_url: Suppress[str] = "auto"
    """Where several devices meet."""


@dataclass
class SadgsViewerConfig(ViewerConfig):
    """nerfstudio's, but listening on this machine only."""

    websocket_host: str = "127.0.0.1"
    """Address at which the viewer listens: this machine only; 0.0.0.0 opens it to the network."""
    websocket_port: int | None = None
    """Port at which the viewer listens; None is 7007, or the next free one."""
    quit_on_train_completion: bool = False
    """End the command when training is done, instead of keeping the viewer open."""
    max_num_display_images: int = 512
    """Number of training images shown as cameras in the viewer, -1 for all; training takes all images anyway."""
    make_share_url: bool = False
    """Print an address at which others can open the viewer, through a server of viser's makers."""
    websocket_port_default: Suppress[int] = 7007
    """Port that is tried first where `websocket_port` is None."""
    relative_log_filename: Suppress[str] = "viewer_log_filename.txt"
    """Name of the viewer's log."""
    num_rays_per_chunk: Suppress[int] = 32768
    """Gaussians are not drawn in rays."""
    camera_frustum_scale: Suppress[float] = 0.1
    """Size of the cameras at the start; a slider in the viewer sets it, too."""
    default_composite_depth: Suppress[bool] = True
    """Whether cameras behind the splat are hidden at the start; a box in the viewer sets it, too."""


@dataclass
class SadgsTrainerConfig(TrainerConfig):
    """nerfstudio's trainer with this method's defaults."""

    _target: type = field(default_factory=lambda: SadgsTrainer)
    output_dir: Path = Path("outputs")
    """Folder in which each run gets a folder of its own."""
    experiment_name: str | None = None
    """Name of the run's folder; None takes that of the data."""
    timestamp: str = "{timestamp}"
    """Name of the folder inside the experiment's and the method's; by default it is the time of the start."""
    machine: SadgsMachineConfig = field(default_factory=SadgsMachineConfig)
    """Device and seed."""
    pipeline: SadgsPipelineConfig = field(default_factory=SadgsPipelineConfig)
    """Data and model."""
    viewer: SadgsViewerConfig = field(default_factory=SadgsViewerConfig)
    """The viewer in the browser."""
    max_num_iterations: int = 3000
    """Length of the run in optimizer steps; schedules stretch to it."""
    steps_per_save: int = 0
    """Steps between checkpoints; 0 leaves them to the clock. One is always made at the end."""
    seconds_per_save: float = 60.0
    """Seconds from one checkpoint to the next where steps_per_save is 0; 0 makes none before the end.
    If 100 times what the last one took is longer, that is waited."""
    steps_per_eval_batch: int = 0
    """Steps between losses on a held-out view; 0 is never."""
    steps_per_eval_image: int = 500
    """Steps between metrics of one held-out view, where a logger such as tensorboard is on."""
    steps_per_eval_all_images: int = 0
    """Steps between metrics of all held-out views; 0 is never. `ns-eval` measures them after training."""
    data: Path | None = None
    """Folder of the data."""
    project_name: str | None = "nerfstudio-project"
    """Name of the project in wandb and comet."""
    vis: Literal[
        "viewer", "wandb", "tensorboard", "comet", "viewer+wandb", "viewer+tensorboard", "viewer+comet", "viewer_legacy"
    ] = "viewer"
    """Where the run can be watched. With a viewer the command waits at the end, until Ctrl+C."""
    save_only_latest_checkpoint: bool = True
    """Keep the latest checkpoint only, instead of all."""
    load_dir: Path | None = None
    """Folder of checkpoints (nerfstudio_models) from which the run goes on."""
    load_step: int | None = None
    """Step of the checkpoint in `load_dir`; None takes the latest."""
    load_checkpoint: Path | None = None
    """Checkpoint from which the run goes on."""
    load_config: Path | None = None
    """The config.yml of a run whose options are taken, instead of all others; nerfstudio executes what it says."""
    start_paused: bool = False
    """Wait for a click in the viewer before training starts."""
    method_name: Suppress[str | None] = None
    """The preset's name."""
    prompt: Suppress[str | None] = None
    """Read by methods that make scenes from text."""
    relative_model_dir: Suppress[Path] = Path("nerfstudio_models")
    """Folder of the checkpoints inside the run's."""
    load_scheduler: Suppress[bool] = True
    """Whether schedules go on where the checkpoint left them."""
    logging: Suppress[LoggingConfig] = field(default_factory=LoggingConfig)
    """What nerfstudio prints, and how often."""
    mixed_precision: Suppress[bool] = False
    """Refused: this method trains in float32."""
    use_grad_scaler: Suppress[bool] = False
    """Refused: densification reads gradients as they are."""
    log_gradients: Suppress[bool] = False
    """Whether gradients' norms are logged at each step."""
    gradient_accumulation_steps: Suppress[dict[str, int]] = field(default_factory=dict)
    """`pipeline.views_per_iteration` takes its place."""

    def check(self) -> None:
        """See whether training can work with these options.

        Raises:
            InputError: If there is no iteration to do, or gradients would be scaled; as `SadgsPipelineConfig.check`.
        """
        if self.max_num_iterations < 1:
            raise InputError(f"max_num_iterations must be at least 1, got {self.max_num_iterations}.")
        if self.mixed_precision or self.use_grad_scaler:
            raise InputError(
                "sadgs trains in float32, and its densification reads gradients as they are: leave mixed_precision and "
                "use_grad_scaler off."
            )
        self.pipeline.check()

    def save_config(self) -> None:
        """Write `config.yml`, the first file of a run: not before options, checkpoint, data and folder are found good.

        Raises:
            InputError: If they are not; nothing is written then.
        """
        self.check()
        checkpoints.check_chosen(self.load_dir, self.load_step, self.load_checkpoint)
        check_ahead(self.pipeline.datamanager)
        path = self.get_base_dir() / "config.yml"
        CONSOLE.log(f"Saving config to: {path}")
        try:
            with atomic_path(path) as partial:
                partial.write_text(yaml.dump(self), "utf8")
        except WriteError as error:
            raise InputError(str(error)) from error


older_runs.read_with(SadgsTrainerConfig)


class SadgsTrainer(Trainer):
    """Trains one model on one device.

    Raises:
        InputError: If several devices are asked for; as `SadgsTrainerConfig.check`.
    """

    config: SadgsTrainerConfig
    pipeline: SadgsPipeline

    def __init__(self, config: SadgsTrainerConfig, local_rank: int = 0, world_size: int = 1) -> None:
        if world_size > 1:
            raise InputError(f"sadgs trains on one device; set machine.num_devices to 1, not {world_size}.")
        config.check()
        super().__init__(config, local_rank, world_size)
        self._stepping = False
        self._completed_step = self._saved_step = -1
        self._save_due = math.inf
        # Paused or done, nerfstudio waits for the viewer's user.
        self._interrupts = Interrupts(waiting=lambda: self.training_state != "training" and not self._stepping)

    def setup(self, *args: Any, **kwargs: Any) -> None:
        """Load data, model and checkpoint, and compile what the machine has not compiled yet.

        Raises:
            InputError: If one of them cannot be used.
            RunError: If they do not fit the GPU's memory.
        """
        try:
            super().setup(*args, **kwargs)
            compile_kernels(self.pipeline, self.optimizers.optimizers)
        except torch.cuda.OutOfMemoryError as error:
            raise RunError(f"The GPU's memory is too small to start ({_memory(error)}): {_LESS_MEMORY}.") from error

    def _load_checkpoint(self) -> None:
        """Resume as nerfstudio does, but with the safe loader, and from an earlier checkpoint if the latest is damaged.

        Raises:
            InputError: If there is none, none can be read, or it is not of this method.
        """
        config = self.config
        chosen = checkpoints.read_chosen(config.load_dir, config.load_step, config.load_checkpoint)
        if chosen is None:
            return super()._load_checkpoint()
        path, state = chosen
        try:
            self._start_step = state["step"] + 1
            self.pipeline.load_pipeline(state["pipeline"], state["step"])
            self.optimizers.load_optimizers(state["optimizers"])
            if "schedulers" in state and config.load_scheduler:
                self.optimizers.load_schedulers(state["schedulers"])
            self.grad_scaler.load_state_dict(state["scalers"])
        except torch.cuda.OutOfMemoryError:
            raise
        except InputError as error:
            raise InputError(f"{path} cannot be continued: {str(error).rstrip('.')}; {checkpoints.REMEDY}.") from error
        except Exception as error:  # a foreign file's parts lead to whatever they lead to
            what = f"{type(error).__name__}: {reason(error)}"
            raise InputError(
                f"{path} is not a checkpoint of this version of sadgs ({what}): {checkpoints.REMEDY}."
            ) from error
        CONSOLE.print(f"Resuming after step {state['step']} of {path}", markup=False, soft_wrap=True)

    def setup_optimizers(self) -> SadgsOptimizers:
        """Build the optimizers with schedules as long as the run, fused where the model is."""
        optimizers: dict[str, Any] = copy.deepcopy(dict(self.config.optimizers))
        for group in optimizers.values():
            scheduler, optimizer = group.setdefault("scheduler", None), group["optimizer"]
            if isinstance(optimizer, FusedAdamOptimizerConfig):
                optimizer.fused &= self.config.pipeline.model.fused
            if isinstance(scheduler, RunLengthDecaySchedulerConfig) and scheduler.max_steps is None:
                scheduler.max_steps = self.config.max_num_iterations
        # Positions move in proportion to the cameras' extent, as in 3DGS; splatfacto does not do so.
        optimizers["means"]["optimizer"].lr *= self.pipeline.model.strategy_state["scene_scale"]
        return SadgsOptimizers(optimizers, self.pipeline.get_param_groups())

    def train(self) -> None:
        """Train up to `max_num_iterations` in all; nerfstudio 1.1.5 trains that many more after resuming.

        Raises:
            RunError: If the GPU's memory is full or a checkpoint could not be saved.
            SystemExit: SIGINT or SIGTERM came: with a checkpoint saved, a line printed that says how to go on, and the
                exit code that shells give these signals.
        """
        total = self.config.max_num_iterations
        self.step: int = max(self._start_step - 1, 0)  # names the checkpoint when nothing is left to do
        self._completed_step = self._saved_step = self._start_step - 1
        self.config.max_num_iterations = max(total - self._start_step, 0)
        out_of_memory = ""
        self._set_clock(0.0)
        try:
            try:
                with self._interrupts:
                    super().train()
            except Interrupted as interrupted:
                self._stop(interrupted, total)
        except torch.cuda.OutOfMemoryError as error:
            out_of_memory = _memory(error)  # raised below, when the failed step's tensors are gone
        except OSError as error:
            if error.errno is None and not isinstance(error, WriteError):
                raise  # not from the disk
            if not isinstance(error, WriteError):  # of a logger, such as tensorboard's
                error = WriteError(Path(error.filename or self.base_dir), error)
            raise RunError(str(error)) from error
        finally:
            self.config.max_num_iterations = total
        if out_of_memory:
            raise RunError(self._rescue(out_of_memory))

    def _rescue(self, out_of_memory: str) -> str:
        """Save the state of before the present step, if it is whole; returns what to tell the user.

        Memory that ran out while Gaussians were split leaves the step's update in it, which is then made twice.
        """
        torch.cuda.empty_cache()
        model = self.pipeline.model
        lengths = {len(parameter) for parameter in model.gauss_params.values()}
        for name, parameter in model.gauss_params.items():
            states = self.optimizers.optimizers[name].state
            if not states and parameter.numel() > 0:
                lengths.add(-1)  # gsplat takes a state out while it rewrites it
            for state in states.values():
                lengths |= {len(value) for value in state.values() if isinstance(value, torch.Tensor) and value.dim()}
        lengths |= {len(v) for v in model.strategy_state.values() if isinstance(v, torch.Tensor) and v.dim()}
        if len(lengths) > 1 or self.step <= self._start_step:
            kept = "nothing newer than the last checkpoint could be saved"
        else:
            try:
                self.save_checkpoint(max(self.step - 1, self._completed_step))
                kept = f"what was trained is saved and goes on with --load-dir {self.checkpoint_dir}"
            except WriteError as error:
                kept = f"what was trained is lost, since {error}"
        return (
            f"The GPU's memory was full at iteration {self.step} with {model.num_points} Gaussians ({out_of_memory}): "
            f"{_LESS_MEMORY}; {kept}."
        )

    def train_iteration(self, step: int) -> Any:
        """nerfstudio's; from here to `_update_viewer_state` no signal may stop the run."""
        self._stepping = True
        return super().train_iteration(step)

    def _update_viewer_state(self, step: int) -> None:
        """nerfstudio calls this after every step, when densification is done."""
        self._completed_step, self._stepping = step, False
        self._interrupts.poll()
        if time.monotonic() >= self._save_due:
            self.save_checkpoint(step)
        super()._update_viewer_state(step)

    def _train_complete_viewer(self) -> None:
        """nerfstudio waits here for the viewer's user, for ever."""
        self._interrupts.poll()
        super()._train_complete_viewer()

    def _set_clock(self, took: float) -> None:
        """Say when the next checkpoint is due, after one that took so many seconds."""
        config = self.config
        by_clock = config.steps_per_save == 0 and config.seconds_per_save > 0
        wait = max(config.seconds_per_save, took / _SAVING_SHARE) if by_clock else math.inf
        self._save_due = time.monotonic() + wait

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

    def save_checkpoint(self, step: int) -> None:
        """Save under a temporary name, then rename: a killed save leaves the previous checkpoint as it was.

        The temporary file lies beside the folder of checkpoints: nerfstudio takes every file inside for one.

        Raises:
            WriteError: If the disk is full or the folder cannot be written.
        """
        start = time.monotonic()
        path: Path = self.checkpoint_dir / f"step-{step:09d}.ckpt"
        others = [other for other in self.checkpoint_dir.glob("*.ckpt") if other != path]
        state = {
            "step": step,
            "pipeline": self.pipeline.state_dict(),
            "optimizers": {name: o.state_dict() for name, o in self.optimizers.optimizers.items()},
            "schedulers": {name: s.state_dict() for name, s in self.optimizers.schedulers.items()},
            "scalers": self.grad_scaler.state_dict(),
        }
        with atomic_path(path, beside=self.checkpoint_dir) as partial:
            try:
                torch.save(state, partial)
            except RuntimeError as error:  # so torch's writer calls a full disk
                raise OSError(reason(error)) from error
            if others:  # about to be deleted: the new one must be on the disk, lest a power cut takes both
                with partial.open("rb+") as file:
                    os.fsync(file.fileno())
        self._saved_step = step
        if self.config.save_only_latest_checkpoint:
            for other in others:
                other.unlink()
        self._set_clock(time.monotonic() - start)
