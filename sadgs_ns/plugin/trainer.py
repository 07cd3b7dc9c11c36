"""The trainer of `ns-train sadgs`: it checks its options, its schedules follow the run's length, and it resumes."""

from __future__ import annotations

import copy
import errno
import math
import os
import shlex
import signal
import socket
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import torch
import yaml
from nerfstudio.configs.base_config import LocalWriterConfig, LoggingConfig, MachineConfig, ViewerConfig
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.engine.trainer import Trainer, TrainerConfig
from nerfstudio.utils import writer
from nerfstudio.utils.rich_utils import CONSOLE
from tyro.conf import Suppress

from sadgs_ns.atomic import atomic_path
from sadgs_ns.data.validation.parsers import check_ahead
from sadgs_ns.errors import InputError, RunError, WriteError, reason
from sadgs_ns.plugin import checkpoints, older_runs
from sadgs_ns.plugin.compilation import compile_kernels
from sadgs_ns.plugin.interrupts import Interrupted, Interrupts
from sadgs_ns.plugin.optimizers import FusedAdamOptimizerConfig, RunLengthDecaySchedulerConfig, SadgsOptimizers
from sadgs_ns.plugin.pipeline import SadgsPipeline, SadgsPipelineConfig
from sadgs_ns.plugin.progress import ProgressTable, about_cpu, remove_tables, what_next

_LESS_MEMORY = (
    "lower --pipeline.model.strategy.max-gaussians or --pipeline.views-per-iteration, or take smaller images "
    "(`--downscale-factor 2` after `nerfstudio-data` or `colmap`)"
)
_NOTHING_DONE = "stopped before an iteration was done; the same command starts again."
_ONE_DEVICE = "sadgs trains on one device; set machine.num_devices and machine.num_machines to 1."
_MEASURED_MEGAPIXELS = 1.0
"""Above this size of images a run with several views an iteration prints a warning; 0.7 and 1.9 were measured."""
_SAVING_SHARE = 0.01
"""Largest share of the time between two checkpoints by the clock that saving may take."""


def _memory(error: torch.cuda.OutOfMemoryError) -> str:
    """Return the first two of torch's many sentences, which say how much memory was asked for, and of whom."""
    return ". ".join(reason(error).split(". ")[:2]).rstrip(".")


@dataclass
class SadgsMachineConfig(MachineConfig):
    """nerfstudio's options of the machine; those of several machines are not shown."""

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
    """nerfstudio's options of the viewer, which here listens on this machine only."""

    websocket_host: str = "127.0.0.1"
    """Address at which the viewer listens: this machine only; 0.0.0.0 opens it to the network."""
    websocket_port: int | None = None
    """Port at which the viewer listens; None is 7007, or a free one where that is taken."""
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
    """Folder of a run, or of its checkpoints, from which the run goes on."""
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
    logging: Suppress[LoggingConfig] = field(
        default_factory=lambda: LoggingConfig(
            local_writer=LocalWriterConfig(_target=ProgressTable, enable=True), profiler="none"
        )
    )
    """What is printed during training, and how often."""
    mixed_precision: Suppress[bool] = False
    """Refused: this method trains in float32."""
    use_grad_scaler: Suppress[bool] = False
    """Refused: densification reads gradients as they are."""
    log_gradients: Suppress[bool] = False
    """Whether gradients' norms are logged at each step."""
    gradient_accumulation_steps: Suppress[dict[str, int]] = field(default_factory=dict)
    """`pipeline.views_per_iteration` takes its place."""

    def __post_init__(self) -> None:
        """Check `load_config` before nerfstudio reads it, since nerfstudio then forgets all other options.

        Raises:
            InputError: If it is no config.yml, or other options were given beside it.
        """
        if self.load_config is None:
            return
        try:
            with self.load_config.open(encoding="utf8") as file:
                problem = None if file.readline().startswith("!!python/object:") else "it is no config.yml of a run"
        except (OSError, UnicodeDecodeError) as error:
            problem = reason(error)
        if problem is not None:
            raise InputError(f"{self.load_config} cannot be used ({problem}): give --load-config the file of a run.")
        from nerfstudio.configs.method_configs import all_methods  # It imports this module.

        preset = all_methods.get(self.method_name or "", self)
        if lost := [
            name for name, value in vars(preset).items() if vars(self)[name] != value and name != "load_config"
        ]:
            raise InputError(
                f"With --load-config all options come from its file, and others are not read, here of "
                f"{', '.join(lost)}: leave them out, change them in the file, or give --load-dir with the run's folder "
                "and all options instead of --load-config."
            )

    def print_to_terminal(self) -> None:
        """Print nothing, where nerfstudio prints 260 lines before it is known whether the run can start.

        `config.yml` holds them all.
        """

    def check(self) -> None:
        """Check whether training can work with these options.

        Raises:
            InputError: If a number is out of its range, gradients would be scaled or accumulated, or the device is not
                there; as `SadgsPipelineConfig.check`.
        """
        for name, count in (
            ("max_num_iterations", self.max_num_iterations),
            ("logging.steps_per_log", self.logging.steps_per_log),
        ):
            if count < 1:
                raise InputError(f"{name} must be at least 1, got {count}.")
        for name in ("save", "eval_batch", "eval_image", "eval_all_images"):
            if (steps := getattr(self, f"steps_per_{name}")) < 0:
                raise InputError(f"steps_per_{name} must not be negative, got {steps}.")
        if not self.seconds_per_save >= 0:
            raise InputError(f"seconds_per_save must not be negative, got {self.seconds_per_save:g}.")
        if self.load_step is not None and self.load_dir is None:
            raise InputError(
                f"load_step is {self.load_step}, but load_dir is not set: add --load-dir with the folder of a run."
            )
        port = self.viewer.websocket_port
        if port is not None and not 1 <= port <= 65535:
            raise InputError(f"viewer.websocket_port must be in [1, 65535], got {port}.")
        if self.machine.num_devices * self.machine.num_machines != 1:
            raise InputError(_ONE_DEVICE)
        device = self.machine.device_type
        available = {"cpu": True, "cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available()}
        if not available[device]:
            name = device.upper()
            raise InputError(
                f"machine.device_type is {device}, but torch finds no {name} device: set it to cpu, or install torch "
                f"for {name}."
            )
        if not 0 <= self.machine.seed < 2**32:
            raise InputError(f"machine.seed must be in [0, 2³²), got {self.machine.seed}.")
        self._check_rates()
        if self.mixed_precision or self.use_grad_scaler:
            raise InputError(
                "sadgs trains in float32, and its densification reads gradients as they are: leave mixed_precision and "
                "use_grad_scaler off."
            )
        if any(steps != 1 for steps in self.gradient_accumulation_steps.values()):
            raise InputError(
                "sadgs updates every parameter in every iteration, and densification would lose gradients that were "
                "kept for later: leave gradient_accumulation_steps out, and set pipeline.views_per_iteration instead."
            )
        self.pipeline.check()

    def _check_rates(self) -> None:
        """Check whether the learning rates can train anything.

        Raises:
            InputError: If one is not in [0, 1], now or where a schedule ends, or a factor is not positive and finite.
        """
        for group, configs in self.optimizers.items():
            rate, scheduler = configs["optimizer"].lr, configs.get("scheduler")
            if not 0 <= rate <= 1:
                raise InputError(f"optimizers.{group}.optimizer.lr must be in [0, 1], got {rate:g}.")
            if isinstance(scheduler, RunLengthDecaySchedulerConfig):
                for name in ("initial_factor", "final_factor"):
                    if not 0 < (factor := getattr(scheduler, name)) < math.inf:
                        raise InputError(
                            f"optimizers.{group}.scheduler.{name} must be positive and finite, got {factor:g}."
                        )
                    if rate * factor > 1:
                        raise InputError(
                            f"optimizers.{group}.scheduler.{name} must leave the rate in [0, 1], got {factor:g}, which "
                            f"makes {rate * factor:g} of {rate:g}."
                        )

    def _check_folder(self) -> None:
        """Check whether the run would delete checkpoints of an earlier run in the same folder.

        Raises:
            InputError: If it would: the folder holds some, and the run does not go on from them.
        """
        folder = self.get_checkpoint_dir()
        there = sorted(folder.glob("step-*.ckpt")) if os.path.isdir(folder) else []
        start = self.load_dir if self.load_checkpoint is None else self.load_checkpoint.parent
        if there and (start is None or start.resolve() not in (folder.resolve(), folder.parent.resolve())):
            raise InputError(
                f"{folder} holds {there[-1].name} of an earlier run, which this run would delete: go on from it with "
                f"--load-dir {folder.parent} (load_dir in a config.yml), give another --timestamp, or remove it."
            )

    def _check_address(self) -> None:
        """Check whether the viewer can listen where it is told to.

        viser would take the next free port, of which nerfstudio knows nothing, or look for one for ever.

        Raises:
            InputError: If it cannot.
        """
        host, port = self.viewer.websocket_host, self.viewer.websocket_port
        try:
            places = socket.getaddrinfo(host, port or 0, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
        except OSError as error:
            raise InputError(
                f"viewer.websocket_host {host!r} is unknown ({reason(error)}): 127.0.0.1 opens the viewer to this "
                "machine only, 0.0.0.0 to the network."
            ) from error
        try:
            for family, _, _, _, address in places:
                socket.create_server(address, family=family).close()
        except OSError as error:
            what = reason(error).partition(" (while")[0]
            if error.errno == errno.EADDRINUSE:
                told = (
                    f"viewer.websocket_port {port} is taken on {host} ({what}): give another, or none for a free one."
                )
            else:
                told = f"The viewer cannot listen on {host}{f':{port}' if port else ''} ({what}): give another "
                told += "viewer.websocket_host or viewer.websocket_port."
            raise InputError(told) from error

    def save_config(self) -> None:
        """Write `config.yml`, the first file of a run, once options, checkpoint and data have been found good.

        Raises:
            InputError: If they are not; nothing is written then.
            WriteError: If the folder cannot be written.
        """
        self.check()
        checkpoints.check_chosen(self.load_dir, self.load_step, self.load_checkpoint)
        self._check_folder()
        if self.is_viewer_enabled() or self.is_viewer_legacy_enabled():
            self._check_address()
        check_ahead(self.pipeline.datamanager)
        CONSOLE.log(f"Saving config to: {self.write()}")

    def write(self) -> Path:
        """Write `config.yml` and return its path.

        Raises:
            WriteError: If the disk is full or the folder cannot be written.
        """
        path = self.get_base_dir() / "config.yml"
        with atomic_path(path) as partial:
            partial.write_text(yaml.dump(self), "utf8")
        return path


older_runs.read_with(SadgsTrainerConfig)


class SadgsTrainer(Trainer):
    """A trainer for one model on one device.

    Raises:
        InputError: If several devices are asked for; as `SadgsTrainerConfig.check`.
    """

    config: SadgsTrainerConfig
    pipeline: SadgsPipeline

    def __init__(self, config: SadgsTrainerConfig, local_rank: int = 0, world_size: int = 1) -> None:
        if world_size > 1:
            raise InputError(_ONE_DEVICE)
        config.check()
        super().__init__(config, local_rank, world_size)
        self._stepping = False
        self._completed_step = self._saved_step = -1
        self._save_due = math.inf
        # A run that is paused or done polls no signal, because nerfstudio waits for the viewer's user.
        self._interrupts = Interrupts(waiting=lambda: self.training_state != "training" and not self._stepping)

    def setup(self, *args: Any, **kwargs: Any) -> None:
        """Load data, model and checkpoint, and compile what the machine has not compiled yet.

        Raises:
            InputError: If one of them cannot be used.
            RunError: If they do not fit the GPU's memory.
            SystemExit: If SIGINT came; nerfstudio would print a traceback.
        """
        try:
            super().setup(*args, **kwargs)
            self._say_what_was_chosen()
            last = [TrainingCallbackLocation.AFTER_TRAIN]
            self.callbacks.append(TrainingCallback(last, lambda step: self._say_what_is_next()))
            compile_kernels(self.pipeline, self.optimizers.optimizers)
        except torch.cuda.OutOfMemoryError as error:
            raise RunError(f"The GPU's memory is too small to start ({_memory(error)}): {_LESS_MEMORY}.") from error
        except KeyboardInterrupt:
            CONSOLE.print(f"SIGINT: {_NOTHING_DONE}", soft_wrap=True)
            raise SystemExit(128 + signal.SIGINT) from None

    def _say_what_was_chosen(self) -> None:
        """Print the run's size in one line, after the memory plan's, and warn of what does not suit the data."""
        cameras, config = self.pipeline.datamanager.train_dataset.cameras, self.config
        views, asked, taken = len(cameras), config.pipeline.views_per_iteration, self.pipeline.views_per_iteration
        megapixels = float((cameras.height * cameras.width).double().mean()) / 1e6
        done = f", of which {self._start_step:,} are done" if self._start_step else ""
        times = round(config.max_num_iterations * taken / views)
        lines = [
            f"{config.method_name} on {views:,} training views of {megapixels:.2g} megapixels: "
            f"{config.max_num_iterations:,} iterations of {taken} view{'s' * (taken > 1)}{done}, so that each view is "
            f"rendered about {times:,} time{'s' * (times != 1)}."
        ]
        if asked > taken:
            lines.append(
                f"[yellow]pipeline.views_per_iteration is {asked}, but there are {views} training views: all are taken "
                "each time.[/]"
            )
        if taken > 1 and megapixels > _MEASURED_MEGAPIXELS:
            lines.append(
                "[yellow]Training with several views an iteration was measured on images of up to 0.7 megapixels; "
                "outdoors, on images of 1.9, it took twice as long as sadgs and was worse. Consider sadgs, or smaller "
                "images.[/]"
            )
        if self.device == "cpu":
            lines.append(f"[yellow]{about_cpu(torch.get_num_threads())}[/]")
        CONSOLE.print("\n".join(lines), highlight=False, soft_wrap=True)

    def _say_what_is_next(self) -> None:
        """Print the commands for a run that is done, below nerfstudio's box; not where the run ends with an error."""
        if not self.pipeline.stuck:
            text = what_next(self.base_dir / "config.yml", self.pipeline.model.num_points)
            CONSOLE.print(text, markup=False, highlight=False, soft_wrap=True)

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
            self.pipeline.refuse_other_capture()
            if more := sorted(state["optimizers"].keys() - self.optimizers.optimizers.keys()):
                raise InputError(
                    f"It optimized {' and '.join(more)}, too: set pipeline.model.use-bilateral-grid and "
                    "pipeline.model.camera-optimizer.mode as they were."
                )
            self.optimizers.load_optimizers(state["optimizers"])
            if "schedulers" in state and config.load_scheduler:
                self.optimizers.load_schedulers(state["schedulers"])
            self.grad_scaler.load_state_dict(state["scalers"])
        except torch.cuda.OutOfMemoryError:
            raise
        except InputError as error:
            raise InputError(f"{path} cannot be continued: {str(error).rstrip('.')}; {checkpoints.REMEDY}.") from error
        except Exception as error:  # The parts of a foreign file may raise anything.
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
        """Train up to `max_num_iterations` in all, where nerfstudio 1.1.5 would train that many more after resuming.

        Raises:
            RunError: If the GPU's memory is full, or nothing is learned any more.
            WriteError: If a checkpoint or log could not be written.
            SystemExit: If SIGINT, SIGTERM or SIGHUP came. A checkpoint is saved then, a line says how to go on, and the
                exit code is the one that shells give these signals.
        """
        total = self.config.max_num_iterations
        self.step: int = max(self._start_step - 1, 0)  # It names the checkpoint where nothing is left to do.
        self._completed_step = self._saved_step = self._start_step - 1
        self.config.max_num_iterations = max(total - self._start_step, 0)
        if self._start_step >= total:
            writer.GLOBAL_BUFFER["step"] = self.step  # nerfstudio's table reads what only an iteration sets.
            CONSOLE.print(
                f"This run is finished after {self._start_step} iterations: --max-num-iterations of more than "
                f"{self._start_step} trains on.",
                highlight=False,
                soft_wrap=True,
            )
        out_of_memory = ""
        self._set_clock(0.0)
        try:
            with self._interrupts:
                try:
                    super().train()
                    self._stop_if_stuck()
                except Interrupted as interrupted:
                    self._stop(interrupted, total)
        except torch.cuda.OutOfMemoryError as error:
            out_of_memory = _memory(error)  # The RunError is raised below, when the failed step's tensors are gone.
        except OSError as error:
            if error.errno is None:  # It is a WriteError, or it does not come from the disk.
                raise
            # A logger, such as tensorboard's, could not write; its file may be on another disk, or its folder is gone.
            if not self._stepping and self._completed_step > self._saved_step:
                self.save_checkpoint(self._completed_step)
            raise WriteError(Path(os.fsdecode(error.filename or self.base_dir)), error) from error
        finally:
            self.config.max_num_iterations = total
            remove_tables()
        if out_of_memory:
            raise RunError(self._rescue(out_of_memory))

    def _rescue(self, out_of_memory: str) -> str:
        """Save the state before the present step if it is whole, and return what to tell the user.

        If memory ran out while Gaussians were split, the saved state holds the step's update already, and the resumed
        run makes it a second time.
        """
        torch.cuda.empty_cache()
        model = self.pipeline.model
        lengths = {len(parameter) for parameter in model.gauss_params.values()}
        for name, parameter in model.gauss_params.items():
            states = self.optimizers.optimizers[name].state
            if not states and parameter.numel() > 0:
                lengths.add(-1)  # gsplat takes the state out while it rewrites it.
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
        """Run nerfstudio's iteration; no signal may stop the run from here to `_update_viewer_state`."""
        self._stepping = True
        return super().train_iteration(step)

    def _update_viewer_state(self, step: int) -> None:
        """Stop or save where that is due; nerfstudio calls this after every step, when densification is done."""
        self._completed_step, self._stepping = step, False
        self._interrupts.poll()
        self._stop_if_stuck()
        if time.monotonic() >= self._save_due:
            self.save_checkpoint(step)
        super()._update_viewer_state(step)

    def _train_complete_viewer(self) -> None:
        """Wait for the viewer's user, as nerfstudio does for ever, unless the run must stop."""
        self._interrupts.poll()
        self._stop_if_stuck()
        super()._train_complete_viewer()

    def _set_clock(self, took: float) -> None:
        """Set when the next checkpoint is due, after one that took `took` seconds to save."""
        config = self.config
        by_clock = config.steps_per_save == 0 and config.seconds_per_save > 0
        wait = max(config.seconds_per_save, took / _SAVING_SHARE) if by_clock else math.inf
        self._save_due = time.monotonic() + wait

    def _stop(self, interrupted: Interrupted, total: int) -> None:
        """Save a checkpoint, and in `config.yml` that the run goes on from it; a run that was done just ends."""
        if self._completed_step > self._saved_step:
            self.save_checkpoint(self._completed_step)
        done = self._completed_step + 1
        if done >= total:
            return
        if done == self._start_step:
            text = f"{interrupted}: {_NOTHING_DONE}"
        else:
            # With --load-config nerfstudio takes all options from the file, so the file must name the checkpoints, too.
            config = copy.copy(self.config)
            config.max_num_iterations = total
            config.load_dir, config.load_step, config.load_checkpoint = self.checkpoint_dir, None, None
            command = shlex.join(["ns-train", str(config.method_name), "--load-config", str(config.write())])
            text = f"{interrupted}: stopped and saved after {done} of {total} iterations; resume with: {command}"
        CONSOLE.print(text, markup=False, highlight=False, soft_wrap=True)
        raise SystemExit(128 + interrupted.number)

    def _stop_if_stuck(self) -> None:
        """Save the Gaussians and end the run if they learn nothing any more because gradients are not finite.

        Raises:
            RunError: If so.
        """
        if not self.pipeline.stuck:
            return
        kept = "the Gaussians themselves are not finite: train anew, or from a checkpoint in which they are"
        if all(bool(parameter.isfinite().all()) for parameter in self.pipeline.model.gauss_params.values()):
            if self._completed_step > self._saved_step:
                self.save_checkpoint(self._completed_step)
            kept = f"the Gaussians as they are now are saved and go on with --load-dir {self.checkpoint_dir}"
        raise RunError(
            f"{self.pipeline.stuck}; look at them with sadgs-doctor, and lower the learning rates if you raised them; "
            f"{kept}."
        )

    def save_checkpoint(self, step: int) -> None:
        """Save under a temporary name and rename, so that a killed save leaves the previous checkpoint as it was.

        The temporary file lies beside the folder of checkpoints, because nerfstudio takes every file inside for one.

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
            except RuntimeError as error:  # torch's writer reports a full disk in this way.
                raise OSError(reason(error)) from error
            if others:  # These are about to be deleted, so the new one must survive a power cut first.
                with partial.open("rb+") as file:
                    os.fsync(file.fileno())
        self._saved_step = step
        if self.config.save_only_latest_checkpoint and not self.pipeline.stuck:  # An earlier one may then be better.
            for other in others:
                other.unlink()
        self._set_clock(time.monotonic() - start)
