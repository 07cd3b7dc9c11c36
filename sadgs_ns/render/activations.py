"""What the rasterizer takes of the parameters that are optimized: standard deviations and opacities."""

from __future__ import annotations

import torch
from torch import Tensor

from sadgs_ns.kernels import use_triton


def activate(
    log_scales: Tensor,  # [N, 3]
    logits: Tensor,  # [N, 1]
    penalty: float = 0.0,
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Compute standard deviations and opacities, and a penalty on the opacities.

    Args:
        log_scales: Logarithms of the standard deviations along the Gaussians' axes, in world units. [N, 3]
        logits: Logits of the opacities. [N, 1]
        penalty: Factor on the mean opacity, at least 0.

    Returns:
        Standard deviations in world units [N, 3]; opacities in [0, 1] [N]; and numbers [P] whose sum is their mean
        times `penalty`, and of which nothing but the sum may be differentiated, or None where `penalty` is 0.
    """
    if use_triton(logits):
        from sadgs_ns.kernels.activations import activate as fused_activate

        return fused_activate(log_scales, logits, penalty)
    opacities = torch.sigmoid(logits).squeeze(-1)
    return torch.exp(log_scales), opacities, penalty * opacities.mean()[None] if penalty > 0 else None
