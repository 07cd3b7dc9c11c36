"""Places one capture with several seeds, adjusts each model by several losses, and measures what comes out.

Only a process for one capture imports this module (`benchmarks.cameras`).
"""

from __future__ import annotations

import copy
import dataclasses
import itertools
import shutil
import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pycolmap
import torch

from benchmarks import camera_measures, camera_truth
from benchmarks.cameras import VARIANTS, Job, Photos
from benchmarks.run import software
from sadgs_ns.placing import reconstruct
from sadgs_ns.placing.adjustment import adjust_robustly, filter_observations, robust_options
from sadgs_ns.placing.agreement import Observed, displacement
from sadgs_ns.placing.features import extract
from sadgs_ns.placing.plan import choose_matching


@dataclass(frozen=True)
class Placing:
    """A model before its last adjustment, and what stays in that."""

    model: pycolmap.Reconstruction
    fixed_cameras: Collection[int]
    fixed_frames: Collection[int]
    seconds: dict[str, float]  # Of the stages up to there

    def adjusted(self, variant: str) -> tuple[pycolmap.Reconstruction, float]:
        """Return an adjusted copy, and the seconds of that."""
        model = copy.deepcopy(self.model)
        begin = time.perf_counter()
        loss = VARIANTS[variant]
        if loss is not None and loss.filters_first:
            filter_observations(model)
        adjust_robustly(model, self.fixed_cameras, self.fixed_frames, options_of(variant))
        return model, time.perf_counter() - begin


def options_of(variant: str) -> pycolmap.BundleAdjustmentOptions:
    """Return the options of the last adjustment by a variant."""
    options = robust_options()
    loss = VARIANTS[variant]
    if loss is not None:
        options.ceres.loss_function_type = getattr(pycolmap.LossFunctionType, loss.name)
        options.ceres.loss_function_scale = loss.scale
        options.ceres.solver_options.function_tolerance = loss.tolerance
    return options


def about() -> dict[str, Any]:
    """Return what rows say of software and of the GPU, which matches features if there is one."""
    gpu = None
    if torch.cuda.is_available():
        gpu = torch.cuda.get_device_name()
    return {"gpu": gpu, "versions": {**software(), "pycolmap": pycolmap.__version__}}


def place(photos: Photos, seeds: Sequence[int], work: Path) -> list[Placing]:
    """Place the cameras of photos with each seed, by features and matches that all share."""
    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR)
    gpu = reconstruct.wake_gpu()
    matching = choose_matching("auto", len(photos.names), False)
    shared = work / "database.db"
    begin = time.perf_counter()
    extract(photos.folder, photos.groups, shared, photos.rigs)
    extracted = time.perf_counter()
    reconstruct.match(photos.names, shared, matching, gpu, photos.rigs, seeds[0])
    seconds = {"features": extracted - begin, "matches": time.perf_counter() - extracted}
    placings = []
    for seed in seeds:
        folder = work / f"seed-{seed}"
        folder.mkdir()
        database = folder / "database.db"
        shutil.copyfile(shared, database)
        with pycolmap.Database.open(database) as opened:
            opened.clear_two_view_geometries()
        # All pairs have matches, which are verified with this seed.
        reconstruct.match(photos.names, database, matching, gpu, photos.rigs, seed)
        placings.append(place_with_seed(photos, database, seed, seconds))
    return placings


def place_with_seed(photos: Photos, database: Path, seed: int, seconds: dict[str, float]) -> Placing:
    """Place cameras by verified matches, and return the model as it was before its last adjustment.

    Args:
        photos: The photos.
        database: COLMAP's database; the model is written beside it.
        seed: Seed of COLMAP's random samples.
        seconds: Those of the stages before.
    """
    tried: list[tuple[Placing, float, int]] = []  # Placings, seconds of their adjustments, observations after these
    copying = 0.0

    def keep_and_adjust(
        model: pycolmap.Reconstruction, fixed_cameras: Collection[int] = (), fixed_frames: Collection[int] = ()
    ) -> None:
        nonlocal copying
        begin = time.perf_counter()
        before = copy.deepcopy(model)
        copied = time.perf_counter()
        adjust_robustly(model, fixed_cameras, fixed_frames)
        adjusting = time.perf_counter() - copied
        copying += copied - begin
        placing = Placing(before, fixed_cameras, fixed_frames, seconds)
        tried.append((placing, adjusting, model.compute_num_observations()))

    begin = time.perf_counter()
    model = database.with_name("model")
    with patch.object(reconstruct, "adjust_robustly", keep_and_adjust):
        reconstruct.place_cameras(photos.folder, photos.names, database, model, None, photos.alike, seed)
    total = time.perf_counter() - begin
    observations = pycolmap.Reconstruction(model).compute_num_observations()
    # There are several adjustments if there was a second attempt or cameras were joined; the last of this model counts.
    chosen, adjusting, _ = [attempt for attempt in tried if attempt[2] == observations][-1]
    return dataclasses.replace(chosen, seconds={**seconds, "cameras": total - copying - adjusting})


def measure_capture(job: Job, photos: Photos, work: Path) -> dict[str, dict[str, Any]]:
    """Place a capture, and return what the rows of its variants hold."""
    placings = place(photos, job.seeds, work)
    left_out = errors_of_left_out(placings, job)
    measured = {}
    for variant in job.variants:
        adjusted = [placing.adjusted(variant) for placing in placings]
        models = [model for model, _ in adjusted]
        stages = []
        for placing, (_, seconds) in zip(placings, adjusted, strict=True):
            stages.append({**placing.seconds, "adjustment": seconds})
        measured[variant] = {
            "photos": len(photos.names),
            "registered": [model.num_reg_images() for model in models],
            "points": [model.num_points3D() for model in models],
            "observations": [model.compute_mean_observations_per_reg_image() for model in models],
            "pairs": compare_pairs(models, job.seeds),
            "left_out": left_out[variant],
            "seconds": [{stage: round(value, 3) for stage, value in seconds.items()} for seconds in stages],
        }
    return measured


def compare_pairs(models: Sequence[pycolmap.Reconstruction], seeds: Sequence[int]) -> list[dict[str, Any]]:
    """Return the displacement of points between the models of any two seeds."""
    observed = [Observed.of(model) for model in models]
    pairs = []
    for i, j in itertools.combinations(range(len(models)), 2):
        moved = displacement(observed[i], observed[j])
        pairs.append({"seeds": [seeds[i], seeds[j]], **dataclasses.asdict(moved)})
    return pairs


def errors_of_left_out(placings: Sequence[Placing], job: Job) -> dict[str, list[dict[str, float]]]:
    """Return the errors of observations that were left out, a dictionary for each seed of each variant.

    They are of observations whose points all variants kept.
    """
    found: dict[str, list[dict[str, float]]] = {variant: [] for variant in job.variants}
    for placing, seed in zip(placings, job.seeds, strict=True):
        without = dataclasses.replace(placing, model=copy.deepcopy(placing.model))
        left_out = camera_measures.leave_out(without.model, seed)
        errors = []
        for variant in job.variants:
            model, _ = without.adjusted(variant)
            errors.append(camera_measures.reprojection_errors(model, left_out))
        is_kept = np.isfinite(errors).all(axis=0)
        for variant, values in zip(job.variants, errors, strict=True):
            kept = values[is_kept]
            found[variant].append({"median": float(np.median(kept)), "mean": float(kept.mean()), "count": len(kept)})
    return found


def measure_truth(job: Job) -> dict[str, dict[str, Any]]:
    """Adjust drawn captures, and return what the rows of the variants hold: a number for each seed."""
    pycolmap.logging.minloglevel = int(pycolmap.logging.ERROR)
    measured = {}
    for variant in job.variants:
        centres = []
        rotations = []
        stages = []
        for seed in job.seeds:
            true, perturbed = camera_truth.draw(camera_truth.Truth(**job.truth), seed)  # type: ignore[arg-type]
            placing = Placing(perturbed, (), (), {})
            model, seconds = placing.adjusted(variant)
            errors = camera_truth.errors(model, true)
            centres.append(round(errors.centres, 6))
            rotations.append(round(errors.rotations, 6))
            stages.append({"adjustment": round(seconds, 3)})
        measured[variant] = {"truth": job.truth, "centres": centres, "rotations": rotations, "seconds": stages}
    return measured
