"""What a render still gets wrong, and in which Gaussians that lies (after Rota Bulò et al., Revising Densification)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import torch
import torch.nn.functional as F
from pytorch_msssim.ssim import gaussian_filter
from torch import Tensor

from sadgs_ns.losses import similarity_window
from sadgs_ns.rasterization import rasterize
from sadgs_ns.split import Params

_C1, _C2 = 0.01**2, 0.03**2
"""SSIM's constants for values in [0, 1]."""


@torch.no_grad()
def dissimilarity(predicted: Tensor, target: Tensor) -> Tensor:
    """1 − SSIM of every pixel, the mean over its channels; 0 at the border, where SSIM's window leaves the image.

    Args:
        predicted: Rendered views. [C, H, W, 3]
        target: Training views in [0, 1]. [C, H, W, 3]

    Returns:
        ≥ 0. [C, H, W]
    """
    x, y = (image.permute(0, 3, 1, 2) for image in (predicted, target))
    window = similarity_window(predicted.device, predicted.dtype)
    blurred = gaussian_filter(torch.cat([x, y, x * x, y * y, x * y]), window)
    mean_x, mean_y, mean_xx, mean_yy, mean_xy = blurred.chunk(5)
    luminance = (2 * mean_x * mean_y + _C1) / (mean_x.square() + mean_y.square() + _C1)
    covariance, variances = mean_xy - mean_x * mean_y, mean_xx - mean_x.square() + mean_yy - mean_y.square()
    wrong = (1 - luminance * (2 * covariance + _C2) / (variances + _C2)).mean(dim=1).clamp_min(0)  # [C, H − 10, W − 10]
    rows, columns = ((whole - part) // 2 for whole, part in zip(x.shape[2:], wrong.shape[1:], strict=True))
    return F.pad(wrong, (columns, columns, rows, rows))


def error_shares(
    params: Params,
    errors: Tensor,
    info: Mapping[str, Any],
    *,
    rasterize_mode: Literal["classic", "antialiased"] = "classic",
    fused: bool = True,
) -> Tensor:
    """Each Gaussian's share in a view's error: Σ over the pixels of the weight with which it is blended, times error.

    That is the derivative of the rendered error by the Gaussian's colour: it takes a rendering and its backward pass.

    Args:
        params: `means` [N, 3], `quats` [N, 4], log `scales` [N, 3], logit `opacities` [N] or [N, 1].
        errors: As of `dissimilarity`. [C, H, W]
        info: `viewmats` [C, 4, 4], `Ks` [C, 3, 3], and `width` and `height` in px.
        rasterize_mode: As the views were rendered.
        fused: As for `rasterize`.

    Returns:
        ≥ 0, in px. [C, N]
    """
    means, quats, scales, opacities = (params[name].detach() for name in ("means", "quats", "scales", "opacities"))
    with torch.enable_grad():
        # Three channels, since our kernels differentiate no other number; two of them have no error.
        colors = means.new_zeros((len(errors), len(means), 3)).requires_grad_()
        renders, _, _ = rasterize(
            means,
            quats,
            scales.exp(),
            opacities.flatten().sigmoid(),
            colors,
            info["viewmats"],
            info["Ks"],
            info["width"],
            info["height"],
            rasterize_mode=rasterize_mode,
            fused=fused,
        )
        (shares,) = torch.autograd.grad(renders, colors, F.pad(errors[..., None], (0, 2)))
    return shares[..., 0]
