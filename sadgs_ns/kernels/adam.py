"""Adam for all parameters in one launch.

On parameters of Gaussians torch's fused Adam reaches a third of the memory's bandwidth.
"""

# pyright: reportArgumentType=false, reportCallIssue=false, reportIndexIssue=false, reportGeneralTypeIssues=false
# (Triton's launch syntax, kernel[grid](...), and its functions are not in its types.)

from __future__ import annotations

from collections.abc import Sequence

import triton
import triton.language as tl
from torch import Tensor

from sadgs_ns.kernels import cdiv

_BLOCK = 1024
"""Numbers that one program updates."""


@triton.jit
def _moments_and_step(g, m, v, rate, scale, beta1, beta2, eps, noted, i, exists, MAX: tl.constexpr):
    """New moments of a block, and the change of its parameters; notes a gradient that must be left out."""
    usable = tl.abs(g) < MAX  # NaN compares as false
    tl.store(noted + i * 0, float("nan"), exists & ~usable)
    g = tl.where(usable, g, 0.0)
    m = beta1 * m + (1 - beta1) * g
    v = beta2 * v + (1 - beta2) * g * g
    return m, v, rate * m / (tl.sqrt(v) * scale + eps)


@triton.jit(do_not_specialize=["rows"])
def _update(
    parameters, gradients, means, squares, rates, scales, noted, rows, beta1, beta2, eps,
    WIDTHS: tl.constexpr, MAX: tl.constexpr, BLOCK: tl.constexpr, ON_DEVICE: tl.constexpr,
):  # fmt: skip
    """Update a block of one of the parameters, which together are covered by the grid.

    With ON_DEVICE `rates` and `scales` are pointers to the numbers.

    The parameters' sizes are computed from `rows` here. If they were passed as a tuple, Triton would specialise the
    kernel on which of them 16 divides, and compile anew when densification changes that.
    """
    block = tl.program_id(0).to(tl.int64)
    n = rows.to(tl.int64) * WIDTHS[0]
    parameter, gradient, mean, square, rate, scale = (
        parameters[0], gradients[0], means[0], squares[0], rates[0], scales[0]
    )  # fmt: skip
    for k in tl.static_range(1, len(WIDTHS)):
        if block * BLOCK >= n:  # the block belongs to a later parameter
            block -= tl.cdiv(n, BLOCK)
            n = rows.to(tl.int64) * WIDTHS[k]
            parameter, gradient, mean, square, rate, scale = (
                parameters[k], gradients[k], means[k], squares[k], rates[k], scales[k]
            )  # fmt: skip
    if ON_DEVICE:
        rate, scale = tl.load(rate), tl.load(scale)
    i = block * BLOCK + tl.arange(0, BLOCK)
    if (block + 1) * BLOCK <= n:  # the block is whole: without a mask, memory is read in wide words
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


def rates_and_scales(
    steps: Sequence[int], lrs: Sequence[float], betas: tuple[float, float]
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return what an update does with the corrections of Adam's running means, which begin at 0.

    Args:
        steps: Which update this is of each parameter, from 1.
        lrs: Learning rate of each.
        betas: Decay of the two running means, in [0, 1).

    Returns:
        Factors on the running means of the gradients, and on the roots of those of their squares.
    """
    beta1, beta2 = betas
    rates = tuple(lr / (1 - beta1**step) for lr, step in zip(lrs, steps, strict=True))
    return rates, tuple((1 - beta2**step) ** -0.5 for step in steps)


def adam_step(
    parameters: tuple[Tensor, ...],
    gradients: tuple[Tensor, ...],
    exp_avgs: tuple[Tensor, ...],
    exp_avg_sqs: tuple[Tensor, ...],
    noted: Tensor,
    *,
    steps: Sequence[int],
    lrs: Sequence[float],
    betas: tuple[float, float],
    eps: float,
    max_gradient: float,
) -> None:
    """Update parameters and their moments in place, in one launch, as torch's Adam without weight decay.

    A gradient that is NaN, or not below `max_gradient`, counts as 0.

    Args:
        parameters: One or more, contiguous float32, all of the same length. [N, ...] each
        gradients: Contiguous, each of its parameter's shape; so are the moments.
        exp_avgs: Running means of the gradients.
        exp_avg_sqs: Running means of their squares.
        noted: Becomes NaN if there was such a gradient. float32 [1]
        steps: Which update this is of each parameter, from 1.
        lrs: Learning rate of each.
        betas: Decay of the two running means, in [0, 1).
        eps: Added to the denominator.
        max_gradient: Absolute value from which a gradient is left out.
    """
    factors = rates_and_scales(steps, lrs, betas)
    _launch(parameters, gradients, exp_avgs, exp_avg_sqs, noted, factors, betas, eps, max_gradient)


def adam_step_with_factors(
    parameters: tuple[Tensor, ...],
    gradients: tuple[Tensor, ...],
    exp_avgs: tuple[Tensor, ...],
    exp_avg_sqs: tuple[Tensor, ...],
    noted: Tensor,
    factors: Tensor,
    *,
    betas: tuple[float, float],
    eps: float,
    max_gradient: float,
) -> None:
    """Compute `adam_step` to the bit, in a launch whose arguments are the same in every update of a parameter.

    `factors` are what `rates_and_scales` returns for this update, on the device, contiguous float32 [2, P], in the
    place of `steps` and `lrs`.
    """
    rates, scales = (row.unbind() for row in factors)
    _launch(parameters, gradients, exp_avgs, exp_avg_sqs, noted, (rates, scales), betas, eps, max_gradient)


def _launch(
    parameters: tuple[Tensor, ...],
    gradients: tuple[Tensor, ...],
    exp_avgs: tuple[Tensor, ...],
    exp_avg_sqs: tuple[Tensor, ...],
    noted: Tensor,
    factors: tuple[tuple[float, ...], tuple[float, ...]] | tuple[tuple[Tensor, ...], tuple[Tensor, ...]],
    betas: tuple[float, float],
    eps: float,
    max_gradient: float,
) -> None:
    """Launch the kernel with factors that are numbers, or scalars on the device."""
    rows = parameters[0].shape[:1].numel()  # 1 without dimensions
    widths = tuple(parameter.shape[1:].numel() for parameter in parameters)
    grid = (sum(cdiv(rows * width, _BLOCK) for width in widths),)
    _update[grid](
        parameters, gradients, exp_avgs, exp_avg_sqs, *factors, noted, rows, *betas, eps,
        widths, max_gradient, _BLOCK, isinstance(factors[0][0], Tensor),
    )  # fmt: skip
