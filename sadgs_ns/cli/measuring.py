"""What `sadgs --measure` measures: held-out views as the run draws them, and as viewers draw its file."""

from __future__ import annotations

import os
import statistics
from collections.abc import MutableMapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from sadgs_ns.training.run.deferred_imports import import_nerfstudio

import_nerfstudio()  # It precedes what imports nerfstudio, and takes half the time.

from nerfstudio.cameras.cameras import Cameras  # noqa: E402

from sadgs_ns.cli.inspection import load_run  # noqa: E402
from sadgs_ns.cli.splat_file import Splat, draw, read_splat  # noqa: E402
from sadgs_ns.errors import InputError  # noqa: E402
from sadgs_ns.events import progress  # noqa: E402
from sadgs_ns.training.model import SadgsModel  # noqa: E402
from sadgs_ns.training.outputs import LazyOutputs  # noqa: E402
from sadgs_ns.training.pipeline import SadgsPipeline  # noqa: E402

STAGE = "views"
_DIGITS = {"psnr": 2, "ssim": 4, "lpips": 4}

Measures = dict[str, float]
"""`psnr` in dB and `ssim` of a view, and `lpips` if its weights could be loaded; with `gain_` before each name those
of a rendering at the photo's exposure, if training used gains."""


@torch.no_grad()
def measure(run: Path, data: Path, file: Path) -> list[str]:
    """Measure a run and its file on the held-out views as `ns-eval` does, and return sentences for the user.

    One view is decoded and drawn at a time.

    Args:
        run: The run's folder.
        data: The capture, which may have been moved since.
        file: A PLY of the run's Gaussians, in the frame of training.

    Raises:
        InputError: If the run holds out no view, or run, capture or file cannot be read.
    """
    pipeline, _ = load_run(run, data=data)
    names = _names_of_views(pipeline)
    if not names:
        raise InputError("the run holds out no view, so that there is nothing to measure: begin another --output.")
    model = pipeline.model
    splat = read_splat(file, model.device)
    pipeline.datamanager.config.cache_images = "compressed"  # type: ignore[assignment]
    views = pipeline.datamanager.fixed_indices_eval_dataloader
    of_run = []
    of_file = []
    for index in range(len(views)):
        progress(STAGE, index, len(views))
        camera, batch = views[index]
        of_run.append(_measure(model, model.get_outputs_for_camera(camera), batch))
        of_file.append(_measure(model, outputs_of_file(model, splat, camera), batch))
    return describe(names, of_run, of_file, file.name)


def _names_of_views(pipeline: SadgsPipeline) -> list[str]:
    """Return the names of the held-out views, from the folder that all images have in common."""
    manager = pipeline.datamanager
    held_out = manager.eval_dataset.image_filenames
    folders = [os.path.dirname(os.path.abspath(path)) for path in (*manager.train_dataset.image_filenames, *held_out)]
    common = os.path.commonpath(folders)
    return [os.path.relpath(path, common) for path in held_out]


def outputs_of_file(model: SadgsModel, splat: Splat, camera: Cameras) -> LazyOutputs:
    """Return what metrics need of a model's outputs, for a file drawn from a camera, shape [1], on its background."""
    drawn, alphas = draw(splat, model.pinhole(camera), model.config.backend)
    rgb = model.before_background(drawn, alphas, model.background).clamp(0, 1)[0]
    outputs = {"rgb": rgb, "accumulation": alphas[0], "background": model.background.expand_as(rgb)}
    return LazyOutputs(outputs, lambda: drawn[0])


def _measure(model: SadgsModel, outputs: MutableMapping[str, Tensor], batch: dict[str, Any]) -> Measures:
    """Compare a drawn view with its photo."""
    measures, _ = model.get_image_metrics_and_images(outputs, batch)
    return measures


def describe(names: Sequence[str], of_run: Sequence[Measures], of_file: Sequence[Measures], file: str) -> list[str]:
    """Return sentences on the means over held-out views of run and file, and on the file's view of least PSNR.

    Args:
        names: The names of the V views.
        of_run: The measures of each view as the run draws it. [V]
        of_file: The same as viewers draw the file. [V]
        file: The file's name.
    """
    sentences = [f"run: {_means(of_run)}", f"{file}: {_means(of_file)}"]
    if "gain_psnr" in of_run[0]:
        sentences.append(f"run, at each photo's exposure: {_means(of_run, 'gain_')}")
        sentences.append(f"{file}, at each photo's exposure: {_means(of_file, 'gain_')}")
    if "lpips" not in of_run[0]:
        sentences.append("LPIPS is left out, because its AlexNet weights could not be loaded")
    psnr, worst = min((measures["psnr"], name) for name, measures in zip(names, of_file, strict=True))
    if len(names) == 1:
        sentences.append(f"1 view was held out: {worst}")
    else:
        sentences.append(f"{len(names)} views were held out; worst in {file} is {worst}, PSNR {psnr:.2f}")
    return sentences


def _means(measures: Sequence[Measures], prefix: str = "") -> str:
    """Return the means of those measures that the views have, whose names begin with the prefix."""
    parts = []
    for name, digits in _DIGITS.items():
        if prefix + name in measures[0]:
            mean = statistics.fmean(of_view[prefix + name] for of_view in measures)
            parts.append(f"{name.upper()} {mean:.{digits}f}")
    return ", ".join(parts)
