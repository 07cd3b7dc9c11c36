"""The Gaussians that a run starts from: SfM points, their bounding box, random points, or stereo depth.

Parameters are by name: means [N, 3], log scales [N, 3], quats [N, 4], logit opacities [N, 1], and coefficients of
harmonics features_dc [N, 3] and features_rest [N, K, 3].
"""

from __future__ import annotations

import math

import torch
from nerfstudio.models.splatfacto import RGB2SH, num_sh_bases, random_quat_tensor
from torch import Tensor

from sadgs_ns.geometry.extents import plausible_points
from sadgs_ns.geometry.initialization import FACE_GRID, face_grid, most_starting_points, starting_points
from sadgs_ns.geometry.outliers import POINT_SHARE, REACH
from sadgs_ns.training.config import SadgsModelConfig
from sadgs_ns.training.run.progress import warn


def initial_gaussians(
    config: SadgsModelConfig, seed_points: tuple[Tensor, Tensor] | None, pixels: int | None = None
) -> tuple[dict[str, Tensor], Tensor]:
    """Return the parameters of N Gaussians at SfM or random points, and which of them are synthetic, bool [N].

    `seed_points` are P SfM points [P, 3] and their colours in 0 … 255 [P, 3], if the data has some. Synthetic are all
    Gaussians that stand for no SfM point. Their number is at most the cap, and at most `starts_per_pixel` of all
    training images' `pixels`, if these are known; a warning says what is left out.
    """
    grid = FACE_GRID
    most = math.inf
    if pixels is not None:
        grid = face_grid(pixels, config.starts_per_pixel)
        most = most_starting_points(pixels, config.starts_per_pixel)
    if seed_points is None or config.random_init:
        num_random = int(min(config.num_random, most))
        if not config.random_init:
            warn(
                f"The data has no SfM points: starting from {num_random} random ones in a cube of side "
                f"{config.random_scale}. A reconstruction (sadgs-process) gives a better splat."
            )
        points = (torch.rand((num_random, 3)) - 0.5) * config.random_scale  # [P, 3]
        start = starting_points(points, torch.rand((len(points), 3)), faces=False)
        number_of_sfm_points = 0
    else:
        points, colors = _plausible(*seed_points)
        if len(points) > most:
            warn(
                f"Starting from a random {int(most):,} of {len(points):,} SfM points, as all training images have "
                f"{pixels:,} pixels; --pipeline.model.starts-per-pixel 0 takes all."
            )
            keep = torch.randperm(len(points))[: int(most)]
            points = points[keep]
            colors = colors[keep]
        start = starting_points(
            points, colors, faces=config.bounding_box_points, opacity=config.initial_opacity, grid=grid
        )
        number_of_sfm_points = len(points)
    number = len(start[0])
    cap = config.strategy.max_gaussians
    synthetic = torch.arange(number) >= number_of_sfm_points
    if number > cap:
        warn(f"Keeping a random {cap} of {number} initial points: max_gaussians is {cap}.")
        keep = torch.randperm(number)[:cap]
        start = tuple(values[keep] for values in start)
        synthetic = synthetic[keep]
    means, colors, scales, opacities = start
    return spheres(means, colors, scales, opacities, sh_degree=config.sh_degree), synthetic


def _plausible(points: Tensor, colors: Tensor) -> tuple[Tensor, Tensor]:
    """Return the SfM points [P, 3] that are no outliers, and their colours [P, 3] in [0, 1] instead of 0 … 255."""
    points = points.float()
    colors = colors.float() / 255.0
    plausible = plausible_points(points)  # [P]
    if plausible.all():
        return points, colors
    warn(
        f"Leaving out {int((~plausible).sum())} of {len(points)} SfM points, which are not finite or more than "
        f"{REACH:g} times as far out as {POINT_SHARE:.0%} of them."
    )
    return points[plausible], colors[plausible]


def spheres(
    means: Tensor,  # [P, 3]
    colors: Tensor,  # [P, 3] in [0, 1]
    scales: Tensor,  # [P] standard deviations in world units
    opacities: Tensor | float,  # [P] in (0, 1)
    *,
    sh_degree: int,
) -> dict[str, Tensor]:
    """Return the parameters of spheres with random rotations."""
    number = len(means)
    return {
        "means": means,
        "scales": scales.log()[:, None].repeat(1, 3),
        "quats": random_quat_tensor(number),
        "features_dc": color_features(colors, sh_degree),
        "features_rest": torch.zeros((number, num_sh_bases(sh_degree) - 1, 3)),
        "opacities": torch.logit(torch.as_tensor(opacities).expand(number))[:, None],
    }


def color_features(
    colors: Tensor,  # [P, 3] in [0, 1]
    sh_degree: int,
) -> Tensor:
    """Return the parameters features_dc of Gaussians that have these colours from all sides. [P, 3]"""
    if sh_degree > 0:
        return RGB2SH(colors)
    return torch.logit(colors, eps=1e-4)
