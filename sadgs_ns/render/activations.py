"""From the parameters that are optimized to standard deviations and opacities."""

from __future__ import annotations

import torch
from torch import Tensor

from sadgs_ns.kernels import use_triton


def activate(
    log_scales: Tensor,  # [N, 3]
    logits: Tensor,  # [N, 1]
    penalty: float = 0.0,
) -> tuple[Tensor, Tensor, Tensor | None]:
    """Compute the `scales` and `opacities` of `Gaussians` from their logarithms and logits.

    Also return numbers [P] whose sum (differentiate that only) is `penalty` times the mean opacity, or None for 0.
    """
    if use_triton(logits):
        from sadgs_ns.kernels.activations import activate as fused_activate

        return fused_activate(log_scales, logits, penalty)
    scales = torch.exp(log_scales)
    opacities = torch.sigmoid(logits).squeeze(-1)  # [N]
    penalties = None
    if penalty > 0:
        penalties = penalty * opacities.mean()[None]  # [1]
    return scales, opacities, penalties
