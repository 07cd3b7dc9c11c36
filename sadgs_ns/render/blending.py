"""Blend values of Gaussians, such as normals or η, into an image in the way colours are blended."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from sadgs_ns.render.rasterization import rasterize
from sadgs_ns.render.types import DEFAULTS, Cameras, Gaussians, RenderOptions


@torch.no_grad()
def blend(
    params: Mapping[str, Tensor], values: Tensor, camera: Cameras, drawing: RenderOptions = DEFAULTS
) -> tuple[Tensor, Tensor]:
    """Render an image of the Gaussians with these values in place of their colours.

    Args:
        params: Raw parameters of N Gaussians by name: means [N, 3], quats [N, 4], log scales [N, 3] and logit
            opacities [N] or [N, 1].
        values: D numbers of each Gaussian. [N, D]
        camera: A single camera with an image of H × W px.
        drawing: How the Gaussians are drawn.

    Returns:
        The blended values [H, W, D], and the share of each pixel that the Gaussians cover, in [0, 1] [H, W, 1].
    """
    opacities = torch.sigmoid(params["opacities"].flatten())
    scales = params["scales"].exp()
    gaussians = Gaussians(params["means"], params["quats"], scales, opacities, values)
    render, alpha, _ = rasterize(gaussians, camera, drawing)
    return render[0], alpha[0]
