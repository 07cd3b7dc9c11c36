"""Adam for all parameters in one launch; torch's fused Adam reaches a third of the memory's bandwidth on them."""

from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

from sadgs_ns.kernels import cdiv

_BLOCK = 1024  # Numbers that one program updates


@triton.jit
def _moments_and_step(g, m, v, rate, scale, beta1, beta2, eps, nonfinite_flag, i, exists, MAX: tl.constexpr):
    """Return a block's new moments and the change of its parameters; set the flag if a gradient must be left out."""
    usable = tl.abs(g) < MAX  # NaN compares as false
    tl.store(nonfinite_flag + i * 0, float("nan"), exists & ~usable)
    g = tl.where(usable, g, 0.0)
    m = beta1 * m + (1 - beta1) * g
    v = beta2 * v + (1 - beta2) * g * g
    return m, v, rate * m / (tl.sqrt(v) * scale + eps)


@triton.jit(do_not_specialize=["rows"])
def _update(
    parameters, gradients, means, squares, rates, scales, nonfinite_flag, overflowed, rows, beta1, beta2, eps,
    WIDTHS: tl.constexpr, FLAGS: tl.constexpr, MAX: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Update one block of one parameter, unless all flags are set.

    The programs of the grid go through the blocks of the first parameter, then of the second, and so on. A parameter
    has `rows` times its width in WIDTHS numbers. If the kernel took a tuple of these products, Triton would compile it
    anew for each choice of those that 16 divides.
    """
    block = tl.program_id(0).to(tl.int64)
    n = rows.to(tl.int64) * WIDTHS[0]
    parameter = parameters[0]
    gradient = gradients[0]
    rate = rates[0]
    mean = means[0]
    square = squares[0]
    scale = scales[0]
    for k in tl.static_range(1, len(WIDTHS)):
        if block * BLOCK >= n:  # the block belongs to a later parameter
            block -= tl.cdiv(n, BLOCK)
            n = rows.to(tl.int64) * WIDTHS[k]
            parameter = parameters[k]
            gradient = gradients[k]
            rate = rates[k]
            mean = means[k]
            square = squares[k]
            scale = scales[k]
    is_step = FLAGS == 0
    for k in tl.static_range(FLAGS):
        is_step = is_step | (tl.load(overflowed[k]) == 0)
    n = tl.where(is_step, n, 0)
    rate = tl.load(rate)
    scale = tl.load(scale)
    i = block * BLOCK + tl.arange(0, BLOCK)
    if (block + 1) * BLOCK <= n:  # the block is whole: without a mask, memory is read in wide words
        g = tl.load(gradient + i)
        m = tl.load(mean + i)
        v = tl.load(square + i)
        m, v, change = _moments_and_step(g, m, v, rate, scale, beta1, beta2, eps, nonfinite_flag, i, i < n, MAX)
        tl.store(mean + i, m)
        tl.store(square + i, v)
        tl.store(parameter + i, tl.load(parameter + i) - change)
    else:
        exists = i < n
        g = tl.load(gradient + i, exists)
        m = tl.load(mean + i, exists)
        v = tl.load(square + i, exists)
        m, v, change = _moments_and_step(g, m, v, rate, scale, beta1, beta2, eps, nonfinite_flag, i, exists, MAX)
        tl.store(mean + i, m, exists)
        tl.store(square + i, v, exists)
        tl.store(parameter + i, tl.load(parameter + i, exists) - change, exists)


def rate_and_scale(step: int, lr: float, betas: tuple[float, float]) -> tuple[float, float]:
    """Return Adam's factors on the mean of gradients and on the root of their mean square; `step` counts from 1."""
    return lr / (1 - betas[0] ** step), (1 - betas[1] ** step) ** -0.5


def adam_step(
    parameters: tuple[Tensor, ...], gradients: tuple[Tensor, ...],
    exp_avgs: tuple[Tensor, ...], exp_avg_sqs: tuple[Tensor, ...],
    factors: Tensor, nonfinite_flag: Tensor, overflowed: tuple[Tensor, ...] = (),
    *, betas: tuple[float, float], eps: float, max_gradient: float,
) -> None:  # fmt: skip
    """Update P parameters and their moments in place, in one launch, as torch's Adam without weight decay.

    A gradient that is NaN, or whose absolute value is not below `max_gradient`, counts as 0.

    Args:
        parameters: Contiguous float32; so are the gradients and both moments, of the same shapes. [N, ...] each
        factors: The results of `rate_and_scale`, on the device, so that a CUDA graph can repeat the launch.
            Contiguous float32 [2, P]
        nonfinite_flag: Becomes NaN if there was such a gradient. float32 [1]
        overflowed: Flags; if there are some and none is 0, nothing is changed. int64 [1] each
    """
    rows = parameters[0].shape[:1].numel()  # 1 without dimensions
    widths = tuple(parameter.shape[1:].numel() for parameter in parameters)
    rates, scales = (row.unbind() for row in factors)
    grid = (sum(cdiv(rows * width, _BLOCK) for width in widths),)
    _update[grid](
        parameters, gradients, exp_avgs, exp_avg_sqs, rates, scales,
        nonfinite_flag, overflowed or (nonfinite_flag,), rows, *betas, eps,
        widths, len(overflowed), max_gradient, _BLOCK,
    )  # fmt: skip
