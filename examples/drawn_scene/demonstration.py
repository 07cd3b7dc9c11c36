"""Train on the drawn scene with and without densification, and show what changed."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.utils.rich_utils import CONSOLE
from rich.console import Console
from rich.progress import Progress
from rich.table import Table
from torch import Tensor

from examples.drawn_scene.drawing import expected_wavelength_map
from examples.drawn_scene.scene import EVAL_INTERVAL, SPARSE_FOLDER, SceneDescription, write_scene
from sadgs_ns.cli.export import write_gaussians
from sadgs_ns.cli.inspection import get_view
from sadgs_ns.method.strategy import StructureAwareStrategy
from sadgs_ns.training import presets
from sadgs_ns.training.config import SadgsTrainerConfig
from sadgs_ns.training.pipeline import SadgsPipeline
from sadgs_ns.training.run.trainer import SadgsTrainer
from sadgs_ns.training.step.structure_cache import observe_training_views
from sadgs_ns.viewer import color_scales, maps
from sadgs_ns.viewer.color_scales import ETA, PERIOD, Panel, to_picture

ABSGS_THRESHOLD_FACTOR = 16.0
"""Factor on AbsGS's gradient thresholds. Gradients are normalised by the image's size and grow with a
Gaussian's share of it; the demo's few are tens of times wider, relative to the image, than those of a photograph. At
the preset's thresholds nearly all were split each time, and the cap was full before the first structure step."""
OPACITY_LR = 0.1
"""At the preset's 0.025, made for ten times as many iterations, few Gaussians would come from their initial opacity of
0.1 to the 0.3 from which η is observed before the first structure step."""
ROWS = {"no densification": (False, False), "AbsGS alone": (True, False), "sadgs": (True, True)}
"""The runs by label: whether they densify at all, and whether they split by structure."""


@dataclass
class Run:
    """A trained model and its renderings of the held-out views."""

    pipeline: SadgsPipeline
    seconds: float
    """Duration of the training loop."""
    renders: list[Tensor]
    """Colours in [0, 1]. [H, W, 3] each"""
    targets: list[Tensor]
    """Photos of the same views in [0, 1]. [H, W, 3] each"""

    def mean(self, metric: Callable[[Tensor, Tensor], Tensor]) -> float:
        """Mean over the held-out views of a metric of two images [1, 3, H, W]."""
        values = []
        for render, target in zip(self.renders, self.targets, strict=True):
            pair = torch.stack([render, target]).permute(0, 3, 1, 2)
            values.append(metric(pair[:1], pair[1:]))
        return float(torch.stack(values).mean())


def fit_densification(strategy: StructureAwareStrategy, max_gaussians: int) -> None:
    """Fit densification to the demo, whose images are small and whose run is short; the cap bounds a step's time."""
    strategy.clone_grad2d *= ABSGS_THRESHOLD_FACTOR
    strategy.split_absgrad2d *= ABSGS_THRESHOLD_FACTOR
    strategy.max_gaussians = max_gaussians


def run_config(output: Path, label: str, iterations: int, max_gaussians: int) -> SadgsTrainerConfig:
    """Return the preset `sadgs` with the demo's data and length, without a viewer or evaluation on the way.

    The label, one of `ROWS`, also names the run's folder in that of the demo.
    """
    config: SadgsTrainerConfig = copy.deepcopy(presets.sadgs.config)  # type: ignore[assignment]
    config.output_dir = output / "runs"
    config.experiment_name = label.replace(" ", "-")
    config.timestamp = "latest"
    config.vis = "tensorboard"
    config.logging.local_writer.enable = False
    config.max_num_iterations = iterations
    config.steps_per_save = 0
    config.steps_per_eval_image = 0
    config.pipeline.datamanager.cache_images = "gpu"  # This is the training device; "cpu" pins memory, which needs CUDA
    config.pipeline.datamanager.dataparser = ColmapDataParserConfig(
        data=output / "scene", colmap_path=SPARSE_FOLDER, downscale_factor=1, eval_interval=EVAL_INTERVAL
    )
    config.optimizers["opacities"]["optimizer"].lr = OPACITY_LR
    strategy = config.pipeline.model.strategy
    densify, split = ROWS[label]
    fit_densification(strategy, max_gaussians)
    if not densify:
        strategy.refine_stop_iter = 0
    if not split:
        strategy.structure_every = 0
    return config


def train(config: SadgsTrainerConfig, on_step: Callable[[int], None]) -> Run:
    """Train through nerfstudio's trainer, call `on_step` after each step, from 0, and render the held-out views."""
    torch.manual_seed(config.machine.seed)
    np.random.seed(config.machine.seed)
    trainer: SadgsTrainer = config.setup(local_rank=0, world_size=1)
    trainer.setup()
    location = [TrainingCallbackLocation.AFTER_TRAIN_ITERATION]
    trainer.callbacks.append(TrainingCallback(location, on_step))
    start = time.perf_counter()
    trainer.train()
    seconds = time.perf_counter() - start
    pipeline = trainer.pipeline
    pipeline.eval()
    run = Run(pipeline, seconds, [], [])
    dataset = pipeline.datamanager.eval_dataset
    for index in range(len(dataset)):
        camera = dataset.cameras[index : index + 1]
        rendered = pipeline.model.get_outputs_for_camera(camera)
        run.renders.append(rendered["rgb"].cpu())
        photo = dataset.get_image_float32(index)
        run.targets.append(photo.cpu())
    return run


def draw_wavelength_and_eta(path: Path, scene: SceneDescription, runs: dict[str, Run]) -> None:
    """Draw the photo of a training view, the estimated and the true period of its texture, and η after each run."""
    pipeline = runs["sadgs"].pipeline
    view = get_view(pipeline, 0)
    drawn_views = {drawn.name: drawn for drawn in scene.views}
    truth = expected_wavelength_map(scene.surfaces, drawn_views[view.name])
    estimate = maps.texture_period(view.structure_tensor, pipeline.config.frequency_constant)
    panels = [
        Panel(f"training view {view.name}", to_picture(view.photo)),
        Panel("wavelength, estimated", PERIOD(estimate), PERIOD),
        Panel("wavelength, true", PERIOD(torch.from_numpy(truth)), PERIOD),
    ]
    for label, run in runs.items():
        params = dict(run.pipeline.model.gauss_params.items())
        statistics = observe_training_views(run.pipeline.structure_cache)
        eta = maps.eta_map(params, statistics, view.camera)
        panels.append(Panel(f"η, {label}", ETA(eta), ETA))
    color_scales.draw(path, panels, columns=3)


def table_of(runs: dict[str, Run]) -> Table:
    """Return the runs' metrics on the held-out views, a row each."""
    table = Table("held-out views", "PSNR (dB)", "SSIM", "Gaussians", "seconds")
    for label, run in runs.items():
        model = run.pipeline.model
        psnr = run.mean(model.psnr)
        ssim = run.mean(model.ssim)
        table.add_row(label, f"{psnr:.2f}", f"{ssim:.4f}", f"{model.num_points}", f"{run.seconds:.0f}")
    return table


def draw_side_by_side(path: Path, runs: dict[str, Run]) -> None:
    """Draw a row for each held-out view: its photo, and what each run shows there."""
    panels = []
    for index, photo in enumerate(runs["sadgs"].targets):
        picture = to_picture(photo)
        panels.append(Panel("photo", picture))
        for label, run in runs.items():
            picture = to_picture(run.renders[index])
            panels.append(Panel(label, picture))
    color_scales.draw(path, panels, columns=1 + len(runs))


def demonstrate(output: Path, iterations: int, max_gaussians: int, width: int, height: int, views: int) -> None:
    """Draw the scene, train each of `ROWS` on it, and write pictures and a PLY file to a folder.

    Each run has at least 30 iterations; the other numbers, and what is raised, are those of `write_scene`.
    """
    if iterations < 30:
        raise ValueError(f"--max-num-iterations is {iterations}; give at least 30, or nothing is split")
    console = Console()
    scene = write_scene(output / "scene", width, height, views)
    console.print(f"Scene: {views} views of {width}×{height} px, {len(scene.points)} points, in {output}/scene")
    was_quiet = CONSOLE.quiet
    CONSOLE.quiet = True  # This is nerfstudio's console; the demo prints its own few lines.
    runs = {}
    try:
        with Progress(console=console) as progress:
            for label in ROWS:
                task = progress.add_task(f"{label:16s}", total=iterations)
                config = run_config(output, label, iterations, max_gaussians)
                runs[label] = train(config, lambda step, task=task: progress.update(task, completed=step + 1))
    finally:
        CONSOLE.quiet = was_quiet
    console.print(table_of(runs))
    console.print("One drawn scene and one seed: an illustration, not a measurement of the method.")
    draw_side_by_side(output / "side_by_side.png", runs)
    draw_wavelength_and_eta(output / "wavelength_and_eta.png", scene, runs)
    model = runs["sadgs"].pipeline.model
    gaussians = dict(model.gauss_params.items())
    write_gaussians(output / "splat.ply", gaussians)
    for name in ("side_by_side.png", "wavelength_and_eta.png", "splat.ply"):
        console.print(f"{output / name}")
