"""What several processes and one draw and differentiate, to be compared."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from helpers.generators import seeded
from helpers.small_scenes import random_params
from sadgs_ns.render.types import Cameras, Gaussians

WIDTH = 64
HEIGHT = 75
GAUSSIANS = 200


def cameras(views: int) -> tuple[Tensor, Tensor]:
    """Cameras that see a part of `random_params`' Gaussians each."""
    viewmats = torch.eye(4).repeat(views, 1, 1)
    viewmats[:, 0, 3] = torch.linspace(-1.0, 1.2, views)
    viewmats[:, 2, 3] = -1.5
    K = torch.tensor([[60.0, 0, WIDTH / 2], [0, 60.0, HEIGHT / 2], [0, 0, 1]])
    return viewmats, K.repeat(views, 1, 1)


def inputs(part: slice = slice(None)) -> dict[str, Tensor]:
    """What `rasterize` takes of Gaussians, as leaves."""
    params = {name: value.detach() for name, value in random_params(GAUSSIANS, seed=3).items()}
    harmonics = torch.randn((GAUSSIANS, 4, 3), generator=seeded(1))
    values = {
        "means": params["means"],
        "quats": params["quats"],
        "scales": params["scales"].exp(),
        "opacities": torch.sigmoid(params["opacities"]),
        "colors": harmonics,
    }
    return {name: value[part].clone().requires_grad_() for name, value in values.items()}


def splats(leaves: dict[str, Tensor], views: int) -> tuple[Gaussians, Cameras]:
    """What `rasterize` takes, with cameras on the Gaussians' device."""
    colors = leaves["colors"]
    viewmats, Ks = (value.to(colors.device) for value in cameras(views))
    halves: dict[str, Any] = {**leaves, "colors": (colors[:, 0], colors[:, 1:])}
    return Gaussians(**halves), Cameras(viewmats, Ks, WIDTH, HEIGHT)


def color_maps(views: int) -> Tensor:
    """Factors and offsets of each view's colours, as gains of exposure have. [C, 2, 3]"""
    factors = 0.5 + torch.rand((views, 3), generator=seeded(4))
    return torch.stack([factors, 0.055 * (factors - 1)], dim=1)


def weights(views: int) -> Tensor:
    """What the pixels' sum in the loss is weighted with, so that each gradient is its own."""
    return torch.rand((views, HEIGHT, WIDTH, 4), generator=seeded(2))
