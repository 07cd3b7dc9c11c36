"""The options of `ns-train sadgs` besides data and model, and the checks of all of them before a run starts."""

from __future__ import annotations

import errno
import math
import os
import socket
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import torch
import yaml
from nerfstudio.configs.base_config import LocalWriterConfig, LoggingConfig, MachineConfig, ViewerConfig
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.utils.rich_utils import CONSOLE
from tyro.conf import Suppress

from sadgs_ns.data.parsers import check_capture, keep_findings
from sadgs_ns.errors import InputError, reason
from sadgs_ns.files import atomic_path
from sadgs_ns.kernels import SWITCH, switched_off
from sadgs_ns.plugin import checkpoints, processes
from sadgs_ns.plugin.optimizers import FusedAdam, RunLengthDecaySchedulerConfig
from sadgs_ns.plugin.options import check_ranges, hide
from sadgs_ns.plugin.pipeline import SadgsPipelineConfig
from sadgs_ns.plugin.progress import ProgressTable
from sadgs_ns.render.rasterization import choose_backend


@hide("num_machines", "machine_rank", "dist_url")
@dataclass
class SadgsMachineConfig(MachineConfig):
    """nerfstudio's options of the machine; those of several machines are not shown, since torchrun starts these."""

    seed: int = 42
    """Seed of everything that is drawn at random, the order of the training views too."""
    num_devices: int = 1
    """Number of CUDA devices of this machine to train on, among which the Gaussians are shared out.
    torchrun can start the processes instead, on several machines, too; this is then 1."""
    device_type: Literal["cpu", "cuda", "mps"] = field(
        default_factory=lambda: "cuda" if torch.cuda.is_available() else "cpu"
    )
    """Kind of device to train on; CUDA where there is one."""


@hide("websocket_port_default", "relative_log_filename", "num_rays_per_chunk")
@hide("camera_frustum_scale", "default_composite_depth")
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


@hide("method_name", "prompt", "relative_model_dir", "load_scheduler", "log_gradients")
@hide("mixed_precision", "use_grad_scaler", "gradient_accumulation_steps")  # The check below refuses them.
@dataclass
class CheckedTrainerConfig(TrainerConfig):
    """nerfstudio's options of a trainer with this method's defaults, checked before a run starts."""

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
    max_num_iterations: int | None = None  # type: ignore[assignment]
    """Length of the run in optimizer steps; None derives it from the number of views and `pipeline.effort`.
    Densification and the learning rates' schedules stretch to it."""
    rates_follow_views: bool = True
    """Whether the rates of positions, opacities, scales and rotations, set for one view a step, change with more views.
    The mean over more views is less noisy, so that they may be higher, and fall further."""
    cuda_graphs: bool = True
    """Whether the host launches steps of few Gaussians at once, as CUDA graphs, instead of kernel by kernel.
    Only where there is CUDA, and up to a million Gaussians, counted in each view (docs/results.md)."""
    share_always: bool = False
    """Share the Gaussians out over all devices, also where steps are so short that one device alone is quicker.
    There, several devices help only if one does not hold the Gaussians."""
    steps_per_save: int = 0
    """Steps between checkpoints; 0 leaves them to the clock. One is always made at the end."""
    seconds_per_save: float = 60.0
    """Seconds from one checkpoint to the next where steps_per_save is 0; 0 makes none before the end.
    If 100 times what the last one took is longer, that is waited."""
    steps_per_eval_batch: Suppress[int] = 0
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
    logging: Suppress[LoggingConfig] = field(
        default_factory=lambda: LoggingConfig(
            local_writer=LocalWriterConfig(_target=ProgressTable, enable=True), profiler="none"
        )
    )
    """What is printed during training, and how often."""

    def __post_init__(self) -> None:
        """Raise InputError if `load_config` is no config.yml, or if options are given that nerfstudio then forgets."""
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
        """Print nothing. nerfstudio prints all options, which `config.yml` holds, before a run is known to start."""

    def check(self) -> None:
        """Raise InputError if training cannot work with these options, or if the device is not there."""
        length, periods = self.max_num_iterations, ("save", "eval_batch", "eval_image", "eval_all_images")
        check_ranges("", self, [("max_num_iterations", length is None or length >= 1, "at least 1")])
        check_ranges("logging.", self.logging, [("steps_per_log", self.logging.steps_per_log >= 1, "at least 1")])
        for name in (*(f"steps_per_{what}" for what in periods), "seconds_per_save"):
            if not (value := getattr(self, name)) >= 0:
                raise InputError(f"{name} must not be negative, got {value:g}.")
        if self.load_step is not None and self.load_dir is None:
            raise InputError(
                f"load_step is {self.load_step}, but load_dir is not set: add --load-dir with the folder of a run."
            )
        port = self.viewer.websocket_port
        if port is not None and not 1 <= port <= 65535:
            raise InputError(f"viewer.websocket_port must be in [1, 65535], got {port}.")
        self._check_machine()
        self._check_rates()
        if self.mixed_precision or self.use_grad_scaler or self.log_gradients:
            raise InputError(
                "sadgs trains in float32, and its densification reads gradients as they are: leave mixed_precision, "
                "use_grad_scaler and log_gradients off."
            )
        if any(steps != 1 for steps in self.gradient_accumulation_steps.values()):
            raise InputError(
                "sadgs updates every parameter in every iteration, and densification would lose gradients that were "
                "kept for later: leave gradient_accumulation_steps out, and set pipeline.views_per_iteration instead."
            )
        self.pipeline.check()

    def _check_machine(self) -> None:
        """Raise InputError if a device is not there, or several cannot work with these options."""
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
        model, several = self.pipeline.model, processes.check_devices(self.machine)
        if model.backend != "auto":  # That is decided in the process that trains, where Triton tries a kernel.
            choose_backend(model.backend, torch.device(device), not several)
        if not several:
            return
        for name, given, remedy in (
            ("pipeline.model.color_model", model.color_model != "none", "set it to none"),
            ("pipeline.model.camera_optimizer.mode", model.camera_optimizer.mode != "off", "set it to off"),
            ("start_paused", self.start_paused, "leave it off, since the viewer is off, too"),
            (f"{SWITCH}=0", switched_off() and device == "cuda", "unset it"),
        ):
            if given:
                raise InputError(f"{name} works on one device only, and this run takes several: {remedy}.")

    def _check_rates(self) -> None:
        """Raise InputError if a learning rate ever leaves [0, 1], or a factor is not positive and finite."""
        for group, configs in self.optimizers.items():
            adam, rate, scheduler = configs["optimizer"], configs["optimizer"].lr, configs.get("scheduler")
            # One launch updates all parameters.
            if adam._target is not FusedAdam or adam.max_norm is not None or adam.weight_decay:
                raise InputError(
                    f"optimizers.{group}.optimizer must be sadgs's Adam without max_norm and weight_decay: leave out "
                    "all but its lr."
                )
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
        """Raise InputError if the run would delete checkpoints of an earlier run in the same folder."""
        folder = self.get_checkpoint_dir()
        there = sorted(folder.glob("step-*.ckpt")) if os.path.isdir(folder) else []
        start = self.load_dir if self.load_checkpoint is None else self.load_checkpoint.parent
        if there and (start is None or start.resolve() not in (folder.resolve(), folder.parent.resolve())):
            raise InputError(
                f"{folder} holds {there[-1].name} of an earlier run, which this run would delete: go on from it with "
                f"--load-dir {folder.parent} (load_dir in a config.yml), give another --timestamp, or remove it."
            )

    def _check_address(self) -> None:
        """Raise InputError if the viewer cannot listen where it is told to.

        viser would take the next free port, of which nerfstudio knows nothing, or look for one for ever.
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
        if not processes.is_first():
            return  # torchrun's other processes leave the files to the first.
        if self.is_viewer_enabled() or self.is_viewer_legacy_enabled():
            self._check_address()
        findings = check_capture(self.pipeline.datamanager)
        CONSOLE.log(f"Saving config to: {self.write()}")
        keep_findings(self.pipeline.datamanager, findings)  # After writing, so that `config.yml` holds none.

    def write(self) -> Path:
        """Write `config.yml` and return its path. Raise WriteError if that is not possible."""
        path = self.get_base_dir() / "config.yml"
        with atomic_path(path) as partial:
            partial.write_text(yaml.dump(self), "utf8")
        return path
