"""What `sadgs --measure` measures: held-out views as the run draws them, and as viewers draw the file."""

from __future__ import annotations

import dataclasses
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from sadgs_ns.cli.inspection import load_run
from sadgs_ns.errors import InputError
from sadgs_ns.events import progress
from sadgs_ns.gsplat_compat import NEAR_PLANE
from sadgs_ns.training.pipeline import SadgsPipeline

STAGE = "views"
_DIGITS = {"psnr": 2, "ssim": 4, "lpips": 4}


@torch.no_grad()
def measure(run: Path, data: Path) -> str:
    """Measure a run on its held-out views, and return a sentence. Raise InputError if it holds out none.

    Viewers have no near plane and draw what lies far off the axis, so the file is drawn without the run's limits.

    Args:
        run: The run's folder.
        data: The capture, which may have been moved since.
    """
    pipeline, _ = load_run(run, data=data)
    names = [path.name for path in pipeline.datamanager.eval_dataset.image_filenames]
    if not names:
        raise InputError("the run holds out no photo, so that there is nothing to measure: begin another --output.")
    model = pipeline.model
    of_run = _measure_views(pipeline, 0)
    plan = model.plan
    model.plan = dataclasses.replace(plan, near_plane=NEAR_PLANE, max_off_axis=0.0)
    of_file = _measure_views(pipeline, len(names))
    model.plan = plan
    return describe(names, of_run, of_file)


def _measure_views(pipeline: SadgsPipeline, done: int) -> list[dict[str, Any]]:
    """Return the measures of each held-out view, as the model draws it by its plan.

    `done` is how many views were measured before.
    """
    model = pipeline.model
    views = pipeline.datamanager.fixed_indices_eval_dataloader
    measures = []
    for index in range(len(views)):
        progress(STAGE, done + index, 2 * len(views))
        camera, batch = views[index]
        outputs = model.get_outputs_for_camera(camera)
        drawn = {"rgb": outputs["rgb"], "background": outputs["background"]}
        measured, _ = model.get_image_metrics_and_images(drawn, batch)
        measures.append(measured)
    return measures


def describe(names: Sequence[str], of_run: Sequence[dict[str, float]], of_file: Sequence[dict[str, float]]) -> str:
    """Return a sentence on the means over held-out views of run and file, and the worst view of the file.

    Args:
        names: The names of the V views.
        of_run: `psnr` in dB, `ssim` and perhaps `lpips` of each view, as the run draws it. V of them
        of_file: The same as viewers draw the file. V of them
    """
    worst = min(range(len(names)), key=lambda index: of_file[index]["psnr"])
    count = f"{len(names)} photos"
    if len(names) == 1:
        count = "1 photo"
    worst_psnr = of_file[worst]["psnr"]
    return (
        f"{count} held out: run {_means(of_run)}; file {_means(of_file)}; worst in the file {names[worst]}, "
        f"PSNR {worst_psnr:.2f}"
    )


def _means(measures: Sequence[dict[str, float]]) -> str:
    """Return the means of the measures that all views have."""
    parts = []
    for name, digits in _DIGITS.items():
        values = [measured[name] for measured in measures if name in measured]
        if len(values) == len(measures):
            parts.append(f"{name.upper()} {statistics.fmean(values):.{digits}f}")
    return ", ".join(parts)
