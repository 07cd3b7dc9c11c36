"""How much of the training views each Gaussian accounts for; what accounts for nothing is not needed."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

import torch
from torch import Tensor

from sadgs_ns.rasterization import rasterize
from sadgs_ns.split import Params


def most_pixels(
    params: Params,
    views: Iterable[tuple[Tensor, Tensor, int, int]],
    *,
    rasterize_mode: Literal["classic", "antialiased"] = "classic",
    fused: bool = True,
) -> Tensor:
    """The most pixels that each Gaussian accounts for in a view: the sum of its blending weights over the pixels.

    A weight is the derivative of a pixel by the Gaussian's colour, so the rasterizer's backward pass adds them up.

    Args:
        params: `means` [N, 3], `quats` [N, 4], log `scales` [N, 3], logit `opacities` [N] or [N, 1].
        views: World-to-camera matrices [C, 4, 4], intrinsics in px [C, 3, 3], width and height in px of views that are
            rendered together; a few at once keep the host from being the slowest.
        rasterize_mode: As in `rasterize`.
        fused: As in `rasterize`.

    Returns:
        px, ≥ 0; 0 for a Gaussian that no view sees. [N]
    """
    means, quats = params["means"].detach(), params["quats"].detach()
    scales, opacities = params["scales"].detach().exp(), params["opacities"].detach().flatten().sigmoid()
    most = means.new_zeros(len(means))
    with torch.enable_grad():
        for viewmats, Ks, width, height in views:
            colors = means.new_zeros((len(viewmats), *means.shape)).requires_grad_()  # [C, N, 3]
            renders, _, _ = rasterize(
                means, quats, scales, opacities, colors, viewmats, Ks, width, height,
                rasterize_mode=rasterize_mode, fused=fused,
            )  # fmt: skip
            (weights,) = torch.autograd.grad(renders[..., 0].sum(), colors)  # [C, N, 3]
            most = torch.maximum(most, weights[..., 0].amax(dim=0))
    return most
