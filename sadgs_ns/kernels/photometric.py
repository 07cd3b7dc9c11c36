"""`losses.photometric_loss` in five kernels: two separable blurs and the sums forward, the blurs' adjoints backward.

Images stay [C, H, W, 3]: a row is 3W numbers, a horizontal neighbour 3 numbers away. The window is symmetric, so the
adjoint of a blur is the same blur of the zero-padded map. Sizes are not specialised: other images would compile anew.
"""

# pyright: reportArgumentType=false, reportCallIssue=false, reportIndexIssue=false
# (Triton's launch syntax, kernel[grid](...), is not in its types.)

from __future__ import annotations

import math
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from sadgs_ns.losses import WINDOW

_WEIGHTS = [math.exp(-((k - WINDOW // 2) ** 2) / (2 * 1.5**2)) for k in range(WINDOW)]
_GAUSSIAN = tuple(weight / sum(_WEIGHTS) for weight in _WEIGHTS)
_STRIP, _ROWS, _COLUMNS = 1024, 16, 64  # numbers a program handles: along a row, or in a tile for vertical neighbours
_LANES = 4096  # partial sums that are added at once


@triton.jit(do_not_specialize=["n", "row"])
def _blur_along_rows(x, y, blurred, sums, n, row, GAUSSIAN: tl.constexpr, STRIP: tl.constexpr):
    """E[x], E[y], E[x²], E[y²], E[xy] of each row's valid part, and partial sums of |x − y| and (x − y)²."""
    i = tl.program_id(0) * STRIP + tl.arange(0, STRIP)
    inside = i < n
    valid = inside & (i % row < row - 3 * (len(GAUSSIAN) - 1))
    e_x = tl.zeros([STRIP], tl.float32)
    e_y, e_xx, e_yy, e_xy = e_x, e_x, e_x, e_x
    for k in tl.static_range(len(GAUSSIAN)):
        a, b = tl.load(x + i + 3 * k, valid, 0.0), tl.load(y + i + 3 * k, valid, 0.0)
        wa, wb = GAUSSIAN[k] * a, GAUSSIAN[k] * b
        e_x, e_y, e_xx, e_yy, e_xy = e_x + wa, e_y + wb, e_xx + wa * a, e_yy + wb * b, e_xy + wa * b
    size = tl.cast(n, tl.int64)
    tl.store(blurred + i, e_x, valid)
    tl.store(blurred + size + i, e_y, valid)
    tl.store(blurred + 2 * size + i, e_xx, valid)
    tl.store(blurred + 3 * size + i, e_yy, valid)
    tl.store(blurred + 4 * size + i, e_xy, valid)
    difference = tl.load(x + i, inside, 0.0) - tl.load(y + i, inside, 0.0)
    tl.store(sums + tl.program_id(0), tl.sum(tl.abs(difference)))
    tl.store(sums + tl.num_programs(0) + tl.program_id(0), tl.sum(difference * difference))


@triton.jit(do_not_specialize=["n", "height", "row"])
def _similarity(
    blurred, slopes, sums, n, height, row, GAUSSIAN: tl.constexpr, ROWS: tl.constexpr, COLUMNS: tl.constexpr
):
    """Blur along columns; partial sums of SSIM, and its derivatives by E[x], E[x²] and E[xy]."""
    r = tl.program_id(1) * ROWS + tl.arange(0, ROWS)[:, None]
    c = tl.program_id(0) * COLUMNS + tl.arange(0, COLUMNS)[None, :]
    valid = (r < height - (len(GAUSSIAN) - 1)) & (c < row - 3 * (len(GAUSSIAN) - 1))
    i = (tl.program_id(2) * height + r) * row + c
    size = tl.cast(n, tl.int64)
    e_x = tl.zeros([ROWS, COLUMNS], tl.float32)
    e_y, e_xx, e_yy, e_xy = e_x, e_x, e_x, e_x
    for k in tl.static_range(len(GAUSSIAN)):
        at = blurred + i + k * row
        e_x += GAUSSIAN[k] * tl.load(at, valid, 0.0)
        e_y += GAUSSIAN[k] * tl.load(at + size, valid, 0.0)
        e_xx += GAUSSIAN[k] * tl.load(at + 2 * size, valid, 0.0)
        e_yy += GAUSSIAN[k] * tl.load(at + 3 * size, valid, 0.0)
        e_xy += GAUSSIAN[k] * tl.load(at + 4 * size, valid, 0.0)
    c1, c2 = 0.01 * 0.01, 0.03 * 0.03
    of_means = 1 / (e_x * e_x + e_y * e_y + c1)
    luminance = (2 * e_x * e_y + c1) * of_means
    of_variances = 1 / (e_xx - e_x * e_x + e_yy - e_y * e_y + c2)
    structure = (2 * (e_xy - e_x * e_y) + c2) * of_variances
    by_xx = -luminance * structure * of_variances
    by_xy = 2 * luminance * of_variances
    by_x = 2 * (e_y - e_x * luminance) * of_means * structure - 2 * e_x * by_xx - e_y * by_xy
    tl.store(slopes + i, by_x, valid)
    tl.store(slopes + size + i, by_xx, valid)
    tl.store(slopes + 2 * size + i, by_xy, valid)
    program = (tl.program_id(2) * tl.num_programs(1) + tl.program_id(1)) * tl.num_programs(0) + tl.program_id(0)
    tl.store(sums + program, tl.sum(tl.where(valid, luminance * structure, 0.0)))


@triton.jit
def _total(values, count, LANES: tl.constexpr):
    """Sum of all, in an order that is always the same. Each lane adds few, so that rounding stays that of a tree."""
    sums = tl.zeros([LANES], tl.float32)
    for start in range(0, count, LANES):
        i = start + tl.arange(0, LANES)
        sums += tl.load(values + i, i < count, 0.0)
    return tl.sum(sums)


@triton.jit(do_not_specialize=["n", "num_strips", "num_tiles"])
def _finish(
    differences, similarities, loss, psnr, n, num_strips, num_tiles, ssim_lambda, l1_weight, ssim_weight, l2_weight,
    LANES: tl.constexpr,
):  # fmt: skip
    """The loss and PSNR of the partial sums, in a program that runs once."""
    absolute, square = _total(differences, num_strips, LANES), _total(differences + num_strips, num_strips, LANES)
    of_ssim = ssim_lambda - ssim_weight * _total(similarities, num_tiles, LANES)
    tl.store(loss + tl.program_id(0), l1_weight * absolute + of_ssim + l2_weight * square)
    mse = square / n
    decibels = -3.010299956639812 * tl.log2(tl.where(mse > 0, mse, 1.0))
    tl.store(psnr + tl.program_id(0), tl.where(mse > 0, decibels, tl.where(mse == 0, float("inf"), mse)))


@triton.jit(do_not_specialize=["n", "height", "row"])
def _spread_along_rows(slopes, spread, n, height, row, GAUSSIAN: tl.constexpr, STRIP: tl.constexpr):
    """Adjoint of the blur along rows, of all three derivatives."""
    i = tl.program_id(0) * STRIP + tl.arange(0, STRIP)
    c = i % row
    inside = (i < n) & (i // row % height < height - (len(GAUSSIAN) - 1))
    size = tl.cast(n, tl.int64)
    by_x = tl.zeros([STRIP], tl.float32)
    by_xx, by_xy = by_x, by_x
    for k in tl.static_range(len(GAUSSIAN)):
        valid = inside & (c >= 3 * k) & (c - 3 * k < row - 3 * (len(GAUSSIAN) - 1))
        at = slopes + i - 3 * k
        by_x += GAUSSIAN[k] * tl.load(at, valid, 0.0)
        by_xx += GAUSSIAN[k] * tl.load(at + size, valid, 0.0)
        by_xy += GAUSSIAN[k] * tl.load(at + 2 * size, valid, 0.0)
    tl.store(spread + i, by_x, inside)
    tl.store(spread + size + i, by_xx, inside)
    tl.store(spread + 2 * size + i, by_xy, inside)


@triton.jit(do_not_specialize=["n", "height", "row"])
def _gradient(
    x, y, spread, upstream, gradient, n, height, row, l1_weight, ssim_weight, l2_weight,
    GAUSSIAN: tl.constexpr, ROWS: tl.constexpr, COLUMNS: tl.constexpr,
):  # fmt: skip
    """Adjoint of the blur along columns, and the gradient of the whole loss by x."""
    r = tl.program_id(1) * ROWS + tl.arange(0, ROWS)[:, None]
    c = tl.program_id(0) * COLUMNS + tl.arange(0, COLUMNS)[None, :]
    inside = (r < height) & (c < row)
    i = (tl.program_id(2) * height + r) * row + c
    size = tl.cast(n, tl.int64)
    by_x = tl.zeros([ROWS, COLUMNS], tl.float32)
    by_xx, by_xy = by_x, by_x
    for k in tl.static_range(len(GAUSSIAN)):
        valid = inside & (r >= k) & (r - k < height - (len(GAUSSIAN) - 1))
        at = spread + i - k * row
        by_x += GAUSSIAN[k] * tl.load(at, valid, 0.0)
        by_xx += GAUSSIAN[k] * tl.load(at + size, valid, 0.0)
        by_xy += GAUSSIAN[k] * tl.load(at + 2 * size, valid, 0.0)
    a, b = tl.load(x + i, inside, 0.0), tl.load(y + i, inside, 0.0)
    sign = tl.where(a > b, 1.0, 0.0) - tl.where(a < b, 1.0, 0.0)
    of_ssim = by_x + 2 * a * by_xx + b * by_xy
    total = l1_weight * sign + 2 * l2_weight * (a - b) - ssim_weight * of_ssim
    tl.store(gradient + i, tl.load(upstream) * total, inside)


class _PhotometricLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, y: Tensor, ssim_lambda: float, l2_lambda: float) -> tuple[Tensor, Tensor]:
        views, height, width, _ = x.shape
        n, row = x.numel(), 3 * width
        blurred, slopes = x.new_empty((5, n)), x.new_empty((3, n))
        strips = triton.cdiv(n, _STRIP)
        tiles = (triton.cdiv(row, _COLUMNS), triton.cdiv(height, _ROWS), views)
        differences, similarities = x.new_empty((2, strips)), x.new_empty(math.prod(tiles))
        _blur_along_rows[strips,](x, y, blurred, differences, n, row, _GAUSSIAN, _STRIP)
        _similarity[tiles](blurred, slopes, similarities, n, height, row, _GAUSSIAN, _ROWS, _COLUMNS)
        ctx.save_for_backward(x, y, slopes)
        n_valid = 3 * views * (height - WINDOW + 1) * (width - WINDOW + 1)
        ctx.weights = (1 - ssim_lambda) / n, ssim_lambda / n_valid, l2_lambda / n
        loss, psnr = x.new_empty(()), x.new_empty(())
        _finish[1,](
            differences, similarities, loss, psnr, n, strips, similarities.numel(), ssim_lambda, *ctx.weights, _LANES,
            num_warps=8,
        )  # fmt: skip
        ctx.mark_non_differentiable(psnr)
        ctx.set_materialize_grads(False)  # PSNR's would be filled with zeros on the device
        return loss, psnr

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, upstream: Tensor, _: Tensor) -> tuple[Tensor, None, None, None]:
        x, y, slopes = ctx.saved_tensors
        views, height, width, _ = x.shape
        n, row = x.numel(), 3 * width
        spread, gradient = torch.empty_like(slopes), torch.empty_like(x)
        tiles = (triton.cdiv(row, _COLUMNS), triton.cdiv(height, _ROWS), views)
        _spread_along_rows[triton.cdiv(n, _STRIP),](slopes, spread, n, height, row, _GAUSSIAN, _STRIP)
        _gradient[tiles](
            x, y, spread, upstream, gradient, n, height, row, *ctx.weights, _GAUSSIAN, _ROWS, _COLUMNS
        )  # fmt: skip
        return gradient, None, None, None


def photometric_loss(
    predicted: Tensor, target: Tensor, *, ssim_lambda: float, l2_lambda: float
) -> tuple[Tensor, Tensor]:
    """As `losses.photometric_loss`, for views of at least 11×11 px; PSNR carries no gradient.

    Args:
        predicted: float32 [C, H, W, 3]
        target: float32 [C, H, W, 3]
        ssim_lambda: λ in [0, 1].
        l2_lambda: λ_2 ≥ 0.

    Returns:
        The loss and PSNR in dB, both scalars.
    """
    return _PhotometricLoss.apply(predicted.contiguous(), target.contiguous(), ssim_lambda, l2_lambda)  # type: ignore[return-value]
