"""The photometric loss L1 + SSIM + ℓ2 (paper, section 3.6)."""

from __future__ import annotations

import torch.nn.functional as F
from pytorch_msssim import ssim
from torch import Tensor


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
    l1 = F.l1_loss(predicted, target)
    l2 = F.mse_loss(predicted, target)
    similarity = ssim(predicted.permute(0, 3, 1, 2), target.permute(0, 3, 1, 2), data_range=1.0)
    return (1 - ssim_lambda) * l1 + ssim_lambda * (1 - similarity) + l2_lambda * l2, l2
