"""How many Gaussians the device's memory holds, asked at the start and before more are made."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from sadgs_ns.method.split import Params

COPIES = 4
"""Tensors of a parameter's size that live between steps: itself, its gradient and Adam's two moments."""
WORKING_BYTES = 4000
"""Bytes a Gaussian takes during a step besides those: projections, tile lists, colours and their gradients. With them a
Gaussian of degree 3 takes 5 kB; with images and the views of a step the README's runs took 3.1 to 4.6 kB (bonsai,
south) and 7 kB (fox, four views of fewer Gaussians) when they had the most."""
STEP_BYTES = 300
"""Bytes a pixel of the views that are rendered together takes during a step, whoever computes the loss."""
PLANNED_SHARE = 0.8
"""Of the memory that is available at the start, what is planned with; the rest is for fragments and other programs."""


def available_bytes(device: torch.device) -> tuple[float, float]:
    """What this process may take of the device's memory in all, what it has taken included, and how large that is.

    Args:
        device: Any; without CUDA both are infinity, since an operating system's memory is nothing to plan with.
    """
    if device.type != "cuda":
        return math.inf, math.inf
    left, total = torch.cuda.mem_get_info(device)
    return float(left + torch.cuda.memory_reserved(device)), float(total)


def free_bytes(device: torch.device) -> float:
    """Bytes that new tensors may take: what the driver has left and what torch's allocator keeps unused.

    Args:
        device: Any; infinity without CUDA.
    """
    available, _ = available_bytes(device)
    return available - torch.cuda.memory_allocated(device) if device.type == "cuda" else available


def gaussian_bytes(params: Params, state: Mapping[str, Any]) -> int:
    """What one more Gaussian takes in training, in bytes: what is kept of it, and what moves at a split or a step.

    Args:
        params: Parameters, each with leading dimension N.
        state: The strategy's state; its tensors have leading dimension N, or 0 before the first step.
    """
    return _kept_bytes(params, state) + _moving_bytes(params)


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
    growth = (free - n * _moving_bytes(params)) / gaussian_bytes(params, state)
    return max(math.floor(growth), 0) if math.isfinite(growth) else growth


def _kept_bytes(params: Params, state: Mapping[str, Any]) -> int:
    tensors = [value for value in state.values() if isinstance(value, Tensor)]
    return COPIES * sum(map(_row_bytes, params.values())) + sum(map(_row_bytes, tensors))


def _moving_bytes(params: Params) -> int:
    """Each parameter is copied to its new length while the old one is still there, and the step's working memory, which
    is free between steps, is needed again by all.
    """
    return WORKING_BYTES + max(map(_row_bytes, params.values()))


def _row_bytes(tensor: Tensor) -> int:
    return math.prod(tensor.shape[1:]) * tensor.element_size()
