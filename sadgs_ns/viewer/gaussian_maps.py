"""Maps of the Gaussians' η, children, normals, or of the share of chosen ones, blended at each pixel.

`params` are means [N, 3], quats [N, 4], log scales [N, 3] and logit opacities [N] or [N, 1], by name. `view` are the
other arguments of `blend`. Maps are NaN where hardly anything with a value is drawn.
"""

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
    """Blend D values of each Gaussian like colours. → [H, W, D], and the covered share of each pixel [H, W, 1]"""
    opacities = torch.sigmoid(params["opacities"].flatten())
    gaussians = Gaussians(params["means"], params["quats"], params["scales"].exp(), opacities, values)
    render, alpha, _ = rasterize(gaussians, Cameras(viewmat[None], K[None], width, height), drawing)
    return render[0], alpha[0]


def eta_map(params: Mapping[str, Tensor], statistics: Mapping[str, Tensor], *view) -> Tensor:
    """Return the geometric mean, by what each adds to a pixel, of the observed Gaussians' largest η. [H, W]

    `statistics` holds `eta_max` [N, 3] and `n_total` [N].
    """
    largest = statistics["eta_max"].amax(dim=1)
    known = ((statistics["n_total"] > 0) & (largest > 0)).float()
    values = torch.stack([torch.where(known > 0, largest, 1.0).log(), known], dim=-1)
    total, cover = blend(params, values, *view)[0].unbind(-1)
    return torch.where(cover > MIN_COVER, (total / cover).exp(), torch.nan)


def children_map(params: Mapping[str, Tensor], counts: Tensor, *view) -> Tensor:
    """Return the geometric mean of the Gaussians' numbers of children, ≥ 1 along each axis [N, 3]. [H, W]"""
    total, cover = blend(params, num_children(counts)[:, None].float().log(), *view)
    return torch.where(cover > MIN_COVER, (total / cover).exp(), torch.nan)[..., 0]


def share_map(params: Mapping[str, Tensor], chosen: Tensor, *view) -> Tensor:
    """Return the share of the chosen Gaussians, bool [N], in what is drawn at each pixel. [H, W]"""
    total, cover = blend(params, chosen[:, None].float(), *view)
    return torch.where(cover > MIN_COVER, total / cover, torch.nan)[..., 0]


@torch.no_grad()
def normals_map(params: Mapping[str, Tensor], viewmat: Tensor, *view) -> Tensor:
    """Return the blended normals of the Gaussians, of unit length in world axes, 0 where nothing is drawn. [H, W, 3]

    A Gaussian's normal is the axis of its smallest scale, turned towards the camera. This is an estimate, because
    training does not flatten Gaussians; normals of the depth map are rougher (docs/guide.md has both measured).
    """
    rotmats = normalized_quat_to_rotmat(F.normalize(params["quats"], dim=-1))  # [N, 3, 3]
    thinnest = params["scales"].argmin(dim=1)[:, None, None].expand(-1, 3, 1)  # [N, 3, 1]
    normals = rotmats.gather(2, thinnest)[..., 0]  # [N, 3]
    rays = params["means"] + viewmat[:3, :3].T @ viewmat[:3, 3]  # [N, 3] from the camera's centre, −Rᵀ t
    away = (rays * normals).sum(dim=1, keepdim=True) > 0
    return F.normalize(blend(params, torch.where(away, -normals, normals), viewmat, *view)[0], dim=-1)


def random_colors(number: int, generator: torch.Generator) -> Tensor:
    """Return N bright colours in [0, 1] that tell neighbouring Gaussians apart, on the CPU. [N, 3]"""
    hue, saturation, value = torch.rand((3, number), generator=generator)
    hsv = torch.stack([hue, 0.35 + 0.65 * saturation, 0.5 + 0.5 * value], -1)
    return torch.from_numpy(hsv_to_rgb(hsv.numpy())).float()


def recolor(colors: Tensor, origins: Tensor, generator: torch.Generator) -> Tensor:
    """Return colours [M, 3] after a densification step: children get new ones, other Gaussians keep theirs.

    `origins`, int64 [M], are the indices before the step of each Gaussian, or of its parent.
    """
    is_child = torch.bincount(origins, minlength=len(colors))[origins] > 1  # [M]
    return torch.where(is_child[:, None], random_colors(len(origins), generator).to(colors), colors[origins])
