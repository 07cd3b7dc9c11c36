"""Gains of the training photos, if their exposures differ: found before a run begins, and kept when it is resumed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from sadgs_ns.data.exif_exposure import exposures_of
from sadgs_ns.data.run_frame import POINTS_FILE
from sadgs_ns.data.tracks import points_seen
from sadgs_ns.distributed.world import World
from sadgs_ns.geometry.exposure import (
    FEWEST_POINTS,
    Exposures,
    Ints,
    Observations,
    fit_exposures,
    gains_of_others,
    mean_gains,
    points_at_median,
)
from sadgs_ns.training.exposure_table import ExposureTable
from sadgs_ns.training.photo_names import photo_names, same_photos
from sadgs_ns.training.pipeline import SadgsPipeline
from sadgs_ns.training.run.progress import note, warn

LEAST_DEVIATION = 0.1
"""Standard deviation of the gains, in stops of linear light, from which they are used."""
LEAST_REDUCTION = 0.2
"""Share by which gains must reduce the median residual of points' colours to be used. Where exposure is fixed, what
looks like gains reduces it less: by 6 and 7 % on two captures."""
_DISAGREEMENT = 0.5  # Stops by which the ranges of EXIF's exposures and of the gains may differ without a line


@dataclass(frozen=True)
class _Found:
    """Gains that were found, and whether to use them."""

    stops: Tensor  # float64 [V, 3]
    points: Tensor  # float32 [P, 3]
    observations: Observations | None  # Of the points, if these told the gains
    used: bool
    sentence: str  # For the user


def start_with_gains(pipeline: SadgsPipeline, world: World) -> None:
    """Find the gains of the training photos, let the model use them if exposure varies, and print a line about it.

    All processes have the gains of the first. It loads the images. Call it before points of stereo depth are added.
    Raises InputError if the points' file is damaged.
    """
    model = pipeline.model
    if not model.may_use_gains:
        if model.config.exposure == "auto":
            note("Gains of exposure are off, because a colour matrix is learned for each photo.")
        return
    found = _find(pipeline)
    _use(pipeline, world, found)
    if model.exposure is None or found is None or found.observations is None:
        return
    shown_in, shown = _photos_of_points(pipeline, found.observations)
    means = mean_gains(shown_in, shown, model.exposure.stops.numpy(), len(found.points))
    model.color_points(torch.from_numpy(means).float())


def resume_with_gains(pipeline: SadgsPipeline, world: World) -> None:
    """Keep the gains of a checkpoint that was loaded, and find those of photos that were added since.

    The gains of the others do not change, and so neither does the median. If none of the photos is known, all gains are
    found anew. Without gains in the checkpoint, or if the options ask for none, the run goes on without, and a line
    says so.
    """
    model = pipeline.model
    before = model.exposure
    if before is None:
        if model.may_use_gains:
            note("Gains of exposure: the checkpoint has none, and so has this run.")
        return
    if not model.may_use_gains:
        note("Gains of exposure: this run's options allow none, so those of the checkpoint are dropped.")
        model.set_exposure(None)
        return
    dataset = pipeline.datamanager.train_dataset
    names = photo_names(dataset.image_filenames)
    if names == before.names:
        return
    stops = torch.zeros((len(names), 3), dtype=torch.float64)
    kept = np.zeros(len(names), bool)
    for view, row in enumerate(same_photos(before.names, names)):
        if row is not None:
            stops[view] = before.stops[row]
            kept[view] = True
    if not kept.any():
        note("Gains of exposure are found anew, because no photo has the name of one that the checkpoint knows.")
        model.set_exposure(None)
        _use(pipeline, world, _find(pipeline))
        return
    points = before.points
    point_observations = pipeline.point_observations("train")
    if point_observations is not None:
        observations = point_observations.of_all(pipeline.datamanager.cached_train)
        num_points = len(point_observations.points)
        light = points_at_median(observations.of_views(kept), stops.numpy(), num_points)
        others, _ = gains_of_others(observations, light, len(names))
        stops = torch.where(torch.from_numpy(kept)[:, None], stops, torch.from_numpy(others))
        points = torch.from_numpy(light).float()
    stops = stops.to(world.device)
    points = points.to(world.device)
    world.broadcast(stops, 0)
    world.broadcast(points, 0)
    model.set_exposure(ExposureTable(names, stops.cpu(), points.cpu()))
    note(f"Gains of exposure: {int(kept.sum())} photos keep theirs, {int((~kept).sum())} were added.")


def _use(pipeline: SadgsPipeline, world: World, found: _Found | None) -> None:
    """Let the model use gains that were found, if exposure varies, and print a line about it."""
    if found is None:
        note("Gains of exposure are off: neither points nor EXIF tell how the photos were exposed.")
        return
    used = torch.tensor([float(found.used)], device=world.device)
    world.broadcast(used, 0)
    note(found.sentence)
    if not used.item():
        return
    stops = found.stops.to(world.device)
    points = found.points.to(world.device)
    world.broadcast(stops, 0)
    world.broadcast(points, 0)
    names = photo_names(pipeline.datamanager.train_dataset.image_filenames)
    pipeline.model.set_exposure(ExposureTable(names, stops.cpu(), points.cpu()))


def _find(pipeline: SadgsPipeline) -> _Found | None:
    """Find gains by the points, or by EXIF if the points tell none; None if EXIF tells none, either."""
    files = pipeline.datamanager.train_dataset.image_filenames
    exif_stops = exposures_of(files)
    point_observations = pipeline.point_observations("train")
    if point_observations is not None:
        observations = point_observations.of_all(pipeline.datamanager.cached_train)
        fitted = fit_exposures(observations, len(files), len(point_observations.points))
        if fitted.known.any():
            if exif_stops is not None:
                _warn_of_disagreement(fitted, exif_stops)
            return _by_points(fitted, observations)
    if exif_stops is None:
        return None
    stops = np.array(exif_stops) - np.median(exif_stops)
    deviation = float(stops.std())
    used = deviation >= LEAST_DEVIATION
    sentence = _sentence(deviation, float(np.ptp(stops)), "by EXIF", used)
    stops_of_channels = torch.from_numpy(stops)[:, None].repeat(1, 3)  # [V, 3]
    no_points = torch.zeros((0, 3))
    return _Found(stops_of_channels, no_points, None, used, sentence)


def _photos_of_points(pipeline: SadgsPipeline, observations: Observations) -> tuple[Ints, Ints]:
    """Return pairs of a training photo and a point that it shows, whose colour is the mean over these photos. [K], [K]

    They are those of SfM's tracks, or the observations if there are none. Raises InputError as `points_seen`.
    """
    source = pipeline.datamanager.train_dataparser_outputs.metadata.get(POINTS_FILE)
    seen = None
    if source is not None:
        seen = points_seen(source, pipeline.datamanager.train_dataset.image_filenames)
    if seen is None:
        return observations.views, observations.points
    views = np.repeat(np.arange(len(seen)), [len(points) for points in seen])
    return views, np.concatenate(seen)


def _by_points(fitted: Exposures, observations: Observations) -> _Found:
    """Decide whether gains that were fitted to points are used."""
    reduced = fitted.residual_after <= (1 - LEAST_REDUCTION) * fitted.residual_before
    used = fitted.deviation >= LEAST_DEVIATION and reduced
    sentence = _sentence(fitted.deviation, fitted.spread, "by the points' colours", used)
    without = int((~fitted.known).sum())
    if used and without:
        sentence += f" Photos that share fewer than {FEWEST_POINTS} points with others have a gain of 1: {without}."
    points = torch.from_numpy(fitted.points).float()
    return _Found(torch.from_numpy(fitted.stops), points, observations, used, sentence)


def _sentence(deviation: float, spread: float, source: str, used: bool) -> str:
    """Say how much exposure varies, in stops, and what follows."""
    varies = f"Exposure, {source}, varies by {deviation:.2f} stops (range {spread:.2f}) between the training photos"
    if used:
        return f"{varies}: each is compared with a rendering at its own exposure, and the splat has the median."
    return f"{varies}, which is too little, or too unsure, for gains of their own."


def _warn_of_disagreement(fitted: Exposures, exif_stops: list[float]) -> None:
    """Print a line if EXIF's exposures have another range than the gains."""
    known = np.array(exif_stops)[fitted.known]
    exif_spread = float(np.ptp(known))
    if abs(exif_spread - fitted.spread) > _DISAGREEMENT:
        warn(
            f"By EXIF, exposure varies in a range of {exif_spread:.1f} stops, but by the points' colours of "
            f"{fitted.spread:.1f}: the points decide."
        )
