"""What few samples a footprint, and few observations, do to η and to the decisions made from it, and what they cost."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from benchmarks.tensor_errors import Row, spread, timed
from examples.drawn_scene.scene import SceneDescription
from sadgs_ns.method.eta import SCREEN_BLUR, eta, sample_footprint, sample_map
from sadgs_ns.method.initialization import neighbour_scales
from sadgs_ns.method.split import children_per_axis
from sadgs_ns.method.statistics import HIGH_ETA, consistent, empty_statistics, observe
from sadgs_ns.method.strategy import StructureAwareStrategy
from sadgs_ns.method.structure_tensor import multiscale_structure_tensor
from sadgs_ns.render.rasterization import rasterize

SAMPLES = (1, 4, 16)
INTERVALS = (1, 2, 5, 10, 20)
"""Every how many iterations η is observed."""
RUNS = 4
"""Differing in view order and jitter, over which the errors of an interval are averaged."""
QUADRATURE_POINTS = 1024
"""Points of the exact footprint average."""


@dataclass(frozen=True)
class Footprints:
    """M projected Gaussians."""

    image_ids: Tensor
    """Which image. int64 [M]"""
    means2d: Tensor
    """px. [M, 2]"""
    axes: Tensor
    """Principal axes of Σ2D, their lengths the standard deviations in px, axis before component. [M, 2, 2]"""

    @property
    def conics(self) -> Tensor:
        """(a, b, c) of the inverse of Σ2D + SCREEN_BLUR·I in 1/px², as gsplat's. [M, 3]"""
        axes = self.axes.double()
        covariances = axes.mT @ axes + SCREEN_BLUR * torch.eye(2, dtype=torch.float64, device=axes.device)
        return torch.linalg.inv(covariances).flatten(1)[:, [0, 1, 3]].to(self.axes)


def random_footprints(count: int, images: Tensor, seed: int = 0) -> Footprints:
    """Footprints anywhere in the images, of 1 to 32 px along the major axis and up to 8 times less along the minor one.

    Args:
        count: M.
        images: Only shape and device matter. [B, H, W, C]
        seed: Of the positions, sizes and orientations.
    """
    generator = torch.Generator().manual_seed(seed)
    batch, height, width = images.shape[:3]
    x, y, size, ratio, turn, image = torch.rand((6, count), generator=generator)
    major = 32.0**size  # log-uniform
    minor = major * 8.0**-ratio
    cos, sin = (math.pi * turn).cos(), (math.pi * turn).sin()
    axes = torch.stack([major * cos, major * sin, -minor * sin, minor * cos], -1).view(count, 2, 2)
    image_ids = (image * batch).long()
    means2d = torch.stack([x * width, y * height], -1)
    return Footprints(image_ids.to(images.device), means2d.to(images.device), axes.to(images.device))


def exact_average(tensors: Tensor, footprints: Footprints, points: int = QUADRATURE_POINTS) -> tuple[Tensor, Tensor]:
    """S̄ averaged over the part of each 2σ ellipse that lies in the image, by dense quadrature.

    Args:
        tensors: S̄. [B, H, W, 3]
        footprints: M of them.
        points: Of the sunflower spiral that covers the ellipse evenly.

    Returns:
        The averages, 0 outside [M, 3], and whether any of the ellipse lies in the image. bool [M]
    """
    index = torch.arange(points, device=tensors.device, dtype=torch.float64)
    radius, angle = 2 * ((index + 0.5) / points).sqrt(), index * (math.pi * (3 - math.sqrt(5)))
    disc = torch.stack([radius * angle.cos(), radius * angle.sin()], -1).to(footprints.axes)  # [P, 2]
    averages, seen = [], []
    for image_ids, means2d, axes in zip(
        footprints.image_ids.split(256), footprints.means2d.split(256), footprints.axes.split(256), strict=True
    ):
        positions = means2d[:, None] + disc @ axes  # [m, P, 2]
        values, inside = sample_map(tensors, image_ids.repeat_interleave(points), positions.flatten(0, 1))
        count = inside.view(-1, points).sum(1)  # [m]
        averages.append(values.view(-1, points, 3).sum(1) / count.clamp_min(1)[:, None])
        seen.append(count > 0)
    return torch.cat(averages), torch.cat(seen)


def sampled_average(
    tensors: Tensor, footprints: Footprints, conics: Tensor, samples: int, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """The same by `samples` jittered points: 1 is what training does.

    Returns:
        The averages [M, 3], and whether any sample lay in the image. bool [M]
    """
    total, count = torch.zeros_like(conics), torch.zeros_like(conics[:, 0])
    for _ in range(samples):
        jitter = torch.rand(footprints.means2d.shape, generator=generator, device=conics.device)
        values, inside = sample_map(tensors, footprints.image_ids, sample_footprint(footprints.means2d, conics, jitter))
        total += values
        count += inside
    return total / count.clamp_min(1)[:, None], count > 0


def footprint_rows(tensors: Tensor, footprints: Footprints, repeats: int, seed: int = 0) -> Iterator[Row]:
    """η by few samples against η by the exact average, over footprints of which both saw a part.

    Args:
        tensors: S̄, float32. [B, H, W, 3]
        footprints: M of them.
        repeats: Timed calls of each variant.
        seed: Of the jitter.
    """
    conics, device = footprints.conics, tensors.device
    generator = torch.Generator(device).manual_seed(seed)
    measure = partial(timed, device=device, repeats=repeats)

    def observed_eta(average: Callable[[], tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor]:
        tensor, seen = average()
        return eta(footprints.axes, tensor), seen

    (expected, expected_seen), ms = measure(partial(observed_eta, partial(exact_average, tensors, footprints)))

    def row(variant: str, actual: Tensor, seen: Tensor, ms: float) -> Row:
        seen = seen & expected_seen
        errors = spread((actual[seen, 0] / expected[seen, 0] - 1).abs())  # the same for both axes
        flips = float(((actual > HIGH_ETA) != (expected > HIGH_ETA))[seen].double().mean())
        return {"table": "footprint", "variant": variant, **errors, "flips": flips, "ms": ms}

    yield row(f"reference: {QUADRATURE_POINTS} points of quadrature", expected, expected_seen, ms)
    for samples in SAMPLES:
        average = partial(sampled_average, tensors, footprints, conics, samples, generator)
        (actual, seen), ms = measure(partial(observed_eta, average))
        yield row(f"{samples} sample{'s' if samples > 1 else ''}", actual, seen, ms)


@dataclass(frozen=True)
class TrainingSet:
    """Gaussians at rest and the views that observe them."""

    params: dict[str, torch.nn.Parameter]
    """gsplat's parameters. [N, …]"""
    infos: list[dict[str, Any]]
    """What `observe` reads of one view each."""


def demo_training_set(scene: SceneDescription, images: Tensor, device: torch.device, seed: int = 0) -> TrainingSet:
    """The demo scene as it is before the first split: Gaussians at its points, as large as the points lie apart.

    Args:
        scene: Its points and views.
        images: All its views, float32 in [0, 1]. [V, H, W, 3]
        device: Where everything ends up.
        seed: Of orientations, shapes and opacities.
    """
    height, width = images.shape[1:3]
    generator = torch.Generator().manual_seed(seed)
    means = torch.from_numpy(scene.points).float()
    n = len(means)
    values = {
        "means": means,
        # Each axis half as long or twice as long within one standard deviation: training leaves no Gaussian round.
        "scales": neighbour_scales(means).log()[:, None] + math.log(2) * torch.randn((n, 3), generator=generator),
        "quats": torch.randn((n, 4), generator=generator),
        "opacities": torch.logit(0.3 + 0.6 * torch.rand(n, generator=generator)),
    }
    params = {name: torch.nn.Parameter(value.to(device)) for name, value in values.items()}
    colours = torch.from_numpy(scene.colours).to(device) / 255
    infos = []
    for image, view in zip(images, scene.views, strict=True):
        viewmat = torch.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = torch.from_numpy(view.rotation), torch.from_numpy(view.translation)
        K = torch.tensor([[view.focal, 0, 0.5 * width], [0, view.focal, 0.5 * height], [0, 0, 1]])
        viewmats, Ks = viewmat[None].to(device), K[None].to(device)
        with torch.no_grad():
            _, _, info = rasterize(
                params["means"], params["quats"], params["scales"].exp(), torch.sigmoid(params["opacities"]), colours,
                viewmats, Ks, width, height,
            )  # fmt: skip
        tensors = multiscale_structure_tensor(image[None].to(device)).half()
        infos.append({**info, "viewmats": viewmats, "Ks": Ks, "structure_tensors": tensors})
    return TrainingSet(params, infos)


def observe_run(
    training: TrainingSet, iterations: int, intervals: Sequence[int], seed: int
) -> dict[int, dict[str, Tensor]]:
    """Statistics after a run of one view an iteration, had η been observed at every k-th iteration only.

    All intervals see the same views and the same jitter, so that one is a part of the other.

    Args:
        training: What is observed.
        iterations: Length of the run; views come in random rounds, as nerfstudio draws them.
        intervals: The k.
        seed: Of view order and jitter.

    Returns:
        For each k, statistics as `empty_statistics` names them.
    """
    device, n = training.params["means"].device, len(training.params["means"])
    order, jitter = torch.Generator().manual_seed(seed), torch.Generator(device).manual_seed(seed)
    totals = {interval: empty_statistics(n, device) for interval in intervals}
    views: list[int] = []
    for iteration in range(iterations):
        views = views or torch.randperm(len(training.infos), generator=order).tolist()
        once = empty_statistics(n, device)
        observe(once, training.params, training.infos[views.pop()], generator=jitter)
        for interval, total in totals.items():
            if iteration % interval == 0:
                for name, value in once.items():
                    total[name] = torch.maximum(total[name], value) if name == "eta_max" else total[name] + value
    return totals


def split_errors(statistics: Mapping[str, Tensor], reference: Mapping[str, Tensor]) -> Row:
    """Consistency ratios and split decisions against those of the reference, over Gaussians that it observed.

    Returns:
        `mean`, `median`, `p95` and `max` of |Δ n_high / n_total| over the axes; `flips`, the fraction of axes whose
        decision to split differs; `splits`, the fraction of Gaussians that split into another grid; `growth`, the
        relative error of the number of Gaussians afterwards.
    """
    strategy = StructureAwareStrategy()
    seen = reference["n_total"] > 0

    def ratio(s: Mapping[str, Tensor]) -> Tensor:
        return (s["n_high"] / s["n_total"].clamp_min(1)[:, None])[seen]  # [S, 3]

    def violates(s: Mapping[str, Tensor]) -> Tensor:
        return consistent(s["n_high"], s["n_total"], strategy.tau_split, strategy.min_observations)[seen]  # [S, 3]

    def grid(s: Mapping[str, Tensor]) -> Tensor:
        return children_per_axis(s["eta_max"][seen], violates(s))  # [S, 3]

    errors = (ratio(statistics) - ratio(reference)).abs()
    actual, expected = grid(statistics), grid(reference)
    return {
        "mean": float(errors.mean()),
        **spread(errors),
        "flips": float((violates(statistics) != violates(reference)).double().mean()),
        "splits": float((actual != expected).any(1).double().mean()),
        "growth": float(actual.prod(1).sum() / expected.prod(1).sum() - 1),
    }


def interval_errors(
    training: TrainingSet, iterations: int, runs: int = RUNS
) -> tuple[dict[int, dict[str, float]], dict[str, float]]:
    """What observing every k-th iteration changes, and what another view order and jitter change on their own.

    All Gaussians of a run see the same few views, so their errors come and go together: one run says little.

    Args:
        training: What is observed.
        iterations: Of each run.
        runs: Differing in view order and jitter.

    Returns:
        The errors that `split_errors` names, mean over the runs, for each of INTERVALS; and those of each run's every
        iteration against the next run's.
    """
    totals = [observe_run(training, iterations, INTERVALS, seed) for seed in range(runs)]
    following = totals[1:] + totals[:1]

    def mean(errors: Sequence[Row]) -> dict[str, float]:
        return {name: sum(row[name] for row in errors) / runs for name in errors[0]}

    every_kth = {k: mean([split_errors(total[k], total[1]) for total in totals]) for k in INTERVALS}
    pairs = zip(totals, following, strict=True)
    return every_kth, mean([split_errors(one[1], other[1]) for one, other in pairs])


def interval_rows(training: TrainingSet, iterations: int, repeats: int) -> Iterator[Row]:
    """η at every k-th iteration against every one; the last row is what another order and jitter change on their own.

    Args:
        training: What is observed.
        iterations: Between two structure steps.
        repeats: Timed rounds over the views.
    """
    device = training.params["means"].device
    generator = torch.Generator(device).manual_seed(0)
    statistics = empty_statistics(len(training.params["means"]), device)

    def round_of_views() -> None:
        for info in training.infos:
            observe(statistics, training.params, info, generator=generator)

    _, ms = timed(round_of_views, device, repeats)
    ms /= len(training.infos)
    every_kth, chance = interval_errors(training, iterations)
    for interval, errors in every_kth.items():
        name = "reference: every iteration" if interval == 1 else f"every {interval} iterations"
        yield {"table": "interval", "variant": name, **errors, "ms": ms / interval}
    yield {"table": "interval", "variant": "every iteration, other view order and jitter", **chance, "ms": ms}
