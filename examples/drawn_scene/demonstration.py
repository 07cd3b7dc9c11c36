"""Draw the demo scene, train on it with and without densification, and show what changed.

Leaves in the output folder: `scene/` (a COLMAP dataset), `side_by_side.png`, `wavelength_and_eta.png`, `splat.ply`, and
nerfstudio's own run folders under `runs/`.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.utils.rich_utils import CONSOLE
from PIL import Image, ImageDraw
from pytorch_msssim import ssim
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from torch import Tensor

from examples.drawn_scene.drawing import expected_wavelength_map
from examples.drawn_scene.scene import EVAL_INTERVAL, SPARSE_FOLDER, SceneDescription, write_scene
from sadgs_ns.atomic import atomic_path
from sadgs_ns.cli.export import write_gaussians
from sadgs_ns.cli.inspection import get_view
from sadgs_ns.method.strategy import StructureAwareStrategy
from sadgs_ns.plugin import color_scales, gaussian_maps, presets, texture
from sadgs_ns.plugin.color_scales import ETA, PERIOD, Panel
from sadgs_ns.plugin.model import SadgsModel
from sadgs_ns.plugin.pipeline import SadgsPipeline
from sadgs_ns.plugin.trainer import SadgsTrainer, SadgsTrainerConfig

PRESET = "sadgs"
ABSGS_THRESHOLD_FACTOR = 16.0
"""Factor on AbsGS's gradient thresholds. Gradients are normalised by the image's size and grow with a
Gaussian's share of it; the demo's few are tens of times wider, relative to the image, than those of a photograph. At
the preset's thresholds nearly all were split each time, and the cap was full before the first structure step."""
OPACITY_LR = 0.1
"""At the preset's 0.025, made for ten times as many iterations, few Gaussians would come from their initial opacity of
0.1 to the 0.3 from which η is observed before the first structure step."""
UNSPLIT, ABSGS = "unsplit start", "AbsGS alone"
ROWS = {UNSPLIT: (False, False), ABSGS: (True, False), PRESET: (True, True)}
"""The runs by label: whether they densify at all, and whether they split by structure."""


@dataclass
class Snapshot:
    """The Gaussians and their η just before the first structure step, if the run came that far."""

    params: dict[str, Tensor] = field(default_factory=dict)
    """Raw parameters by name, whose first dimension is N."""
    statistics: dict[str, Tensor] = field(default_factory=dict)
    """`eta_max`, the largest η seen per axis [N, 3], and `n_total`, the number of observations [N]."""


@dataclass
class Run:
    """A trained model and what it took."""

    label: str
    pipeline: SadgsPipeline
    seconds: float
    """Duration of the training loop."""
    renders: list[Tensor]
    """Renderings of the held-out views in [0, 1]. [H, W, 3] each"""
    targets: list[Tensor]
    """Images of the same views in [0, 1]. [H, W, 3] each"""
    before_split: Snapshot
    structure_growth: int
    """Number of Gaussians that the structure steps added, less those that they pruned."""

    @property
    def model(self) -> SadgsModel:
        """Return the trained Gaussians."""
        return self.pipeline.model

    def psnr(self) -> float:
        """Return the mean PSNR over the held-out views in dB."""
        errors = [(a - b).square().mean() for a, b in zip(self.renders, self.targets, strict=True)]
        return float(torch.stack([-10 * error.log10() for error in errors]).mean())

    def ssim(self) -> float:
        """Return the mean SSIM over the held-out views, with a window of 11×11 px."""
        first, second = (torch.stack(images).permute(0, 3, 1, 2) for images in (self.renders, self.targets))
        return float(ssim(first, second, data_range=1.0))


def fit_densification(strategy: StructureAwareStrategy, max_gaussians: int) -> None:
    """Fit densification to the demo, whose images are small and whose run is short.

    Args:
        strategy: Changed in place.
        max_gaussians: The demo's cap, which bounds the time of a step on a CPU.
    """
    strategy.clone_grad2d *= ABSGS_THRESHOLD_FACTOR
    strategy.split_absgrad2d *= ABSGS_THRESHOLD_FACTOR
    strategy.max_gaussians = max_gaussians


def run_config(
    scene: Path, output: Path, label: str, iterations: int, max_gaussians: int, densify: bool, split: bool = True
) -> SadgsTrainerConfig:
    """Return the preset as the demo uses it: its own data, few iterations, no viewer, no evaluation on the way.

    Args:
        scene: The dataset's folder.
        output: The demo's folder.
        label: Name of the run's folder.
        iterations: Length of the run.
        max_gaussians: Cap on the number of Gaussians.
        densify: Whether Gaussians are added or removed at all.
        split: Whether structure steps are among what does so.
    """
    config: SadgsTrainerConfig = copy.deepcopy(presets.sadgs.config)  # type: ignore[assignment]
    config.output_dir, config.experiment_name, config.timestamp = output / "runs", label, "latest"
    config.vis = "tensorboard"
    config.max_num_iterations = iterations
    config.steps_per_save = config.steps_per_eval_image = 0
    config.logging.local_writer.enable = False
    config.pipeline.datamanager.cache_images = "gpu"  # This is the training device; "cpu" pins memory, which needs CUDA
    config.pipeline.datamanager.dataparser = ColmapDataParserConfig(
        data=scene, colmap_path=SPARSE_FOLDER, downscale_factor=1, eval_mode="interval", eval_interval=EVAL_INTERVAL
    )
    strategy = config.pipeline.model.strategy
    fit_densification(strategy, max_gaussians)
    if not densify:
        strategy.refine_stop_iter = 0
    if not split:
        strategy.structure_every = 0
    config.optimizers["opacities"]["optimizer"].lr = OPACITY_LR
    return config


def train(config: SadgsTrainerConfig, label: str, on_step: Callable[[int, int], None]) -> Run:
    """Train through nerfstudio's trainer and render the held-out views.

    Args:
        config: What to train.
        label: How the run is called in tables and pictures.
        on_step: Called after each iteration with its number, from 1, and the number of Gaussians.
    """
    torch.manual_seed(config.machine.seed)
    np.random.seed(config.machine.seed)
    trainer: SadgsTrainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    pipeline, snapshot = trainer.pipeline, Snapshot()
    windows = pipeline.model.strategy.windows
    counts: list[int] = []  # Numbers of Gaussians before (negative) and after each structure step.

    def at_structure_step(step: int) -> bool:
        return (
            windows.structure_every > 0
            and step < windows.refine_stop_iter
            and (step + 1) % windows.structure_every == 0
        )

    def before_densification(step: int) -> None:
        if at_structure_step(step):
            counts.append(-pipeline.model.num_points)
        if step + 1 == windows.structure_every and "eta_max" in pipeline.model.strategy_state:
            snapshot.params = {name: value.detach().clone() for name, value in pipeline.model.gauss_params.items()}
            state = pipeline.model.strategy_state
            snapshot.statistics = {name: state[name].clone() for name in ("eta_max", "n_total")}

    def after_step(step: int) -> None:
        if at_structure_step(step):
            counts.append(pipeline.model.num_points)
        on_step(step + 1, pipeline.model.num_points)

    after = [TrainingCallbackLocation.AFTER_TRAIN_ITERATION]
    trainer.callbacks = [TrainingCallback(after, before_densification), *trainer.callbacks]
    trainer.callbacks.append(TrainingCallback(after, after_step))
    start = time.perf_counter()
    trainer.train()
    seconds = time.perf_counter() - start

    pipeline.eval()
    dataset, renders, targets = pipeline.datamanager.eval_dataset, [], []
    for index in range(len(dataset)):
        outputs = pipeline.model.get_outputs_for_camera(dataset.cameras[index : index + 1])
        renders.append(outputs["rgb"].cpu())
        targets.append(dataset.get_image_float32(index).cpu())
    return Run(label, pipeline, seconds, renders, targets, snapshot, sum(counts))


def draw_side_by_side(path: Path, runs: Sequence[Run]) -> None:
    """Draw a row for each held-out view: its image, then the rendering of each run."""
    labels = ["ground truth", *(run.label for run in runs)]
    rows = [
        torch.cat([target, *(run.renders[index] for run in runs)], dim=1)  # [H, columns · W, 3]
        for index, target in enumerate(runs[0].targets)
    ]
    pixels = (255 * torch.cat(rows).clamp(0, 1)).round().byte().numpy()
    width, enlarge, margin = runs[0].targets[0].shape[1], 2, 18
    pixels = pixels.repeat(enlarge, axis=0).repeat(enlarge, axis=1)
    picture = Image.new("RGB", (pixels.shape[1], pixels.shape[0] + margin), "white")
    picture.paste(Image.fromarray(pixels), (0, margin))
    for column, label in enumerate(labels):
        ImageDraw.Draw(picture).text((column * width * enlarge + 4, 3), label, fill="black")
    with atomic_path(path) as partial:
        picture.save(partial)


def draw_wavelength_and_eta(path: Path, scene: SceneDescription, run: Run, index: int = 0) -> None:
    """Draw a training view's image, the estimated and the true period of its texture, and η before the first split."""
    pipeline, before = run.pipeline, run.before_split
    view = get_view(pipeline, index)
    truth = expected_wavelength_map(scene.surfaces, next(v for v in scene.views if v.name == view.name))
    estimate = texture.texture_period(view.structure_tensor, pipeline.config.frequency_constant)
    panels = [
        Panel(f"training view {view.name}", color_scales.to_picture(view.photo)),
        Panel("wavelength, estimated", PERIOD(estimate), PERIOD),
        Panel("wavelength, true", PERIOD(torch.from_numpy(truth)), PERIOD),
    ]
    if before.params:
        eta = gaussian_maps.eta_map(before.params, before.statistics, *view.camera)
        panels.append(Panel("η before the first split", ETA(eta), ETA))
    color_scales.draw(path, panels)


def verdict(absgs: Run, sadgs: Run, max_gaussians: int) -> str:
    """Return what the table says about structure-aware splits, and what it cannot say."""
    if sadgs.structure_growth <= 0:
        return (
            f"Structure steps added no Gaussians within the cap of {max_gaussians}, so the difference above is the "
            "work of AbsGS, not of structure-aware splits."
        )
    gain, more = sadgs.psnr() - absgs.psnr(), sadgs.model.num_points / absgs.model.num_points - 1
    added = f"Structure steps added {sadgs.structure_growth} Gaussians, net of what they pruned. "
    if gain <= 0:
        result = f"They did not help here: {PRESET} is {-gain:.2f} dB below {ABSGS} with {more:+.0%} Gaussians. "
    else:
        result = f"{PRESET} is {gain:.2f} dB above {ABSGS} with {more:+.0%} Gaussians. "
        if more > 0.05:
            result += "Part of that may be the number of Gaussians rather than where they are. "
    return added + result + "One drawn scene and one seed: an illustration, not a measurement of the method."


def demonstrate(output: Path, iterations: int, max_gaussians: int, width: int, height: int, views: int) -> list[Run]:
    """Run the whole demo and return its runs, in the order of `ROWS`.

    Args:
        output: Folder for everything that is left.
        iterations: Of each run, at least 30.
        max_gaussians: Cap on the number of Gaussians.
        width, height, views: As for `write_scene`.

    Raises:
        ValueError: If a number is too small.
        FileExistsError: If `output`/scene holds something else.
    """
    if iterations < 30:
        raise ValueError(f"--max-num-iterations is {iterations}; give at least 30, or nothing is split")
    console = Console()
    scene = write_scene(output / "scene", width, height, views)
    console.print(
        f"Scene: {len(scene.views)} views of {width}×{height} px, {len(scene.points)} points, in {output}/scene"
    )
    runs: list[Run] = []
    columns = (TextColumn("{task.description:24s}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    CONSOLE.quiet, was_quiet = True, CONSOLE.quiet  # This is nerfstudio's console; the demo prints its own few lines.
    try:
        with Progress(*columns, TextColumn("{task.fields[count]} Gaussians"), console=console) as progress:
            for label, (densify, split) in ROWS.items():
                task = progress.add_task(label, total=iterations, count=len(scene.points))

                def on_step(iteration: int, count: int, task=task) -> None:
                    progress.update(task, completed=iteration, count=count)

                name = label.replace(" ", "-")
                config = run_config(output / "scene", output, name, iterations, max_gaussians, densify, split)
                runs.append(train(config, label, on_step))
    finally:
        CONSOLE.quiet = was_quiet
    draw_side_by_side(output / "side_by_side.png", runs)
    draw_wavelength_and_eta(output / "wavelength_and_eta.png", scene, runs[-1])
    write_gaussians(output / "splat.ply", dict(runs[-1].model.gauss_params.items()))
    table = Table("held-out views", "PSNR (dB)", "SSIM", "Gaussians", "seconds")
    for run in runs:
        label = f"{run.label} (same iterations, no densification)" if run.label == UNSPLIT else run.label
        table.add_row(label, f"{run.psnr():.2f}", f"{run.ssim():.4f}", f"{run.model.num_points}", f"{run.seconds:.0f}")
    console.print(table)
    console.print(verdict(runs[1], runs[-1], max_gaussians))
    for name in ("side_by_side.png", "wavelength_and_eta.png", "splat.ply"):
        console.print(f"{output / name}")
    return runs
