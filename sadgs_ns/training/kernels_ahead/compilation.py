"""Compiles what a run needs of Triton's kernels before training starts."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import torch

from sadgs_ns.errors import reason
from sadgs_ns.gsplat_compat import NEAR_PLANE
from sadgs_ns.kernels import use_triton
from sadgs_ns.training.kernels_ahead import compile_ahead
from sadgs_ns.training.kernels_ahead.probes import KernelChoice, Stages
from sadgs_ns.training.pipeline import SadgsPipeline
from sadgs_ns.training.run.progress import note, warn
from sadgs_ns.training.step.optimizers import RowAdam

_PATIENCE = 2.0  # Seconds after which the user is told what the run is waiting for


def choose_kernels(pipeline: SadgsPipeline, optimizers: Mapping[str, torch.optim.Optimizer]) -> KernelChoice:
    """Return the properties of a run by which its kernels are chosen."""
    model = pipeline.model
    cameras = pipeline.datamanager.train_dataset.cameras
    launches: dict[Any, list[tuple[int, ...]]] = {}  # Shapes of the parameters that `AdamUpdate` updates together
    for name, optimizer in optimizers.items():
        value = model.trained_params.get(name)
        if value is not None and value.numel() and not isinstance(optimizer, RowAdam):
            is_of_gaussians = name in model.gauss_params
            key = (is_of_gaussians, optimizer.defaults["betas"], optimizer.defaults["eps"])
            launches.setdefault(key, []).append(tuple(value.shape[1:]))
    return KernelChoice(
        device=pipeline.device,
        views=model.plan.views_per_iteration,
        sh_degree=model.config.sh_degree,
        is_black=model.config.background_color == "black",
        has_color_matrices=model.color_matrices is not None,
        has_gains=model.exposure is not None,
        moves_cameras=model.poses is not None,
        single_process=model.world.is_single,
        size=(int(cameras.width.max()), int(cameras.height.max())),
        # The run's own near plane may lie behind these Gaussians, which would launch no compositing.
        drawing=replace(model.drawing, near_plane=NEAR_PLANE, backend=model.backend),
        updates=tuple(map(tuple, launches.values())),
        structure_tensor=pipeline.structure_cache.of_images,
    )


def compile_kernels(pipeline: SadgsPipeline, optimizers: Mapping[str, torch.optim.Optimizer]) -> None:
    """Launch the kernels of training once, on a few Gaussians, when `compile_ahead` is done.

    Triton keeps kernels on the disk, so only a machine's first run takes seconds here. The run's state, random numbers
    included, does not change. If kernels fail, a warning names them, and the run goes on: it may never need them.
    """
    if not use_triton(pipeline.device):
        return
    failures: dict[str, Exception] = {}

    def launch(named_stages: Mapping[str, Callable[[], None]]) -> bool:
        """Launch each stage, keep its error, and return whether there was none."""
        for name, stage in named_stages.items():
            try:
                stage()
            except Exception as error:
                failures[name] = error
        return failures.keys().isdisjoint(named_stages)

    notice = threading.Timer(_PATIENCE, note, ["Compiling kernels for this GPU, once …"])
    notice.start()
    try:
        compile_ahead.wait()
        stages = Stages(choose_kernels(pipeline, optimizers))
        launch(stages.without_projection())
        if launch({"rasterization": stages.project}):
            launch(stages.after_projection())
    finally:
        notice.cancel()
    if failures:
        cause = reason(next(iter(failures.values())))
        problem = f"The kernels of {', '.join(failures)} could not be compiled and tried before training ({cause})"
        warn(f"{problem}: training tries them again, and stops with an error of its own if it cannot do without them.")
