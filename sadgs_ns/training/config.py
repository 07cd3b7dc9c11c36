"""The options of `ns-train sadgs`, and the checks of their ranges. Those of optimizers are in optimizers.py."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

import torch
from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
from nerfstudio.configs.base_config import (
    InstantiateConfig,
    LocalWriterConfig,
    LoggingConfig,
    MachineConfig,
    ViewerConfig,
)
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.pipelines.base_pipeline import VanillaPipelineConfig

from sadgs_ns.data.parsers import AnyParserConfig, AutomaticDataParserConfig
from sadgs_ns.errors import InputError, reason
from sadgs_ns.geometry.initialization import POINT_OPACITY
from sadgs_ns.kernels import SWITCH, switched_off
from sadgs_ns.method.quantization import HIGHEST_FREQUENCY
from sadgs_ns.method.schedule import MOST_EFFORT
from sadgs_ns.method.strategy import StructureAwareStrategy
from sadgs_ns.method.structure_tensor import ENERGY_BLUR, FREQUENCY_CONSTANT
from sadgs_ns.render.rasterization import choose_backend
from sadgs_ns.render.types import BackendName
from sadgs_ns.training.options import Hidden, check_ranges, check_unused, fill_missing, hide
from sadgs_ns.training.run import processes
from sadgs_ns.training.run.progress import ProgressTable
from sadgs_ns.training.run.run_folder import begin
from sadgs_ns.training.step.optimizers import FusedAdam, RunLengthDecaySchedulerConfig, pose_optimizer

_MOST_RANDOM = 10_000_000  # Most random points to start from: they take the host's memory before the cap thins them out
_WIDEST_BLUR = 100  # Largest window of `energy_blur`, which makes kernels of thousands of pixels
_EVERY_VIEW = "ns-eval and steps_per_eval_all_images measure every held-out view"
_CACHED = "cache_images says where images and masks are kept"
_UNUSED = {
    "": {
        "prompt": "a capture is trained on its photos, not on a text",
        "relative_model_dir": "other commands look for checkpoints in nerfstudio_models",
    },
    "machine.": dict.fromkeys(("machine_rank", "dist_url"), "torchrun starts runs on several machines, and sets these"),
    "viewer.": {"num_rays_per_chunk": "Gaussians are drawn without rays"},
    "pipeline.datamanager.": {
        "train_cameras_sampling_seed": "machine.seed sets it",
        "fps_reset_every": "each view is taken once a round",
        "masks_on_gpu": _CACHED,
        "images_on_gpu": _CACHED,
        "eval_num_images_to_sample_from": _EVERY_VIEW,
        "eval_num_times_to_repeat_images": _EVERY_VIEW,
        "eval_image_indices": _EVERY_VIEW,
    },
}
"""nerfstudio's options that nothing reads in a run of ours, by what precedes their names, and why."""


def _class(module: str, name: str) -> type:
    """Import a class when options are made: its module imports this one."""
    return getattr(import_module(f"sadgs_ns.training.{module}"), name)


@dataclass
class PoseOptimizerConfig(CameraOptimizerConfig):
    """nerfstudio's options of learned poses in a `config.yml` of earlier versions; `poses` takes their place."""

    mode: Literal["off", "SO3xR3", "SE3"] = "off"
    """Whether and how the cameras' poses were refined."""


# What no measurement advises to change, and only the paper's presets or earlier runs do, would lengthen the help.
hide("min_observations", "split_min_opacity", "child_scale", "min_opacity", "absgs_long_axis")(StructureAwareStrategy)
hide("eta_every", "refine_start_iter", "reset_every")(StructureAwareStrategy)


@hide("random_scale", "initial_opacity", "averaged_share", "max_off_axis")
@dataclass
class SadgsModelConfig(InstantiateConfig):
    """Options of the Gaussians, their loss and their densification; most of splatfacto's have no place here."""

    _target: type = field(default_factory=lambda: _class("model", "SadgsModel"))
    strategy: StructureAwareStrategy = field(default_factory=StructureAwareStrategy)
    """When and how Gaussians are split, cloned and pruned."""
    poses: Literal["fixed", "refined"] = "fixed"
    """Whether the poses of the training cameras are refined together with the Gaussians, on one device.
    The motion that all have in common is taken out, so held-out cameras stay where they are."""
    backend: BackendName = "auto"
    """Which code draws: auto takes Triton kernels where they work, gsplat on other CUDA devices, and torch elsewhere.
    gsplat trains on one GPU, without CUDA graphs, and alone needs nvcc."""
    background_color: Literal["black", "white"] = "black"
    """Colour behind the Gaussians."""
    random_init: bool = False
    """Start from random points even where the data has SfM points."""
    num_random: int = 50000
    """Number of random points to start from, if there are no SfM points or `random_init` is set."""
    random_scale: float = 10.0
    """Side of the cube around the origin in which random points are drawn, in the run's units."""
    bounding_box_points: Hidden[bool] = True
    """Also start from points on the faces of the SfM points' bounding box, which become sky and far background."""
    starts_per_pixel: Hidden[float] = 0.02
    """Most points to start from for each pixel of all training images, which only small images reach.
    A hundredth of them may lie on the bounding box; 0 sets no limit, as in the paper."""
    stereo_points: int | None = None
    """Largest number of points that are drawn from stereo depth of the training photos and added to the start (CUDA).
    None is 150,000, or 0 with fewer than 3 training views or one SfM point for every 30 pixels of an image."""
    dropout: float | None = None
    """Probability with which a training step leaves a Gaussian out, in [0, 0.9], against overfitting of few views.
    None follows from how often each view is rendered: 0 up to 85 times, and 0.1 more for each doubling, up to 0.25.
    Above 40 training views it is the less, the more there are."""
    clear_paths: bool = True
    """Prune Gaussians that float near the cameras' paths, again and again; viewers of files would show them as haze."""
    initial_opacity: float = POINT_OPACITY
    """Opacity at which SfM points start, in (0, 1); random ones start at 0.1."""
    sh_degree: int = 3
    """Degree of the spherical harmonics that make colours depend on the direction of view, 0 to 3."""
    ssim_lambda: float = 0.6
    """Weight of SSIM against L1 in the loss, in [0, 1]. The paper's 0.2 resolves less detail for as many Gaussians."""
    opacity_reg: float = 0.01
    """Weight of the mean opacity in the loss while densification runs.
    Gaussians that no image needs fade until they are pruned. Larger leaves fewer; 0 is off, as in the paper."""
    averaged_share: float = 0.05
    """Share of the run, at its end, over which the Gaussians' parameters are averaged, in [0, 0.3].
    The finished run has the mean; with 0 it has the parameters of the last iteration."""
    max_off_axis: float = 0.0
    """Gaussians whose centre is projected farther than this from the image's centre, in half images, are not drawn.
    0 draws all, as other programs draw the exported file."""
    near_plane: Literal["viewers", "scene"] | float = "viewers"
    """Depth from which Gaussians are drawn, in training and later, in the run's units.
    "viewers" is 0.01, from which other programs draw the exported file, but at most the depth of "scene".
    "scene" is half the depth of a camera's fifth nearest SfM point, for the training camera where this is least."""
    max_angular_scale: float = 0.3
    """Longest standard deviation of a Gaussian as a share of its distance from the nearest training camera.
    A longer one that lies beside a view can cover it with haze; 0 sets no limit."""
    color_model: Literal["none", "affine"] = "none"
    """Whether a colour matrix of each training photo is learned; held-out views are rendered without one."""
    exposure: Literal["auto", "off"] = "off"
    """Whether photos are compared with renderings at their own exposure if exposure varies between them ("auto").
    Their gains come from the colours of common SfM points, or from EXIF. The splat has the median exposure."""
    color_corrected_metrics: Hidden[bool] = False
    """Also report metrics after fitting the colours of each rendering to its photo, as suits changing exposure."""

    def check(self) -> None:
        """Raise InputError if an option is out of its range."""
        near = self.near_plane
        is_near_plane = near in ("viewers", "scene", None)  # Runs of version 1.0.0 have None for "scene".
        if not is_near_plane:
            is_near_plane = not isinstance(near, str) and 0 < near < math.inf
        stereo = self.stereo_points
        off_axis = self.max_off_axis
        angle = self.max_angular_scale
        ranges = [
            ("ssim_lambda", 0 <= self.ssim_lambda <= 1, "in [0, 1]"),
            ("background_color", self.background_color in ("black", "white"), "black or white"),
            ("initial_opacity", 0 < self.initial_opacity < 1, "in (0, 1)"),
            ("opacity_reg", 0 <= self.opacity_reg <= 100, "in [0, 100]"),
            ("averaged_share", 0 <= self.averaged_share <= 0.3, "in [0, 0.3]"),
            ("max_off_axis", 0 <= off_axis < math.inf, "finite and not negative"),
            ("max_angular_scale", 0 <= angle < math.inf, "finite and not negative"),
            ("max_off_axis", off_axis == 0 or off_axis >= 1, "0, or at least 1, the image's border"),
            ("near_plane", is_near_plane, "viewers, scene, or positive and finite"),
            ("dropout", self.dropout is None or 0 <= self.dropout <= 0.9, "in [0, 0.9]"),
            ("sh_degree", 0 <= self.sh_degree <= 3, "in [0, 3]"),
            ("num_random", 1 <= self.num_random <= _MOST_RANDOM, f"in [1, {_MOST_RANDOM:,}]"),
            ("starts_per_pixel", 0 <= self.starts_per_pixel < math.inf, "finite and not negative"),
            ("stereo_points", stereo is None or 0 <= stereo <= _MOST_RANDOM, f"in [0, {_MOST_RANDOM:,}]"),
            ("random_scale", 0 < self.random_scale < math.inf, "positive and finite"),
        ]
        check_ranges("pipeline.model.", self, ranges)
        try:
            self.strategy.check()
        except ValueError as error:
            raise InputError(f"pipeline.model.{error}") from error


@hide("data", "train_cameras_sampling_seed")  # `--data` and `--machine.seed` set them.
@hide("masks_on_gpu", "images_on_gpu", "max_thread_workers", "train_cameras_sampling_strategy", "fps_reset_every")
@hide("eval_num_images_to_sample_from", "eval_num_times_to_repeat_images", "eval_image_indices")
@dataclass
class SadgsDatamanagerConfig(FullImageDatamanagerConfig):
    """nerfstudio's options, without those on the command line that its loader of whole images does not read."""

    _target: type = field(default_factory=lambda: _class("datamanager", "SadgsDatamanager"))
    dataparser: AnyParserConfig = field(default_factory=AutomaticDataParserConfig)
    """How the folder is read: by default with the parser that fits what it holds."""
    camera_res_scale_factor: float = 1.0
    """Factor by which images and cameras are scaled when they are loaded; 0.5 trains at half the resolution."""
    cache_images: Literal["gpu", "cpu", "compressed"] = "gpu"  # type: ignore[assignment]
    """Where the images are kept: "gpu" is the device of training, as long as that leaves enough of its memory free.
    Otherwise it is "cpu", decoded in the host's memory, or "compressed", files that are decoded ahead of their step."""
    cache_images_type: Hidden[Literal["uint8", "float32"]] = "uint8"
    """Images are kept as bytes, as they are in files; another type is refused."""


def check_options(config: FullImageDatamanagerConfig) -> None:
    """Raise InputError if an option of a datamanager, or of its parser of data, is out of its range."""
    parser: Any = config.dataparser
    ranges = [
        ("scale_factor", 0 < getattr(parser, "scale_factor", 1) < math.inf, "positive and finite"),
        ("train_split_fraction", 0 < getattr(parser, "train_split_fraction", 1) <= 1, "in (0, 1]"),
        ("eval_interval", getattr(parser, "eval_interval", 2) >= 2, "at least 2"),
    ]
    check_ranges("pipeline.datamanager.dataparser.", parser, ranges)
    sampling = config.train_cameras_sampling_strategy
    ranges = [
        ("cache_images_type", config.cache_images_type == "uint8", "uint8, which is what files of images hold"),
        ("train_cameras_sampling_strategy", sampling == "random", "random, which takes each view once a round"),
        ("camera_res_scale_factor", 0 < config.camera_res_scale_factor <= 1, "in (0, 1]"),
    ]
    check_ranges("pipeline.datamanager.", config, ranges)


@hide("epsilon", "energy_blur")
@dataclass
class SadgsPipelineConfig(VanillaPipelineConfig):
    """Options of the data, the model and the structure tensors of the images."""

    _target: type = field(default_factory=lambda: _class("pipeline", "SadgsPipeline"))
    datamanager: SadgsDatamanagerConfig = field(default_factory=SadgsDatamanagerConfig)
    """How images are loaded and drawn."""
    model: SadgsModelConfig = field(default_factory=SadgsModelConfig)
    """The Gaussians and their densification."""
    effort: float = 1.0
    """How much training the capture gets, relative to what its number of views asks for: a number up to 100.
    0.5 is a draft of half as many renderings. 2 renders up to twice as many, of more Gaussians if views are many."""
    views_per_iteration: int | None = None
    """Training views rendered for one optimizer step, at most as many as there are; the loss is their mean.
    None takes one more for every 2,000 renderings of the run, up to 4. The paper uses 1 outdoors, 2 indoors."""
    find_moved: bool = False
    """Whether to find what moved while the photos were taken, such as people and cars, and to leave it out.
    It is judged a few times by the run itself; the run's folder keeps `masks` of what was found."""
    memory_budget_gb: float | None = None
    """Memory of the GPU, in 10⁹ bytes, that training may take; the cap of Gaussians is lowered to it at the start.
    None is 80 % of the free memory. If `max_gaussians` was changed, None leaves it as it is."""
    frequency_constant: float = FREQUENCY_CONSTANT
    """c of the frequencies ω_l = c / σ_l, at most 4. A larger c makes every wavelength shorter, and more is split."""
    energy_blur: float = ENERGY_BLUR
    """Window, in multiples of σ_l, over which the energy of a scale is averaged; 0 measures it per pixel (eq. 4)."""
    epsilon: float | None = None
    """ε of the structure tensor (eq. 3 and 5), for images in [0, 1].
    None makes it relative to an image's contrast, so that the exposure of a photo does not decide what is split."""

    def check(self) -> None:
        """Raise InputError if an option is out of its range."""
        views = self.views_per_iteration
        epsilon = self.epsilon
        budget = self.memory_budget_gb
        ranges = [
            ("effort", 0 < self.effort <= MOST_EFFORT, f"in (0, {MOST_EFFORT}]"),
            ("views_per_iteration", views is None or views >= 1, "at least 1"),
            ("energy_blur", 0 <= self.energy_blur <= _WIDEST_BLUR, f"in [0, {_WIDEST_BLUR}]"),
            ("epsilon", epsilon is None or 0 < epsilon < math.inf, "positive and finite"),
            ("memory_budget_gb", budget is None or 0 < budget < math.inf, "positive and finite"),
            ("frequency_constant", 0 < self.frequency_constant <= HIGHEST_FREQUENCY, f"in (0, {HIGHEST_FREQUENCY:g}]"),
        ]
        check_ranges("pipeline.", self, ranges)
        check_options(self.datamanager)
        self.model.check()


def _default_device() -> Literal["cpu", "cuda"]:
    if torch.cuda.is_available():
        return "cuda"
    return "cpu"


@hide("num_machines", "machine_rank", "dist_url")
@dataclass
class SadgsMachineConfig(MachineConfig):
    """nerfstudio's options of the machine; those of several machines are not shown, since torchrun starts these."""

    seed: int = 42
    """Seed of everything that is drawn at random, the order of the training views too."""
    num_devices: int = 1
    """Number of CUDA devices of this machine to train on, among which the Gaussians are shared out.
    torchrun can start the processes instead, also on several machines; then this is 1."""
    device_type: Literal["cpu", "cuda"] = field(  # type: ignore[assignment]
        default_factory=_default_device
    )
    """Kind of device to train on; CUDA where there is one."""


@hide("websocket_port_default", "relative_log_filename", "num_rays_per_chunk", "make_share_url")
@hide("camera_frustum_scale", "default_composite_depth")
@dataclass
class SadgsViewerConfig(ViewerConfig):
    """nerfstudio's options of the viewer, which here listens on this machine only."""

    websocket_host: str = "127.0.0.1"
    """Address at which the viewer listens: this machine only; 0.0.0.0 opens it to the network."""


@hide("method_name", "prompt", "project_name", "relative_model_dir", "load_scheduler", "log_gradients")
@hide("mixed_precision", "use_grad_scaler", "gradient_accumulation_steps")  # The check below refuses them.
@hide("rates_follow_views")
@dataclass
class SadgsTrainerConfig(TrainerConfig):
    """Options of `ns-train sadgs`, checked before a run starts."""

    _target: type = field(default_factory=lambda: _class("trainer", "SadgsTrainer"))
    output_dir: Path = Path("outputs")
    """Folder in which each run gets a folder of its own."""
    experiment_name: str | None = None
    """Name of the run's folder; None takes that of the data."""
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
    """Whether rates of positions, opacities, scales and rotations, set for one view a step, change with more views."""
    cuda_graphs: bool = True
    """Whether the host launches steps of few Gaussians at once, as CUDA graphs, instead of kernel by kernel.
    Only where there is CUDA, and up to a million Gaussians, counted in each view (docs/results.md)."""
    share_always: bool = False
    """Share the Gaussians out over all devices, even if steps are so short that one device is quicker.
    Several devices then help only if one does not hold the Gaussians."""
    steps_per_save: int = 0
    """Steps between checkpoints; 0 leaves them to the clock. One is always made at the end."""
    seconds_per_save: float = 60.0
    """Seconds from one checkpoint to the next where steps_per_save is 0; 0 makes none before the end.
    The wait is at least 100 times as long as the last checkpoint took."""
    steps_per_eval_batch: Hidden[int] = 0
    """Steps between losses on a held-out view; 0 is never."""
    steps_per_eval_all_images: int = 0
    """Steps between metrics of all held-out views; 0 is never. `ns-eval` measures them after training."""
    data: Path | None = None
    """Folder of the data."""
    vis: Literal[  # type: ignore[assignment]
        "none", "viewer", "wandb", "tensorboard", "comet",
        "viewer+wandb", "viewer+tensorboard", "viewer+comet", "viewer_legacy",
    ] = "viewer"  # fmt: skip
    """Where the run can be watched. With a viewer the command waits at the end, until Ctrl+C."""
    load_dir: Path | None = None
    """Folder of a run, or of its checkpoints, from which the run goes on."""
    load_config: Path | None = None
    """The config.yml of a run whose options are taken, instead of all others; nerfstudio executes what it says."""
    logging: Hidden[LoggingConfig] = field(
        default_factory=lambda: LoggingConfig(
            local_writer=LocalWriterConfig(_target=ProgressTable, enable=True), profiler="none"
        )
    )
    """What is printed during training, and how often."""

    def __post_init__(self) -> None:
        """Raise InputError if `load_config` is no config.yml, or if options are given that nerfstudio then forgets."""
        if self.load_config is None:
            return
        problem = _problem_of_config_file(self.load_config)
        if problem:
            raise InputError(f"{self.load_config} cannot be used ({problem}): give --load-config the file of a run.")
        from nerfstudio.configs.method_configs import all_methods  # It imports this module.

        preset = all_methods.get(self.method_name or "", self)
        given = {name for name, value in vars(preset).items() if vars(self)[name] != value}
        ignored = sorted(given - {"load_config"})
        if ignored:
            raise InputError(
                f"With --load-config all options come from its file, and {', '.join(ignored)} would be ignored: leave "
                "these out, change them in the file, or give --load-dir with the run's folder instead."
            )

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take the values of a `config.yml` or a copy; options that an earlier version did not have get defaults."""
        vars(self).update(state)
        _replace_camera_optimizer(self)
        fill_missing(self)

    def print_to_terminal(self) -> None:
        """Print nothing. nerfstudio prints all options, which `config.yml` holds, before a run is known to start."""

    def check(self) -> None:
        """Raise InputError if training cannot work with these options, or if the device is not there."""
        length = self.max_num_iterations
        port = self.viewer.websocket_port
        accumulated = any(steps != 1 for steps in self.gradient_accumulation_steps.values())
        ranges = [
            ("max_num_iterations", length is None or length >= 1, "at least 1"),
            ("steps_per_save", self.steps_per_save >= 0, "at least 0"),
            ("steps_per_eval_batch", self.steps_per_eval_batch >= 0, "at least 0"),
            ("steps_per_eval_image", self.steps_per_eval_image >= 0, "at least 0"),
            ("steps_per_eval_all_images", self.steps_per_eval_all_images >= 0, "at least 0"),
            ("seconds_per_save", self.seconds_per_save >= 0, "at least 0"),
            ("mixed_precision", not self.mixed_precision, "False, since sadgs trains in float32"),
            ("use_grad_scaler", not self.use_grad_scaler, "False, since sadgs trains in float32"),
            ("log_gradients", not self.log_gradients, "False, since gradients are freed in each step"),
            ("load_step", self.load_step is None or self.load_dir is not None, "left out unless load_dir names a run"),
            ("gradient_accumulation_steps", not accumulated, "1: pipeline.views_per_iteration takes more views a step"),
        ]
        check_ranges("", self, ranges)
        check_ranges("logging.", self.logging, [("steps_per_log", self.logging.steps_per_log >= 1, "at least 1")])
        valid = port is None or 1 <= port <= 65535
        check_ranges("viewer.", self.viewer, [("websocket_port", valid, "in [1, 65535]")])
        parts = (self, self.machine, self.viewer, self.pipeline.datamanager)
        for part, (prefix, reasons) in zip(parts, _UNUSED.items(), strict=True):
            check_unused(prefix, part, reasons)
        self._check_machine()
        self._check_rates()
        self.pipeline.check()

    def _check_machine(self) -> None:
        """Raise InputError if a device is not there, or several cannot work with these options."""
        device = self.machine.device_type
        if device == "cuda" and not torch.cuda.is_available():
            raise InputError(
                "machine.device_type is cuda, but torch finds no CUDA device: set it to cpu, or install torch for CUDA."
            )
        model = self.pipeline.model
        several = processes.check_devices(self.machine)
        if model.backend != "auto":  # That is decided in the process that trains, where Triton tries a kernel.
            choose_backend(model.backend, torch.device(device), not several)
        if not several:
            return
        options_of_one_device = [
            ("pipeline.model.color_model", model.color_model != "none", "set it to none"),
            ("start_paused", self.start_paused, "leave it off, since the viewer is off, too"),
            (f"{SWITCH}=0", switched_off() and device == "cuda", "unset it"),
        ]
        for name, is_set, remedy in options_of_one_device:
            if is_set:
                raise InputError(f"{name} works on one device only, and this run takes several: {remedy}.")

    def _check_rates(self) -> None:
        """Raise InputError if a learning rate ever leaves [0, 1], or a factor is not positive."""
        for group, configs in self.optimizers.items():
            adam = configs["optimizer"]
            rate = adam.lr
            scheduler = configs.get("scheduler")
            ranges = [  # One launch updates all parameters.
                ("_target", issubclass(adam._target, FusedAdam), "sadgs's Adam"),
                ("max_norm", adam.max_norm is None, "left out"),
                ("weight_decay", not adam.weight_decay, "left out"),
                ("lr", 0 <= rate <= 1, "in [0, 1]"),
            ]
            check_ranges(f"optimizers.{group}.optimizer.", adam, ranges)
            if isinstance(scheduler, RunLengthDecaySchedulerConfig):
                factors = {name: getattr(scheduler, name) for name in ("initial_factor", "final_factor")}
                allowed = f"positive, and {rate:g} times it at most 1"
                ranges = [(name, value > 0 and rate * value <= 1, allowed) for name, value in factors.items()]
                check_ranges(f"optimizers.{group}.scheduler.", scheduler, ranges)

    def save_config(self) -> None:
        """Write `config.yml` if the run can begin; raises InputError as `check`, and as `run_folder.begin`."""
        self.check()
        begin(self)


def _replace_camera_optimizer(config: SadgsTrainerConfig) -> None:
    """Put `poses` in the place of nerfstudio's camera optimizer, which a `config.yml` of earlier versions has."""
    model = vars(config.pipeline).get("model")
    if model is not None:
        optimizer = vars(model).pop("camera_optimizer", None)
        if optimizer is not None and optimizer.mode != "off":
            model.poses = "refined"
    if "poses" not in config.optimizers:
        config.optimizers.pop("camera_opt", None)
        config.optimizers["poses"] = pose_optimizer()


def _problem_of_config_file(path: Path) -> str:
    """Say why a file cannot be the `config.yml` of a run; "" if it can be one."""
    try:
        with path.open(encoding="utf8") as file:
            first_line = file.readline()
    except (OSError, UnicodeDecodeError) as error:
        return reason(error)
    if not first_line.startswith("!!python/object:"):
        return "it is no config.yml of a run"
    return ""
