"""Gaussians and cameras that tests draw at random."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from sadgs_ns.formats.gaussians import Gaussians, of_parameters


def random_gaussians(count: int, bands: int = 15, seed: int = 0) -> Gaussians:
    """Gaussians of the sizes, opacities and colours that training makes, no two of them near each other."""
    generator = np.random.default_rng(seed)
    side = math.ceil(count ** (1 / 3))
    grid = np.stack(np.meshgrid(*[np.linspace(-2, 3, side)] * 3), -1).reshape(-1, 3)[:count]
    arrays = {
        "means": grid + generator.uniform(-0.3, 0.3, grid.shape) * 5 / side,
        "scales": generator.normal(-4, 0.7, (count, 3)).clip(-6, -2),
        "quats": generator.normal(size=(count, 4)),
        "opacities": generator.normal(0, 2, count),
        "features_dc": generator.normal(0, 0.8, (count, 3)).clip(-2.5, 2.5),
        "features_rest": generator.normal(0, 0.1, (count, bands, 3)),
    }
    return of_parameters(arrays)


def nearly_aligned_viewmats(num_views: int, generator: torch.Generator) -> Tensor:
    """Matrices of cameras near the origin that look about along z, in float64. [C, 4, 4]"""

    def random(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    viewmats = torch.eye(4, dtype=torch.float64).repeat(num_views, 1, 1)
    viewmats[:, :3, :3] = torch.linalg.qr(torch.eye(3) + 0.1 * random(num_views, 3, 3))[0]
    viewmats[:, :3, :3] *= viewmats[:, :3, :3].diagonal(dim1=1, dim2=2).sign()[:, None]
    viewmats[:, :3, 3] = 0.2 * random(num_views, 3)
    return viewmats
