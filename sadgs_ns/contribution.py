"""How much of the training views each Gaussian accounts for."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from sadgs_ns.rasterization import rasterize
from sadgs_ns.split import Params


def most_pixels(params: Params, views: Iterable[tuple[Tensor, Tensor, int, int]], fused: bool = True) -> Tensor:
    """The most pixels that each Gaussian accounts for in a view: the sum of its blending weights over the pixels.

    A weight is the derivative of a pixel by the Gaussian's colour, so the rasterizer's backward pass adds them up.

    Args:
        params: `means` [N, 3], `quats` [N, 4], log `scales` [N, 3], logit `opacities` [N] or [N, 1].
        views: World-to-camera matrix [4, 4], intrinsics in px [3, 3], width and height in px of each view.
        fused: As in `rasterize`.

    Returns:
        px, ≥ 0; 0 for a Gaussian that no view sees. [N]
    """
    means, quats = params["means"].detach(), params["quats"].detach()
    scales, opacities = params["scales"].detach().exp(), params["opacities"].detach().flatten().sigmoid()
    colors = torch.zeros_like(means).requires_grad_()  # [N, 3]
    most = means.new_zeros(len(means))
    with torch.enable_grad():
        for viewmat, K, width, height in views:
            renders, _, _ = rasterize(
                means, quats, scales, opacities, colors, viewmat[None], K[None], width, height, fused=fused
            )
            (weights,) = torch.autograd.grad(renders[..., 0].sum(), colors)
            torch.maximum(most, weights[:, 0], out=most)
    return most
