"""Adam, one kernel per parameter; torch's fused one reaches a third of the memory's bandwidth on Gaussians."""

# pyright: reportArgumentType=false, reportCallIssue=false, reportIndexIssue=false, reportGeneralTypeIssues=false
# (Triton's launch syntax, kernel[grid](...), and its functions are not in its types.)

from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

from sadgs_ns.finite import MAX_GRADIENT

_BLOCK = 1024


@triton.jit
def _moments_and_step(g, m, v, rate, scale, beta1, beta2, eps, noted, i, exists, MAX: tl.constexpr):
    usable = tl.abs(g) < MAX  # NaN compares as false
    tl.store(noted + i * 0, float("nan"), exists & ~usable)
    g = tl.where(usable, g, 0.0)
    m = beta1 * m + (1 - beta1) * g
    v = beta2 * v + (1 - beta2) * g * g
    return m, v, rate * m / (tl.sqrt(v) * scale + eps)


@triton.jit(do_not_specialize=["n"])
def _update(
    parameter, gradient, mean, square, noted, n, rate, scale, beta1, beta2, eps, MAX: tl.constexpr, BLOCK: tl.constexpr
):  # fmt: skip
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    if (tl.program_id(0) + 1).to(tl.int64) * BLOCK <= n:  # without a mask, memory is read in wide words
        g, m, v = tl.load(gradient + i), tl.load(mean + i), tl.load(square + i)
        m, v, change = _moments_and_step(g, m, v, rate, scale, beta1, beta2, eps, noted, i, i < n, MAX)
        tl.store(mean + i, m)
        tl.store(square + i, v)
        tl.store(parameter + i, tl.load(parameter + i) - change)
    else:
        exists = i < n
        g, m, v = tl.load(gradient + i, exists), tl.load(mean + i, exists), tl.load(square + i, exists)
        m, v, change = _moments_and_step(g, m, v, rate, scale, beta1, beta2, eps, noted, i, exists, MAX)
        tl.store(mean + i, m, exists)
        tl.store(square + i, v, exists)
        tl.store(parameter + i, tl.load(parameter + i, exists) - change, exists)


def adam_step(
    parameter: Tensor,
    gradient: Tensor,
    exp_avg: Tensor,
    exp_avg_sq: Tensor,
    noted: Tensor,
    *,
    step: int,
    lr: float,
    betas: tuple[float, float],
    eps: float,
) -> None:
    """Update a parameter and its moments in place, as torch's Adam without weight decay.

    A gradient that is NaN, or at least `finite.MAX_GRADIENT`, counts as 0.

    Args:
        parameter: Contiguous float32, any shape.
        gradient: Contiguous, of the same shape; so are the moments.
        exp_avg: Running mean of the gradient.
        exp_avg_sq: Running mean of its square.
        noted: Becomes NaN if there was such a gradient. float32 [1]
        step: Which update this is, from 1.
        lr: Learning rate.
        betas: Decay of the two running means, in [0, 1).
        eps: Added to the denominator.
    """
    rate, scale = lr / (1 - betas[0] ** step), (1 - betas[1] ** step) ** -0.5
    grid = (triton.cdiv(parameter.numel(), _BLOCK),)
    moments = (exp_avg, exp_avg_sq)
    _update[grid](
        parameter, gradient, *moments, noted, parameter.numel(), rate, scale, *betas, eps, MAX_GRADIENT, _BLOCK
    )  # fmt: skip
