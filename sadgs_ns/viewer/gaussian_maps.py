"""Maps of what the Gaussians of each pixel have: their η, children, normals, or the share of chosen ones."""

from __future__ import annotations

from collections.abc import Mapping

import torch
import torch.nn.functional as F
from gsplat.utils import normalized_quat_to_rotmat
from matplotlib.colors import hsv_to_rgb
from torch import Tensor

from sadgs_ns.method.split import num_children
from sadgs_ns.render.rasterization import rasterize
from sadgs_ns.render.types import DEFAULTS, Cameras, Gaussians, RenderOptions

MIN_COVER = 0.05
"""Share of a pixel that Gaussians with a value must make up; otherwise the pixel counts as empty."""


@torch.no_grad()
def blend(
    params: Mapping[str, Tensor],
    values: Tensor,  # [N, D]
    viewmat: Tensor,  # [4, 4]
    K: Tensor,  # [3, 3]
    width: int,
    height: int,
    drawing: RenderOptions = DEFAULTS,
) -> tuple[Tensor, Tensor]:
    """Blend D values of each Gaussian as their colours are blended, front to back.

    `params` are `means` [N, 3], `quats` [N, 4], log `scales` [N, 3] and logit `opacities` [N] or [N, 1]; `drawing`
    says how they are drawn.

    Returns:
        The blended values [H, W, D], and how much of each pixel is covered, in [0, 1] [H, W, 1].
    """
    opacities = torch.sigmoid(params["opacities"].flatten())
    gaussians = Gaussians(params["means"], params["quats"], params["scales"].exp(), opacities, values)
    render, alpha, _ = rasterize(gaussians, Cameras(viewmat[None], K[None], width, height), drawing)
    return render[0], alpha[0]


def eta_map(params: Mapping[str, Tensor], statistics: Mapping[str, Tensor], *view) -> Tensor:
    """Return the largest η [H, W] of the Gaussians of each pixel, as a geometric mean by what each adds to it.

    It is NaN where hardly anything observed is drawn. `statistics` holds `eta_max` [N, 3] and `n_total` [N]. `view` is,
    here and below, what `blend` takes after its first two arguments.
    """
    largest = statistics["eta_max"].amax(dim=1)
    known = ((statistics["n_total"] > 0) & (largest > 0)).float()
    values = torch.stack([torch.where(known > 0, largest, 1.0).log(), known], dim=-1)
    total, cover = blend(params, values, *view)[0].unbind(-1)
    return torch.where(cover > MIN_COVER, (total / cover).exp(), torch.nan)


def children_map(params: Mapping[str, Tensor], counts: Tensor, *view) -> Tensor:
    """Return the number of children, ≥ 1 along each axis [N, 3], of each pixel's Gaussians, as a geometric mean. [H, W]

    It is NaN where hardly anything is drawn.
    """
    total, cover = blend(params, num_children(counts)[:, None].float().log(), *view)
    return torch.where(cover > MIN_COVER, (total / cover).exp(), torch.nan)[..., 0]


def share_map(params: Mapping[str, Tensor], chosen: Tensor, *view) -> Tensor:
    """Return the share of what is drawn at each pixel that the chosen Gaussians, bool [N], make up. [H, W]

    It is NaN where hardly anything is drawn.
    """
    total, cover = blend(params, chosen[:, None].float(), *view)
    return torch.where(cover > MIN_COVER, total / cover, torch.nan)[..., 0]


@torch.no_grad()
def normals_map(params: Mapping[str, Tensor], viewmat: Tensor, *view) -> Tensor:
    """Return the normals of the Gaussians that make up each pixel, blended as their colours are. [H, W, 3]

    They have unit length and world axes, and are 0 where nothing is drawn. A Gaussian's normal is the axis of its
    smallest scale, turned towards the camera. Training does not flatten Gaussians, so that this is an estimate; normals
    of the depth map are rougher (docs/guide.md has both measured).
    """
    rotmats = normalized_quat_to_rotmat(F.normalize(params["quats"], dim=-1))  # [N, 3, 3]
    thinnest = params["scales"].argmin(dim=1)[:, None, None].expand(-1, 3, 1)  # [N, 3, 1]
    normals = rotmats.gather(2, thinnest)[..., 0]  # [N, 3]
    rays = params["means"] + viewmat[:3, :3].T @ viewmat[:3, 3]  # [N, 3] from the camera's centre, −Rᵀ t
    away = (rays * normals).sum(dim=1, keepdim=True) > 0
    return F.normalize(blend(params, torch.where(away, -normals, normals), viewmat, *view)[0], dim=-1)


def random_colors(number: int, generator: torch.Generator) -> Tensor:
    """Return N bright colours in [0, 1] that tell neighbouring Gaussians apart, drawn on the CPU. [N, 3]"""
    hue, saturation, value = torch.rand((3, number), generator=generator)
    return torch.from_numpy(
        hsv_to_rgb(torch.stack([hue, 0.35 + 0.65 * saturation, 0.5 + 0.5 * value], -1).numpy())
    ).float()


def recolor(colors: Tensor, origins: Tensor, generator: torch.Generator) -> Tensor:
    """Return colours after a densification step: Gaussians that stayed whole keep theirs, children get new ones.

    Args:
        colors: Colours before the step, in [0, 1]. [N, 3]
        origins: Index, before the step, of the Gaussian that each one was or came from. int64 [M]
        generator: A generator on the CPU.
    """
    is_child = torch.bincount(origins, minlength=len(colors))[origins] > 1  # [M]
    return torch.where(is_child[:, None], random_colors(len(origins), generator).to(colors), colors[origins])
