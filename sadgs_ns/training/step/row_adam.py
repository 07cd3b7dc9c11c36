"""Adam of a table whose rows are not all used in each step, such as that of camera poses.

torch's Adam moves every row in every step, by the moments of earlier ones: a camera that is seen once in 26 steps goes
five times as far as its learning rate says. Here a row moves only in a step that uses it.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from sadgs_ns.kernels import use_triton
from sadgs_ns.training.step.nonfinite import MAX_GRADIENT, leave_out_nonfinite


class RowUpdate(NamedTuple):
    """Which rows of a table [V, D] an update moves, and how far."""

    moved: Tensor  # bool [V]
    units: Tensor  # How far each number goes at a learning rate of 1. [V, D]


def empty_moments(
    table: Tensor,  # [V, D]
) -> dict[str, Tensor]:
    """Return Adam's state of a table before its first update.

    It has two moments [V, D], and the number of each row's updates [V].
    """
    return {
        "exp_avg": torch.zeros_like(table),
        "exp_avg_sq": torch.zeros_like(table),
        "step": torch.zeros_like(table[:, 0]),
    }


@torch.no_grad()
def move_rows(
    table: Tensor,  # [V, D]
    gradient: Tensor,  # [V, D]
    state: dict[str, Tensor],  # What `empty_moments` returned
    update: RowUpdate,
    rate: Tensor | float,  # Learning rate, a scalar
    betas: tuple[float, float],
    eps: float,
    nonfinite_flag: Tensor,  # Becomes NaN if a gradient was not finite. float32 [1]
) -> None:
    """Update some rows of a table in place, without waiting for the device; numbers that are not finite count as 0.

    A table [V, 6] on a device where Triton's kernels run takes one launch; its rate is a tensor, too.
    """
    if isinstance(rate, Tensor) and table.shape[1] == 6 and use_triton(table):
        from sadgs_ns.kernels import poses

        log_betas = math.log(betas[0]), math.log(betas[1])
        poses.move_rows(
            table,
            gradient,
            state,
            update.moved,
            update.units,
            rate,
            betas,
            log_betas,
            eps,
            nonfinite_flag,
            MAX_GRADIENT,
        )
        return
    gradient = gradient.clone()
    leave_out_nonfinite(gradient, nonfinite_flag)
    moved = update.moved[:, None]
    mean = state["exp_avg"]
    square = state["exp_avg_sq"]
    count = state["step"]
    mean.copy_(torch.where(moved, mean.lerp(gradient, 1 - betas[0]), mean))
    square.copy_(torch.where(moved, square.lerp(gradient.square(), 1 - betas[1]), square))
    count += update.moved
    done = count.clamp_min(1.0)[:, None]
    # 1 − β^t, which float32 would cancel: the weights of all updates so far.
    mean_weight = -torch.expm1(done * math.log(betas[0]))
    square_weight = -torch.expm1(done * math.log(betas[1]))
    root = (square / square_weight).sqrt()
    change = rate * update.units * (mean / mean_weight) / (root + eps)
    table -= torch.where(moved, change, 0.0)
