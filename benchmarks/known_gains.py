"""`python -m benchmarks gains DATA …`: how accurately gains of exposure are found.

It needs no GPU, and trains nothing. The photos of a scene get known gains in linear light, and are read again. The
gains that are found then, less those that were found before, should be the known ones, whatever exposure the photos had
at first. Two kinds are given: `each` photo has a gain of its own (normal, with a standard deviation of .3 stops), or
gains follow a `slow` wave over all photos in the order of their names, of .4 stops up and down. Every 8th photo from
the fifth takes no part when gains are fitted. Its own gain is found afterwards by the points' colours, as that of a
held-out photo.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tyro.conf import Positional

from benchmarks.exposures import with_gains
from benchmarks.table import grid
from benchmarks.validation import INTERVAL, SPARSE, VALIDATION
from sadgs_ns.geometry.exposure import Exposures, fit_exposures, gains_of_others

EACH = 0.3
"""Standard deviation of gains that differ from photo to photo, in stops."""
SLOW = 0.4
"""Amplitude of gains that change slowly, in stops."""
HEADER = [
    "Scene", "Photos", "SD, stops", "Residual falls by", "each: error", "held out", "slow: error", "held out",
]  # fmt: skip
Array = NDArray[np.float64]


@dataclass(frozen=True)
class Found:
    """Gains that were found."""

    stops: Array  # log₂ of each photo's gain, mean over channels [V]
    known: NDArray[np.bool_]  # [V]
    fitted: Exposures


def known_gains(views: int) -> dict[str, Array]:
    """Return the gains that photos are given by kind, in stops. [V] each"""
    phases = 2 * np.pi * np.arange(views) / views
    return {"each": np.random.default_rng(0).normal(0, EACH, views), "slow": SLOW * np.sin(phases)}


def read_scene(scene: Path) -> tuple[Any, torch.Tensor]:
    """Return nerfstudio's dataset of a scene's training photos, and its points [P, 3].

    Raises ValueError if it holds neither a `transforms.json` nor a COLMAP model, or has no points.
    """
    from nerfstudio.data.datasets.base_dataset import InputDataset

    from sadgs_ns.data.own_parsers import OWN
    from sadgs_ns.data.parsers import PARSERS

    config: Any
    if (scene / "transforms.json").exists():
        config = copy.deepcopy(PARSERS["nerfstudio-data"])
    elif (scene / SPARSE).is_dir():
        config = copy.deepcopy(PARSERS["colmap"])
        config.colmap_path = Path(SPARSE)
        config.downscale_factor = 1
    else:
        raise ValueError(f"{scene} holds neither transforms.json nor {SPARSE}; give the folder of a scene.")
    config.data = scene
    outputs = OWN[config._target](config).get_dataparser_outputs("train")
    if "points3D_xyz" not in outputs.metadata:
        raise ValueError(f"{scene} has no points, by whose colours gains are found.")
    return InputDataset(outputs), outputs.metadata["points3D_xyz"].float()


def held_out_of(views: int) -> NDArray[np.bool_]:
    """Tell which photos take no part when gains are fitted. [V]"""
    return np.arange(views) % INTERVAL == VALIDATION


def find_gains(dataset: Any, points: torch.Tensor, stops: Array) -> Found:
    """Give the photos of a dataset gains, in stops [V], and find them."""
    from sadgs_ns.training.run.point_observations import PointObservations

    views = len(dataset)
    photos = []
    for index, gain in enumerate(stops):
        data = dataset[index]
        pixels = (255 * data["image"]).round().byte().numpy()
        changed = with_gains(pixels[..., :3], np.full(3, 2.0**gain))
        photos.append({**data, "image": torch.from_numpy(changed)})
    observations = PointObservations(points, dataset, points.device).of_all(photos)
    held_out = held_out_of(views)
    fitted = fit_exposures(observations.of_views(~held_out), views, len(points))
    others, others_known = gains_of_others(observations.of_views(held_out), fitted.points, views)
    found = np.where(held_out[:, None], others, fitted.stops).mean(axis=1)
    return Found(found, np.where(held_out, others_known, fitted.known), fitted)


def errors(before: Found, after: Found, stops: Array) -> tuple[float, float]:
    """Return the root mean square errors of photos that were fitted, and of those that were held out, in stops."""
    held_out = held_out_of(len(stops))
    known = before.known & after.known
    difference = after.stops - before.stops - stops
    difference -= np.median(difference[known & ~held_out])  # Only gains relative to the median have a meaning.
    squares = np.square(difference)
    return float(np.sqrt(squares[known & ~held_out].mean())), float(np.sqrt(squares[known & held_out].mean()))


def line_of(scene: Path) -> list[str]:
    """Return a scene's line of the table. Raises as `read_scene`."""
    dataset, points = read_scene(scene)
    before = find_gains(dataset, points, np.zeros(len(dataset)))
    reduction = 1 - before.fitted.residual_after / before.fitted.residual_before
    cells = [scene.resolve().name, str(len(dataset)), f"{before.fitted.deviation:.3f}", f"{reduction:.0%}"]
    for stops in known_gains(len(dataset)).values():
        cells += [f"{error:.3f}" for error in errors(before, find_gains(dataset, points, stops), stops)]
    return cells


@dataclass
class Command:
    """Tell how accurately gains of exposure are found in scenes whose photos are given known ones."""

    scenes: Positional[tuple[Path, ...]]
    """folders of scenes, with a transforms.json or a COLMAP model"""

    def __call__(self) -> int:
        """Print the table; return 0."""
        print(grid(HEADER, [line_of(scene) for scene in self.scenes], names=1))
        return 0
