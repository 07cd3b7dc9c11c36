"""Plan a run from its options, its data, the machine's memory and the checkpoint that it goes on from."""

from __future__ import annotations

from dataclasses import asdict, replace
from typing import Any

import torch
from nerfstudio.cameras.cameras import Cameras

from sadgs_ns.geometry.near_plane import scene_near_plane
from sadgs_ns.method.schedule import Schedule, growth_threshold, schedule
from sadgs_ns.render.rasterization import viewmats_from_camera_to_world
from sadgs_ns.training.config import SadgsPipelineConfig, SadgsTrainerConfig
from sadgs_ns.training.pipeline import SadgsPipeline
from sadgs_ns.training.run.memory_plan import fit_to_memory, training_size
from sadgs_ns.training.run.progress import cpu_notice, note, warn
from sadgs_ns.training.run.run_plan import RunPlan, plan_rates

DENSE_THRESHOLDS = 1.25
"""Factor on AbsGS's thresholds if a run starts from stereo depth, which adds Gaussians. The factor removes as many, and
SSIM was higher with it on all of four scenes (docs/results.md#dense-start)."""
LEAST_PIXELS = 1.5e6
"""Pixels of a step on each of several devices, below which one is quicker. With 1.9 and 3 million, two devices took
1/1.1 of the time of one (1/1.3 in one run), and with .7 million 2.3 times as long (docs/results.md#several-devices)."""
_CAP_OPTIONS = ("memory_budget_gb", "model.strategy.max_gaussians")


def decide_near_plane(pipeline: SadgsPipeline, before: RunPlan | None) -> float:
    """Return the depth from which Gaussians are drawn: the option's, the one of the plan `before`, or the scene's.

    Call this before images are undistorted, which changes the cameras' intrinsics and sizes.
    """
    model = pipeline.model
    if model.config.near_plane is not None:
        return model.config.near_plane
    if before is not None:
        return before.near_plane
    points = model.means.new_zeros((0, 3))
    if model.seed_points is not None:
        points = model.seed_points[0].to(model.means)
    cameras = pipeline.datamanager.train_dataset.cameras
    viewmats = viewmats_from_camera_to_world(cameras.camera_to_worlds)
    sizes = torch.cat([cameras.width, cameras.height], dim=-1)
    extent = float(model.strategy_state["scene_scale"])
    return scene_near_plane(points, viewmats, cameras.get_intrinsics_matrices(), sizes, extent)


def plan_length(config: SadgsTrainerConfig, views: int, before: RunPlan | None) -> Schedule:
    """Decide iterations and views a step: by options, by an equal effort's plan `before`, or by rule."""
    effort = config.pipeline.effort
    iterations = config.max_num_iterations
    in_step = config.pipeline.views_per_iteration
    if before is not None and before.requested.get("effort", effort) == effort:
        iterations = before.iterations if iterations is None else iterations
        in_step = before.views_per_iteration if in_step is None else in_step
    return schedule(views, effort=effort, iterations=iterations, views_per_iteration=in_step)


def one_device_is_quicker(cameras: Cameras, views: int, devices: int) -> bool:
    """Tell whether steps of this many views have too few pixels for several devices, and print it."""
    pixels = views * _pixels(cameras)
    if pixels >= LEAST_PIXELS * devices:
        return False
    note(
        f"Training on one device: a step draws {pixels / 1e6:.2f} megapixels, and {devices} devices are expected to be "
        f"quicker from {LEAST_PIXELS * devices / 1e6:.1f} on (docs/results.md). If one device does not hold the "
        "Gaussians, set --share-always True."
    )
    return True


def _pixels(cameras: Cameras) -> float:
    return float((cameras.height * cameras.width).double().mean())


def plan_run(
    config: SadgsTrainerConfig,
    pipeline: SadgsPipeline,
    length: Schedule,
    *,
    near_plane: float,
    dense: bool,
    before: RunPlan | None,
    done: int,
) -> RunPlan:
    """Decide what the options of a run leave open, and print what a user should know.

    The pipeline has the Gaussians from which this process starts, which is `dense` if stereo depth was added. `before`
    is the plan of the checkpoint's run, after `done` iterations. Raises InputError if the memory holds no Gaussians.
    """
    options = config.pipeline
    model = pipeline.model
    strategy = options.model.strategy
    cap = options.model.strategy.max_gaussians
    requested = {name: getattr(options, name) for name in ("effort", "views_per_iteration", "memory_budget_gb")}
    requested |= {f"model.strategy.{name}": value for name, value in asdict(strategy).items()}
    old = requested if before is None else requested | before.requested
    changed = [f"pipeline.{name} was {old[name]} and is {now}" for name, now in requested.items() if old[name] != now]
    if changed:
        warn(f"The checkpoint's run had other settings; this one goes on with its own: {', '.join(changed)}.")
    if strategy.refine_stop_iter != 0:
        cap = _cap_in_memory(options, pipeline, length.views_per_iteration)
        same = all(requested[name] == old[name] for name in _CAP_OPTIONS)
        if before is not None and same and cap > before.strategy.max_gaussians:
            cap = before.strategy.max_gaussians
            note(f"At most {cap:,} Gaussians, as in the checkpoint's run.")
    of_effort = growth_threshold(options.effort)
    of_start = DENSE_THRESHOLDS if dense else 1.0
    clone, split = (of_effort * t * of_start for t in (strategy.clone_grad2d, strategy.split_absgrad2d))
    planned = replace(strategy, max_gaussians=cap, clone_grad2d=clone, split_absgrad2d=split)
    planned = planned.fitted(length.iterations)
    windows = planned.windows
    if windows.refine_stop_iter < windows.structure_every and strategy.refine_stop_iter != 0:
        warn(
            f"{length.iterations} iterations are too few for a structure-aware split: densification ends at "
            f"{windows.refine_stop_iter}, the first split would come at {windows.structure_every}. "
            "Train longer or lower pipeline.model.strategy.structure-every."
        )
    _print_length(config, pipeline, length, done)
    extent = float(model.strategy_state["scene_scale"])
    groups = pipeline.get_param_groups()
    optimizers = {name: group for name, group in config.optimizers.items() if name in groups}
    return RunPlan(
        **vars(length),
        devices=model.world.num_ranks,
        images=pipeline.datamanager.config.cache_images,
        near_plane=near_plane,
        max_off_axis=options.model.max_off_axis,
        strategy=planned,
        rates=plan_rates(optimizers, length, extent, config.rates_follow_views),
        requested=requested,
    )


def _print_length(config: SadgsTrainerConfig, pipeline: SadgsPipeline, length: Schedule, done: int) -> None:
    """Print how long the run is, and what decided it."""
    cameras = pipeline.datamanager.train_dataset.cameras
    effort = config.pipeline.effort
    requested = config.pipeline.views_per_iteration
    views = len(cameras)
    in_step = length.views_per_iteration
    iterations = length.iterations
    steps_done = f", of which {done:,} are done" if done else ""
    times = round(iterations * in_step / views)
    note(
        f"{config.method_name} on {views:,} training views of {_pixels(cameras) / 1e6:.2g} megapixels: "
        f"{iterations:,} iterations of {in_step} view{'s' * (in_step > 1)}{steps_done}, so that each view is rendered "
        f"about {times:,} time{'s' * (times != 1)}."
    )
    if config.max_num_iterations is None:
        note(f"The number of views and --pipeline.effort {effort:g} decide this: 0.5 is a draft, and 2 resolves more.")
    if requested is not None and requested > in_step:
        told = f"pipeline.views_per_iteration is {requested}, but there are {views} training views"
        warn(f"{told}: all are taken each time.")
    if pipeline.device.type == "cpu":
        warn(cpu_notice(torch.get_num_threads()))


def _cap_in_memory(options: SadgsPipelineConfig, pipeline: SadgsPipeline, views: int) -> int:
    """Return the cap of Gaussians that the devices' memory allows, and print what decided it."""
    params: Any = pipeline.model.gauss_params
    world = pipeline.model.world
    cap = options.model.strategy.max_gaussians
    size = training_size(pipeline.datamanager, views, world.num_ranks)
    cap, line = fit_to_memory(cap, params, size, options.memory_budget_gb, world.num_ranks)
    note(line)
    return int(world.least(cap))
