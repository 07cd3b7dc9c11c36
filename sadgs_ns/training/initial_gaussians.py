"""The Gaussians that a run starts from: SfM points, their bounding box, random points, or stereo depth.

Parameters are by name: means [N, 3], log scales [N, 3], quats [N, 4], logit opacities [N, 1], and coefficients of
harmonics features_dc [N, 3] and features_rest [N, K, 3].
"""

from __future__ import annotations

import torch
from nerfstudio.models.splatfacto import RGB2SH, num_sh_bases, random_quat_tensor
from torch import Tensor

from sadgs_ns.geometry.initialization import plausible_points, starting_points
from sadgs_ns.geometry.outliers import POINT_SHARE, REACH
from sadgs_ns.training.config import SadgsModelConfig
from sadgs_ns.training.run.progress import warn


def initial_gaussians(
    config: SadgsModelConfig, seed_points: tuple[Tensor, Tensor] | None
) -> tuple[dict[str, Tensor], Tensor]:
    """Return Gaussians of SfM points [P, 3], colours in 0 … 255, or random points, and which are synthetic [N]."""
    if seed_points is None or config.random_init:
        if not config.random_init:
            told = f"starting from {config.num_random} random ones in a cube of side {config.random_scale}"
            warn(f"The data has no SfM points: {told}. A reconstruction (sadgs-process) gives a better splat.")
        points = (torch.rand((config.num_random, 3)) - 0.5) * config.random_scale  # [P, 3]
        start = starting_points(points, torch.rand((len(points), 3)), faces=False)
        sfm = 0
    else:
        points = seed_points[0].float()
        colors = seed_points[1].float() / 255.0
        plausible = plausible_points(points)  # [P]
        if not plausible.all():
            told = f"Leaving out {int((~plausible).sum())} of {len(points)} SfM points"
            warn(f"{told}, which are not finite or more than {REACH:g} times as far out as {POINT_SHARE:.0%} of them.")
            points = points[plausible]
            colors = colors[plausible]
        start = starting_points(points, colors, faces=config.bounding_box_points, opacity=config.initial_opacity)
        sfm = len(points)
    means = start[0]
    cap = config.strategy.max_gaussians
    synthetic = torch.arange(len(means)) >= sfm
    if len(means) > cap:
        warn(f"Keeping a random {cap} of {len(means)} initial points: max_gaussians is {cap}.")
        keep = torch.randperm(len(means))[:cap]
        start = tuple(values[keep] for values in start)
        synthetic = synthetic[keep]
    return spheres(*start, sh_degree=config.sh_degree), synthetic


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
        "features_dc": RGB2SH(colors) if sh_degree > 0 else torch.logit(colors, eps=1e-4),
        "features_rest": torch.zeros((number, num_sh_bases(sh_degree) - 1, 3)),
        "opacities": torch.logit(torch.as_tensor(opacities).expand(number))[:, None],
    }
