"""How many more Gaussians the device's memory holds, asked before they are made."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from sadgs_ns.split import Params

COPIES = 4
"""Tensors of a parameter's size that live between steps: itself, its gradient and Adam's two moments."""
WORKING_BYTES = 4000
"""Bytes a Gaussian takes during a step besides those: projections, tile lists, colours and their gradients. With them a
Gaussian of degree 3 takes 5 kB; the peaks in the README's tables differ by 3.5 to 5.4 kB for each Gaussian more."""


def free_bytes(device: torch.device) -> float:
    """Bytes that new tensors may take: what the driver has left and what torch's allocator keeps unused.

    Args:
        device: Any; without CUDA the answer is infinity, since an operating system's memory is nothing to plan with.
    """
    if device.type != "cuda":
        return math.inf
    left, _ = torch.cuda.mem_get_info(device)
    return float(left + torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device))


def affordable_growth(params: Params, state: Mapping[str, Any], free: float) -> float:
    """How many Gaussians may be added so that adding them and the next training step fit.

    Args:
        params: Parameters, each with leading dimension N.
        state: The strategy's state; its tensors have leading dimension N.
        free: Bytes left, as `free_bytes` counts them; infinity allows infinitely many.

    Returns:
        ≥ 0, a whole number or infinity.
    """
    n = len(params["means"])
    rows = [_row_bytes(p) for p in params.values()]
    kept = COPIES * sum(rows) + sum(_row_bytes(value) for value in state.values() if isinstance(value, Tensor))
    # Each parameter is copied to its new length while the old one is still there, and the step's working memory, which
    # is free between steps, is needed again by all.
    moving = WORKING_BYTES + max(rows)
    growth = (free - n * moving) / (kept + moving)
    return max(math.floor(growth), 0) if math.isfinite(growth) else growth


def _row_bytes(tensor: Tensor) -> int:
    return math.prod(tensor.shape[1:]) * tensor.element_size()
