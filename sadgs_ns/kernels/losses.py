"""`method.losses.photometric_loss` in five kernels: separable blurs and sums forward, the blurs' adjoints backward.

Images stay [C, H, W, 3]: a row has 3W numbers, and a horizontal neighbour lies 3 numbers away. The window is symmetric,
so that the adjoint of a blur is the same blur of the zero-padded map. Specialised sizes would make Triton compile anew.
"""

from __future__ import annotations

import math
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from sadgs_ns.kernels import cdiv
from sadgs_ns.kernels.limits import check_pixels
from sadgs_ns.kernels.shared import load3, store3

_STRIP = 256  # Numbers along the rows that one program handles
_RUN = 8  # Rows of numbers that one program handles
_COLUMNS = 128  # Columns of numbers that one program handles
_LANES = 4096  # Partial sums that are added at once


@triton.jit
def _target(y, i, exists):
    """Load numbers of the training views, which are floats or bytes in memory, as floats in [0, 1]."""
    value = tl.load(y + i, exists, 0).to(tl.float32)
    if y.dtype.element_ty == tl.uint8:
        value = value * 0.00392156862745098  # As torch divides by 255 on CUDA.
    return value


# One view of several may begin at no multiple of 16 bytes: Triton would compile another kernel for that.
@triton.jit(do_not_specialize=["n"], do_not_specialize_on_alignment=["y"])
def _blur_along_rows(x, y, blurred, sums, n, GAUSSIAN: tl.constexpr, STRIP: tl.constexpr):
    """Blur x, y, x², y² and xy along the rows, and sum |x − y| and (x − y)² in parts.

    The window begins at each number. Values of windows that leave the row are never read.
    """
    i = tl.program_id(0) * STRIP + tl.arange(0, STRIP)
    inside = i < n
    e_x = tl.zeros([STRIP], tl.float32)
    e_y = e_x
    e_xx = e_x
    e_yy = e_x
    e_xy = e_x
    for k in tl.static_range(len(GAUSSIAN)):
        exists = i < n - 3 * k
        a = tl.load(x + i + 3 * k, exists, 0.0)
        b = _target(y, i + 3 * k, exists)
        wa = GAUSSIAN[k] * a
        wb = GAUSSIAN[k] * b
        e_x = e_x + wa
        e_y = e_y + wb
        e_xx = e_xx + wa * a
        e_yy = e_yy + wb * b
        e_xy = e_xy + wa * b
    size = tl.cast(n, tl.int64)
    store3(blurred, i, e_x, e_y, e_xx, inside, size)
    tl.store(blurred + 3 * size + i, e_yy, inside)
    tl.store(blurred + 4 * size + i, e_xy, inside)
    difference = tl.load(x + i, inside, 0.0) - _target(y, i, inside)
    tl.store(sums + tl.program_id(0), tl.sum(tl.abs(difference)))
    tl.store(sums + tl.num_programs(0) + tl.program_id(0), tl.sum(difference * difference))


@triton.jit
def _blur_along_columns(x, i, row, begin, end, exists, GAUSSIAN: tl.constexpr, RUN: tl.constexpr):
    """Blur RUN numbers below each other in the columns from i on; rows from `begin` to `end` exist.

    Each number is loaded once for all of them: with loads for each by itself the kernels took 255 registers, not 96.
    """
    zero = tl.zeros_like(i).to(tl.float32)
    blurred = ()
    for _ in tl.static_range(RUN):
        blurred = blurred + (zero,)  # noqa: RUF005 (Triton knows no starred expressions)
    for k in tl.static_range(RUN + len(GAUSSIAN) - 1):
        value = tl.load(x + i + k * row, exists & (k >= begin) & (k < end), 0.0)
        added = ()
        for t in tl.static_range(RUN):
            if k >= t and k - t < len(GAUSSIAN):
                added = added + (blurred[t] + GAUSSIAN[k - t] * value,)  # noqa: RUF005
            else:
                added = added + (blurred[t],)  # noqa: RUF005
        blurred = added
    return blurred


@triton.jit(do_not_specialize=["n", "height", "row"])
def _similarity(
    blurred, slopes, sums, n, height, row, GAUSSIAN: tl.constexpr, RUN: tl.constexpr, COLUMNS: tl.constexpr
):
    """Blur along the columns, sum SSIM in parts, and write its derivatives by E[x], E[x²] and E[xy].

    The derivatives are 0 where no whole window begins.
    """
    c = tl.program_id(0) * COLUMNS + tl.arange(0, COLUMNS)
    first = tl.program_id(1) * RUN
    exists = c < row - 3 * (len(GAUSSIAN) - 1)
    i = (tl.program_id(2) * height + first) * row + c
    size = tl.cast(n, tl.int64)
    x = _blur_along_columns(blurred, i, row, 0, height - first, exists, GAUSSIAN, RUN)
    y = _blur_along_columns(blurred + size, i, row, 0, height - first, exists, GAUSSIAN, RUN)
    xx = _blur_along_columns(blurred + 2 * size, i, row, 0, height - first, exists, GAUSSIAN, RUN)
    yy = _blur_along_columns(blurred + 3 * size, i, row, 0, height - first, exists, GAUSSIAN, RUN)
    xy = _blur_along_columns(blurred + 4 * size, i, row, 0, height - first, exists, GAUSSIAN, RUN)
    c1 = 0.01 * 0.01
    c2 = 0.03 * 0.03
    similarity = tl.zeros([COLUMNS], tl.float32)
    for t in tl.static_range(RUN):
        e_x = x[t]
        e_y = y[t]
        e_xx = xx[t]
        e_yy = yy[t]
        e_xy = xy[t]
        valid = exists & (first + t < height - (len(GAUSSIAN) - 1))
        of_means = 1 / (e_x * e_x + e_y * e_y + c1)
        luminance = (2 * e_x * e_y + c1) * of_means
        of_variances = 1 / (e_xx - e_x * e_x + e_yy - e_y * e_y + c2)
        structure = (2 * (e_xy - e_x * e_y) + c2) * of_variances
        by_xx = -luminance * structure * of_variances
        by_xy = 2 * luminance * of_variances
        by_x = 2 * (e_y - e_x * luminance) * of_means * structure - 2 * e_x * by_xx - e_y * by_xy
        inside = (c < row) & (first + t < height)
        by_x = tl.where(valid, by_x, 0.0)
        by_xx = tl.where(valid, by_xx, 0.0)
        by_xy = tl.where(valid, by_xy, 0.0)
        store3(slopes, i + t * row, by_x, by_xx, by_xy, inside, size)
        similarity += tl.where(valid, luminance * structure, 0.0)
    program = (tl.program_id(2) * tl.num_programs(1) + tl.program_id(1)) * tl.num_programs(0) + tl.program_id(0)
    tl.store(sums + program, tl.sum(similarity))


@triton.jit
def _total(values, count, LANES: tl.constexpr):
    """Sum all values in an order that is always the same; each lane adds few, so that rounding stays a tree's."""
    sums = tl.zeros([LANES], tl.float32)
    for start in range(0, count, LANES):
        i = start + tl.arange(0, LANES)
        sums += tl.load(values + i, i < count, 0.0)
    return tl.sum(sums)


@triton.jit(do_not_specialize=["n", "num_strips", "num_tiles", "num_parts"])
def _finish(
    differences, similarities, parts, loss, psnr, n, num_strips, num_tiles, num_parts,
    ssim_lambda, l1_weight, ssim_weight, l2_weight, LANES: tl.constexpr,
):  # fmt: skip
    """Compute the loss and PSNR from the partial sums, in one program, and add the sum of `parts` to the loss."""
    absolute = _total(differences, num_strips, LANES)
    square = _total(differences + num_strips, num_strips, LANES)
    of_ssim = ssim_lambda - ssim_weight * _total(similarities, num_tiles, LANES)
    photometric = l1_weight * absolute + of_ssim + l2_weight * square
    tl.store(loss + tl.program_id(0), photometric + _total(parts, num_parts, LANES))
    mse = square / n
    decibels = -3.010299956639812 * tl.log2(tl.where(mse > 0, mse, 1.0))
    tl.store(psnr + tl.program_id(0), tl.where(mse > 0, decibels, tl.where(mse == 0, float("inf"), mse)))


@triton.jit(do_not_specialize=["n"])
def _spread_along_rows(slopes, spread, n, GAUSSIAN: tl.constexpr, STRIP: tl.constexpr):
    """Apply the blur's adjoint along the rows to three derivatives; before a row lie the zeros of another's end."""
    i = tl.program_id(0) * STRIP + tl.arange(0, STRIP)
    size = tl.cast(n, tl.int64)
    by_x = tl.zeros([STRIP], tl.float32)
    by_xx = by_x
    by_xy = by_x
    for k in tl.static_range(len(GAUSSIAN)):
        exists = (i < n) & (i >= 3 * k)
        x, xx, xy = load3(slopes, i - 3 * k, exists, size)
        by_x = by_x + GAUSSIAN[k] * x
        by_xx = by_xx + GAUSSIAN[k] * xx
        by_xy = by_xy + GAUSSIAN[k] * xy
    store3(spread, i, by_x, by_xx, by_xy, i < n, size)


@triton.jit(do_not_specialize=["n", "height", "row"], do_not_specialize_on_alignment=["y"])
def _gradient(
    x, y, spread, upstream, gradient, n, height, row, l1_weight, ssim_weight, l2_weight,
    GAUSSIAN: tl.constexpr, RUN: tl.constexpr, COLUMNS: tl.constexpr,
):  # fmt: skip
    """Apply the blur's adjoint along the columns, and compute with it the gradient of the whole loss by x."""
    c = tl.program_id(0) * COLUMNS + tl.arange(0, COLUMNS)
    first = tl.program_id(1) * RUN
    exists = c < row
    i = (tl.program_id(2) * height + first) * row + c
    size = tl.cast(n, tl.int64)
    above = tl.constexpr(len(GAUSSIAN) - 1)
    begin = above - first
    end = height - first
    by_x = _blur_along_columns(spread, i - above * row, row, begin, end, exists, GAUSSIAN, RUN)
    by_xx = _blur_along_columns(spread + size, i - above * row, row, begin, end, exists, GAUSSIAN, RUN)
    by_xy = _blur_along_columns(spread + 2 * size, i - above * row, row, begin, end, exists, GAUSSIAN, RUN)
    for t in tl.static_range(RUN):
        inside = exists & (first + t < height)
        a = tl.load(x + i + t * row, inside, 0.0)
        b = _target(y, i + t * row, inside)
        sign = tl.where(a > b, 1.0, 0.0) - tl.where(a < b, 1.0, 0.0)
        of_ssim = by_x[t] + 2 * a * by_xx[t] + b * by_xy[t]
        total = l1_weight * sign + 2 * l2_weight * (a - b) - ssim_weight * of_ssim
        tl.store(gradient + i + t * row, tl.load(upstream) * total, inside)


class _PhotometricLoss(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, x: Tensor, y: Tensor, window: tuple[float, ...], ssim_lambda: float, l2_lambda: float,
        parts: Tensor | None,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        views, height, width, _ = x.shape
        n = x.numel()
        row = 3 * width
        blurred = x.new_empty((5, n))
        slopes = x.new_empty((3, n))
        strips = cdiv(n, _STRIP)
        tiles = (cdiv(row, _COLUMNS), cdiv(height, _RUN), views)
        differences = x.new_empty((2, strips))
        similarities = x.new_empty(math.prod(tiles))
        _blur_along_rows[strips,](x, y, blurred, differences, n, window, _STRIP)
        _similarity[tiles](blurred, slopes, similarities, n, height, row, window, _RUN, _COLUMNS)
        ctx.save_for_backward(x, y, slopes)
        ctx.window = window
        ctx.num_parts = 0 if parts is None else len(parts)
        n_valid = 3 * views * (height - len(window) + 1) * (width - len(window) + 1)
        ctx.weights = (1 - ssim_lambda) / n, ssim_lambda / n_valid, l2_lambda / n
        loss = x.new_empty(())
        psnr = x.new_empty(())
        _finish[1,](
            differences, similarities, differences if parts is None else parts, loss, psnr,
            n, strips, similarities.numel(), ctx.num_parts, ssim_lambda, *ctx.weights, _LANES, num_warps=8,
        )  # fmt: skip
        ctx.mark_non_differentiable(psnr)
        ctx.set_materialize_grads(False)  # torch would fill PSNR's gradient with zeros on the device
        return loss, psnr

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, upstream: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        x, y, slopes = ctx.saved_tensors
        views, height, width, _ = x.shape
        n = x.numel()
        row = 3 * width
        spread = torch.empty_like(slopes)
        gradient = torch.empty_like(x)
        tiles = (cdiv(row, _COLUMNS), cdiv(height, _RUN), views)
        _spread_along_rows[cdiv(n, _STRIP),](slopes, spread, n, ctx.window, _STRIP)
        _gradient[tiles](x, y, spread, upstream, gradient, n, height, row, *ctx.weights, ctx.window, _RUN, _COLUMNS)
        return gradient, *[None] * 4, upstream.expand(ctx.num_parts) if ctx.num_parts else None


def photometric_loss(
    predicted: Tensor, target: Tensor, window: tuple[float, ...],
    *, ssim_lambda: float, l2_lambda: float, parts: Tensor | None = None,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Do what `method.losses.photometric_loss` does, for views at least as large as SSIM's window.

    `window` has its weights along one axis, and is symmetric. `predicted` and `parts` are float32, `parts` contiguous.
    """
    check_pixels(*predicted.shape[:3])
    return _PhotometricLoss.apply(  # type: ignore[return-value]
        predicted.contiguous(), target.contiguous(), window, ssim_lambda, l2_lambda, parts
    )
