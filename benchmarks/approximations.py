"""`python -m benchmarks approximations`: speed against error of S̄ and of η, against float64 or brute force.

Two tables: how S̄ is computed and stored, and how many samples a footprint gets. It runs on the CPU, and times are
medians of processor time, which other processes do not disturb.
"""

from __future__ import annotations

import math
import platform
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from benchmarks import results, table
from sadgs_ns.gsplat_compat import SCREEN_BLUR
from sadgs_ns.method.eta import eta, sample_footprint, sample_map, wavelength
from sadgs_ns.method.quantization import dequantize, quantize
from sadgs_ns.method.statistics import HIGH_ETA
from sadgs_ns.method.structure_tensor import multiscale_structure_tensor

AXIS_LENGTHS = (3.0, 4.0, 6.0, 8.0, 12.0, 16.0, 24.0, 32.0)
"""Axes ‖v‖ in px whose η > 1 decision is compared at every pixel; c = 0.4 has no wavelength under 2.5 px."""
SAMPLES = (1, 4, 16)
"""Numbers of samples of a footprint that are compared."""
QUADRATURE_POINTS = 1024
"""Number of points of a footprint's exact average."""
FOOTPRINTS = 5000
"""Number of footprints."""
Row = dict[str, Any]
"""`table`, `variant`, and the numbers of that table's columns."""


def timed(function: Callable[[], Any], repeats: int) -> tuple[Any, float]:
    """What a function returns, and the median milliseconds of `repeats` calls after a first one."""
    result = function()
    seconds = []
    for _ in range(repeats):
        start = time.process_time()
        function()
        seconds.append(time.process_time() - start)
    return result, 1e3 * statistics.median(seconds)


def spread(errors: Tensor) -> Row:
    """Median, 95th percentile and maximum of errors ≥ 0 of any shape."""
    ordered = errors.flatten().sort().values  # torch.quantile refuses more than 16 M values
    quantiles = {"median": 0.5, "p95": 0.95, "max": 1.0}
    return {name: float(ordered[round((len(ordered) - 1) * quantile)]) for name, quantile in quantiles.items()}


def map_errors(tensor: Tensor, reference: Tensor) -> Row:
    """Errors |Λ / Λ_ref − 1| of the wavelength over the pixels of S̄, both [B, H, W, 3], and `flips`, the share of
    pixels × AXIS_LENGTHS on the other side of η = 1."""
    actual = wavelength(tensor.double())  # [B, H, W]
    expected = wavelength(reference.double())  # [B, H, W]
    lengths = torch.tensor(AXIS_LENGTHS, dtype=actual.dtype, device=actual.device).view(-1, 1, 1, 1)
    flips = ((lengths / actual > HIGH_ETA) != (lengths / expected > HIGH_ETA)).double().mean()
    return {**spread((actual / expected - 1).abs()), "flips": float(flips)}


def structure_tensor_rows(images: Tensor, repeats: int) -> Iterator[Row]:
    """How S̄ of images, float32 in [0, 1] [B, H, W, 3], is computed and stored; all against float64."""
    measure = partial(timed, repeats=repeats)
    reference, ms = measure(lambda: multiscale_structure_tensor(images.double()))
    single = reference.float()
    variants: dict[str, tuple[Callable[[], Tensor], Callable[[Tensor], Tensor], int]] = {
        "as shipped: float32, stored in 8 bits": (lambda: quantize(multiscale_structure_tensor(images)), dequantize, 3),
        "precision alone: float32": (lambda: multiscale_structure_tensor(images), lambda tensor: tensor, 12),
        "storage alone: float16": (single.half, lambda tensor: tensor, 6),
        "storage alone: 8 bits": (lambda: quantize(single), dequantize, 3),
    }
    made = {"reference: float64": (reference, ms, lambda tensor: tensor, 24)}
    made |= {name: (*measure(store), read, size) for name, (store, read, size) in variants.items()}
    for name, (stored, ms, read, size) in made.items():
        row = {"table": "structure_tensor", "variant": name, "bytes": size, **map_errors(read(stored), reference)}
        yield {**row, "ms": ms / len(images)}


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


def random_footprints(count: int, images: Tensor) -> Footprints:
    """Footprints anywhere in images [B, H, W, C], of 1 to 32 px along the major axis, up to 8 times less along the
    minor one."""
    generator = torch.Generator().manual_seed(0)
    batch, height, width = images.shape[:3]
    x, y, size, ratio, turn, image = torch.rand((6, count), generator=generator)
    major = 32.0**size  # log-uniform
    minor = major * 8.0**-ratio
    cos = (math.pi * turn).cos()
    sin = (math.pi * turn).sin()
    axes = torch.stack([major * cos, major * sin, -minor * sin, minor * cos], -1).view(count, 2, 2)
    return Footprints((image * batch).long(), torch.stack([x * width, y * height], -1), axes)


def average(tensors: Tensor, footprints: Footprints, positions: Iterator[Tensor]) -> tuple[Tensor, Tensor]:
    """S̄ [B, H, W, 3] averaged over those points of each footprint, in px [M, 2] each, that lie in the image.

    Returns the averages, 0 outside [M, 3], and whether any point lies in the image, bool [M].
    """
    total = tensors.new_zeros((len(footprints.means2d), 3))
    count = tensors.new_zeros(len(footprints.means2d))
    for points in positions:
        values, inside = sample_map(tensors, footprints.image_ids, points)
        total += values
        count += inside
    return total / count.clamp_min(1)[:, None], count > 0


def quadrature(footprints: Footprints) -> Iterator[Tensor]:
    """The points of a sunflower spiral that covers each 2σ ellipse evenly. [M, 2] each"""
    for i in range(QUADRATURE_POINTS):
        radius = 2 * math.sqrt((i + 0.5) / QUADRATURE_POINTS)
        angle = i * (math.pi * (3 - math.sqrt(5)))
        disc = torch.tensor([radius * math.cos(angle), radius * math.sin(angle)]).to(footprints.axes)
        yield footprints.means2d + disc @ footprints.axes


def footprint_rows(tensors: Tensor, footprints: Footprints, repeats: int) -> Iterator[Row]:
    """η by few jittered samples, of which training takes one, against η by the exact average of S̄ [B, H, W, 3]."""
    conics = footprints.conics
    generator = torch.Generator(tensors.device).manual_seed(0)

    def observed(points: Callable[[], Iterator[Tensor]]) -> tuple[Tensor, Tensor]:
        tensor, seen = average(tensors, footprints, points())
        return eta(footprints.axes, tensor), seen

    def jittered(samples: int) -> Iterator[Tensor]:
        for _ in range(samples):
            jitter = torch.rand(footprints.means2d.shape, generator=generator, device=conics.device)
            yield sample_footprint(footprints.means2d, conics, jitter)

    ways = {f"reference: {QUADRATURE_POINTS} points of quadrature": partial(quadrature, footprints)}
    ways |= {f"{samples} sample{'s' * (samples > 1)}": partial(jittered, samples) for samples in SAMPLES}
    measured = {name: timed(partial(observed, way), repeats) for name, way in ways.items()}
    (expected, expected_seen), _ = next(iter(measured.values()))
    for name, ((actual, seen), ms) in measured.items():
        both = seen & expected_seen
        errors = spread((actual[both, 0] / expected[both, 0] - 1).abs())  # the same for both axes
        flips = float(((actual > HIGH_ETA) != (expected > HIGH_ETA))[both].double().mean())
        yield {"table": "footprint", "variant": name, **errors, "flips": flips, "ms": ms}


@dataclass
class Command:
    """Tabulate what each shortcut in the frequency analysis gets wrong, beside what it costs."""

    image: Path
    """a photo"""
    repeats: int = 5
    """timed calls, at least 1"""
    output: Path | None = None
    """JSON-lines file that the rows are added to"""

    def __call__(self) -> int:
        if self.repeats < 1:
            raise ValueError(f"--repeats is {self.repeats}; give at least 1.")
        images = read_photo(self.image)
        footprints = random_footprints(FOOTPRINTS, images)
        where = f"CPU ({platform.machine()}, {torch.get_num_threads()} threads)"
        print(f"{self.image.name} on {where}, torch {torch.__version__}, median of {self.repeats} calls\n", flush=True)
        common = {"input": self.image.name, "device": where, "torch": torch.__version__, "repeats": self.repeats}
        for rows in (
            structure_tensor_rows(images, self.repeats),
            footprint_rows(multiscale_structure_tensor(images), footprints, self.repeats),
        ):
            measured = list(rows)
            print(table.of_approximations(measured), end="\n\n", flush=True)
            for row in measured:
                key = "/".join((where, self.image.name, row["table"], row["variant"]))
                if self.output is not None:
                    results.append(self.output, {"key": key, **common, **row})
        return 0


def read_photo(path: Path) -> Tensor:
    """A photo as RGB in [0, 1], no side over 1,600 px [1, H, W, 3]; raises ValueError if it cannot be read."""
    try:
        with Image.open(path) as image:
            image.thumbnail((1600, 1600), Image.Resampling.BOX)
            return torch.from_numpy(np.asarray(image.convert("RGB"), np.float32) / 255)[None]
    except (OSError, UnidentifiedImageError) as error:
        raise ValueError(f"--image {path} cannot be read as an image; give a JPEG or PNG file.") from error
