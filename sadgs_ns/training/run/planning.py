"""Plan a run from its options, its data, the machine's memory and the checkpoint that it goes on from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import Any

import torch
from nerfstudio.cameras.cameras import Cameras

from sadgs_ns.data.cameras import mean_pixels
from sadgs_ns.geometry.near_plane import scene_near_plane
from sadgs_ns.gsplat_compat import NEAR_PLANE
from sadgs_ns.method.schedule import Schedule, dropout, growth_threshold, schedule
from sadgs_ns.method.strategy import StructureAwareStrategy
from sadgs_ns.render.rasterization import viewmats_from_camera_to_world
from sadgs_ns.training.config import SadgsModelConfig, SadgsTrainerConfig
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
_OPTIMIZERS = "optimizers."  # With this begin the names of options of learning rates.
_CAP_OPTIONS = ("memory_budget_gb", "model.strategy.max_gaussians")
_THRESHOLD_OPTIONS = ("effort", "model.strategy.clone_grad2d", "model.strategy.split_absgrad2d")


def decide_near_plane(config: SadgsModelConfig, of_scene: float | None, before: RunPlan | None) -> float:
    """Return the depth from which Gaussians are drawn.

    Args:
        config: The model's options. In runs of version 1.0.0 None stood for "scene".
        of_scene: What `near_plane_of_scene` returned. It is not needed with `before`.
        before: Plan of the checkpoint's run. Its depth is kept unless the option is a number.
    """
    option = config.near_plane
    if option is not None and not isinstance(option, str):
        return option
    if before is not None:
        return before.near_plane
    assert of_scene is not None
    if option == "viewers":
        return min(NEAR_PLANE, of_scene)
    return of_scene


def near_plane_of_scene(pipeline: SadgsPipeline) -> float:
    """Return how near anything comes to the training cameras, by `scene_near_plane`.

    Call this before images are undistorted, which changes the cameras' intrinsics and sizes.
    """
    model = pipeline.model
    points = model.means.new_zeros((0, 3))
    if model.seed_points is not None:
        points = model.seed_points[0].to(model.means)
    cameras = pipeline.datamanager.train_dataset.cameras
    viewmats = viewmats_from_camera_to_world(cameras.camera_to_worlds)
    sizes = torch.cat([cameras.width, cameras.height], dim=-1)
    extent = float(model.strategy_state["scene_scale"])
    return scene_near_plane(points, viewmats, cameras.get_intrinsics_matrices(), sizes, extent)


def plan_length(config: SadgsTrainerConfig, views: int, before: RunPlan | None) -> Schedule:
    """Decide iterations and views a step for a number of training views.

    Options decide, or else the plan `before` of the checkpoint's run if its effort was the same, or else rules.
    """
    effort = config.pipeline.effort
    iterations = config.max_num_iterations
    views_per_iteration = config.pipeline.views_per_iteration
    if before is not None and before.requested.get("effort", effort) == effort:
        if iterations is None:
            iterations = before.iterations
        if views_per_iteration is None:
            views_per_iteration = before.views_per_iteration
    return schedule(views, effort=effort, iterations=iterations, views_per_iteration=views_per_iteration)


def one_device_is_quicker(cameras: Cameras, views: int, devices: int) -> bool:
    """Tell whether steps of this many views have too few pixels for several devices, and print it."""
    pixels = views * mean_pixels(cameras)
    needed = LEAST_PIXELS * devices
    if pixels >= needed:
        return False
    note(
        f"Training on one device: a step draws {pixels / 1e6:.2f} megapixels, and {devices} devices are expected to be "
        f"quicker from {needed / 1e6:.1f} on (docs/results.md). If one device does not hold the "
        "Gaussians, set --share-always True."
    )
    return True


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
    requested = _requested_options(config)
    _warn_of_other_settings(requested, before)
    views = len(pipeline.datamanager.train_dataset)
    strategy = _plan_strategy(pipeline, length, requested, dense, before)
    _print_length(config, pipeline, length, done)
    extent = float(pipeline.model.strategy_state["scene_scale"])
    groups = pipeline.get_param_groups()
    optimizers = {name: group for name, group in config.optimizers.items() if name in groups}
    return RunPlan(
        **vars(length),
        devices=pipeline.model.world.num_ranks,
        images=pipeline.datamanager.config.cache_images,
        near_plane=near_plane,
        max_off_axis=config.pipeline.model.max_off_axis,
        dropout=plan_dropout(config.pipeline.model.dropout, length, views, before),
        strategy=strategy,
        rates=plan_rates(optimizers, length, extent, config.rates_follow_views),
        requested=requested,
    )


def plan_dropout(option: float | None, length: Schedule, views: int, before: RunPlan | None) -> float:
    """Decide the probability with which a step leaves a Gaussian out.

    It is the option, or else that of the plan `before` of the checkpoint's run, or else the rule's.
    """
    if option is not None:
        return option
    if before is not None:
        return before.dropout
    return dropout(length, views)


def _requested_options(config: SadgsTrainerConfig) -> dict[str, Any]:
    """Return the options from which a plan is derived, by their names, those of the pipeline without `pipeline.`."""
    options = config.pipeline
    requested: dict[str, Any] = {
        "effort": options.effort,
        "views_per_iteration": options.views_per_iteration,
        "memory_budget_gb": options.memory_budget_gb,
    }
    for name, value in asdict(options.model.strategy).items():
        requested[f"model.strategy.{name}"] = value
    for name, group in config.optimizers.items():
        requested[f"{_OPTIMIZERS}{name}.optimizer.lr"] = group["optimizer"].lr
    return requested


def _warn_of_other_settings(requested: Mapping[str, Any], before: RunPlan | None) -> None:
    """Print which options had other values in the checkpoint's run."""
    if before is None:
        return
    changed = []
    for name, value in requested.items():
        value_before = before.requested.get(name, value)  # An earlier version may not have had the option.
        if value_before != value:
            option = f"pipeline.{name}"
            if name.startswith(_OPTIMIZERS):
                option = name
            changed.append(f"{option} was {value_before} and is {value}")
    if changed:
        warn(f"The checkpoint's run had other settings; this one goes on with its own: {', '.join(changed)}.")


def _plan_strategy(
    pipeline: SadgsPipeline, length: Schedule, requested: Mapping[str, Any], dense: bool, before: RunPlan | None
) -> StructureAwareStrategy:
    """Return the strategy's options with a cap that the memory holds, the run's thresholds and its windows."""
    options = pipeline.config
    strategy = options.model.strategy
    densifies = strategy.refine_stop_iter != 0
    cap = strategy.max_gaussians
    if densifies:
        cap = _cap_in_memory(pipeline, length.views_per_iteration)
        if (
            before is not None
            and cap > before.strategy.max_gaussians
            and _are_as_before(_CAP_OPTIONS, requested, before)
        ):
            cap = before.strategy.max_gaussians
            note(f"At most {cap:,} Gaussians, as in the checkpoint's run.")
    num_gaussians = pipeline.model.num_gaussians
    if before is not None and num_gaussians > cap:
        warn(f"The checkpoint has {num_gaussians:,} Gaussians, more than the {cap:,} allowed: none is taken away.")
    factor = growth_threshold(options.effort, len(pipeline.datamanager.train_dataset))
    if dense:
        factor *= DENSE_THRESHOLDS
    clone_grad2d = factor * strategy.clone_grad2d
    split_absgrad2d = factor * strategy.split_absgrad2d
    if before is not None and _are_as_before(_THRESHOLD_OPTIONS, requested, before):
        clone_grad2d = before.strategy.clone_grad2d
        split_absgrad2d = before.strategy.split_absgrad2d
    planned = replace(strategy, max_gaussians=cap, clone_grad2d=clone_grad2d, split_absgrad2d=split_absgrad2d).fitted(
        length.iterations
    )
    windows = planned.windows
    if densifies and windows.refine_stop_iter < windows.structure_every:
        warn(
            f"{length.iterations} iterations are too few for a structure-aware split: densification ends at "
            f"{windows.refine_stop_iter}, the first split would come at {windows.structure_every}. "
            "Train longer or lower pipeline.model.strategy.structure-every."
        )
    return planned


def _cap_in_memory(pipeline: SadgsPipeline, views: int) -> int:
    """Return the cap of Gaussians that the devices' memory allows in steps of so many views; print what decided it."""
    params: Any = pipeline.model.gauss_params
    world = pipeline.model.world
    requested = pipeline.config.model.strategy.max_gaussians
    has_color_maps = pipeline.model.exposure is not None
    size = training_size(pipeline.datamanager, views, world.num_ranks, has_color_maps)
    cap, sentence = fit_to_memory(requested, params, size, pipeline.config.memory_budget_gb, world.num_ranks)
    note(sentence)
    return int(world.least(cap))


def _are_as_before(names: Sequence[str], requested: Mapping[str, Any], before: RunPlan) -> bool:
    """Tell whether options that decide something have the values of the checkpoint's run."""
    return all(before.requested.get(name, requested[name]) == requested[name] for name in names)


def _print_length(config: SadgsTrainerConfig, pipeline: SadgsPipeline, length: Schedule, done: int) -> None:
    """Print how long the run is, and what decided it."""
    cameras = pipeline.datamanager.train_dataset.cameras
    views = len(cameras)
    in_step = length.views_per_iteration
    steps = f"{length.iterations:,} iterations of {in_step} {_plural('view', in_step)}"
    if done:
        steps += f", of which {done:,} are done"
    times = round(length.iterations * in_step / views)
    note(
        f"{config.method_name} on {views:,} training views of {mean_pixels(cameras) / 1e6:.2g} megapixels: "
        f"{steps}, so that each view is rendered about {times:,} {_plural('time', times)}."
    )
    if config.max_num_iterations is None:
        note(
            f"The number of views and --pipeline.effort {config.pipeline.effort:g} decide this: 0.5 is a draft, and 2 "
            "resolves more."
        )
    requested = config.pipeline.views_per_iteration
    if requested is not None and requested > in_step:
        warn(
            f"pipeline.views_per_iteration is {requested}, but there are {views} training views: all are taken each "
            "time."
        )
    if pipeline.device.type == "cpu":
        warn(cpu_notice(torch.get_num_threads()))


def _plural(noun: str, number: int) -> str:
    """Return a noun as it stands after a number."""
    if number == 1:
        return noun
    return f"{noun}s"
