"""The photometric loss L1 + SSIM + ℓ2 (paper, section 3.6)."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor
from torch.autograd.function import once_differentiable

WINDOW, WINDOW_SIGMA = 11, 1.5
"""SSIM's Gaussian window in px, as in 3DGS."""
C1, C2 = 0.01**2, 0.03**2
"""SSIM's constants for images in [0, 1]."""
_BLOCK = 128
"""Outputs of one row of the banded matrix; more wastes arithmetic on zeros, fewer wastes memory traffic."""


@lru_cache(maxsize=16)
def _band(size: int, device: torch.device, dtype: torch.dtype) -> Tensor:
    """Banded matrix that blurs _BLOCK px of an axis with SSIM's Gaussian window.

    The window is cut to the largest odd length K that an axis of `size` px holds. [_BLOCK + K − 1, _BLOCK]
    """
    taps = min(WINDOW, size - 1 + size % 2)
    offset = torch.arange(taps, dtype=torch.float64) - taps // 2
    window = torch.exp(-0.5 * (offset / WINDOW_SIGMA) ** 2)
    window = window / window.sum()
    column = torch.arange(_BLOCK)
    band = torch.zeros((_BLOCK + taps - 1, _BLOCK), dtype=torch.float64)
    for k in range(taps):
        band[column + k, column] = window[k]
    return band.to(device=device, dtype=dtype)


def _blur_rows(image: Tensor, band: Tensor) -> Tensor:
    """Valid correlation along the last axis, as a product with a banded matrix. [..., W] → [..., W − K + 1]

    cuDNN's grouped convolutions are several times slower at this, above all backwards.
    """
    outputs = image.shape[-1] - (len(band) - _BLOCK)
    padded = F.pad(image, (0, -outputs % _BLOCK))
    blurred = padded.unfold(-1, len(band), _BLOCK) @ band  # [..., blocks, _BLOCK]
    return blurred.flatten(-2)[..., :outputs]


def _blur(image: Tensor, band_y: Tensor, band_x: Tensor) -> Tensor:
    """Valid separable correlation. [..., H, W] → [..., H − K_y + 1, W − K_x + 1]"""
    return _blur_rows(_blur_rows(image, band_x).mT, band_y).mT


class _MeanSSIM(torch.autograd.Function):
    """Mean SSIM over the valid region, differentiated in closed form with respect to the prediction."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, y: Tensor) -> Tensor:  # [C, 3, H, W] each
        bands = [_band(size, x.device, x.dtype) for size in x.shape[-2:]]
        mu_x, mu_y, xx, yy, xy = _blur(torch.stack([x, y, x * x, y * y, x * y]), *bands)
        a, b = 2 * mu_x * mu_y + C1, mu_x**2 + mu_y**2 + C1
        c, d = 2 * (xy - mu_x * mu_y) + C2, xx + yy - mu_x**2 - mu_y**2 + C2
        ssim = a * c / (b * d)
        if x.requires_grad:
            by_xx, by_xy = -ssim / d, 2 * a / (b * d)
            by_mu = 2 * mu_y * (c - a) / (b * d) + 2 * mu_x * ssim * (1 / d - 1 / b)
            ctx.save_for_backward(x, y, torch.stack([by_mu, by_xx, by_xy]), *bands)
        return ssim.mean()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad_output: Tensor) -> tuple[Tensor, None]:
        x, y, derivatives, band_y, band_x = ctx.saved_tensors
        pad_y, pad_x = len(band_y) - _BLOCK, len(band_x) - _BLOCK
        # The window is symmetric: the transpose of a valid correlation is a full one.
        by_mu, by_xx, by_xy = _blur(F.pad(derivatives, (pad_x, pad_x, pad_y, pad_y)), band_y, band_x)
        return grad_output / derivatives[0].numel() * (by_mu + 2 * x * by_xx + y * by_xy), None


def mean_ssim(predicted: Tensor, target: Tensor) -> Tensor:
    """Mean structural similarity over the pixels whose window lies inside the image.

    Equal to `pytorch_msssim.ssim(..., data_range=1)`; the gradient reaches the prediction only.

    Args:
        predicted: [C, 3, H, W]
        target: In [0, 1]. [C, 3, H, W]

    Returns:
        In [−1, 1], scalar.
    """
    return _MeanSSIM.apply(predicted, target)  # type: ignore[no-any-return]


def photometric_loss(
    predicted: Tensor, target: Tensor, *, ssim_lambda: float = 0.2, l2_lambda: float = 2.0
) -> tuple[Tensor, Tensor]:
    """(1 − λ) L1 + λ (1 − SSIM) + λ_2 ℓ2, each a mean over views, pixels and channels.

    The paper gives no weights; these defaults are the released code's.

    Args:
        predicted: Rendered views, not clamped, so that gradients reach colours outside [0, 1]. [C, H, W, 3]
        target: Training views in [0, 1]. [C, H, W, 3]
        ssim_lambda: λ in [0, 1].
        l2_lambda: λ_2 ≥ 0.

    Returns:
        The loss and the mean squared error, both scalars.
    """
    difference = predicted - target
    l1, l2 = difference.abs().mean(), difference.square().mean()
    similarity = mean_ssim(predicted.permute(0, 3, 1, 2).contiguous(), target.permute(0, 3, 1, 2).contiguous())
    return (1 - ssim_lambda) * l1 + ssim_lambda * (1 - similarity) + l2_lambda * l2, l2
