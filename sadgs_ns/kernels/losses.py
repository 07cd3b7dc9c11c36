"""`method.losses.photometric_loss` in three kernels: SSIM and differences, their sum, and the gradient.

A program walks down a strip of the image, a row at a time. It blurs the row from neighbours that the cache holds, and
adds the result to the ten windows that have begun above and are not complete, which stay in registers. So no blurred
map passes through memory: forward writes three derivatives of SSIM, which backward blurs in the same way.

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
from sadgs_ns.kernels.shared import reciprocal, store3

_COLUMNS = 128  # Columns of numbers that one program handles
_PROGRAMS = 792  # Programs that one launch has at most, if it can: so many an H100 or H200 runs at a time
_FEWEST_ROWS = 16  # Least rows of a strip; ten more are read for each
_LANES = 1024  # Partial sums that are added at once
_MARGIN = tl.constexpr(32)  # Zeros before the first row of derivatives; a window reaches 30 numbers to the left


@triton.jit
def _target(y, i, exists):
    """Load numbers of the training views, which are floats or bytes in memory, as floats in [0, 1]."""
    value = tl.load(y + i, exists, 0).to(tl.float32)
    if y.dtype.element_ty == tl.uint8:
        value = value * 0.00392156862745098  # As torch divides by 255 on CUDA.
    return value


@triton.jit
def _is_excused(rendered, photo, clipped_from):
    """Tell where the photo is clipped and the rendering is brighter, which is no error."""
    return (photo >= clipped_from) & (rendered > photo)


@triton.jit
def _no_windows(GAUSSIAN: tl.constexpr, COLUMNS: tl.constexpr):
    """Return the windows of `_add_row` before the first row."""
    windows = ()
    for _ in tl.static_range(len(GAUSSIAN) - 1):
        windows = windows + (tl.zeros([COLUMNS], tl.float32),)  # noqa: RUF005 (Triton knows no starred expressions)
    return windows


@triton.jit
def _add_row(windows, value, GAUSSIAN: tl.constexpr):
    """Add a row to the windows along the columns that contain it.

    Returns:
        The sum of the window that ends with this row, and those of the windows that have begun, the oldest first.
    """
    open_windows = ()
    for k in tl.static_range(1, len(GAUSSIAN) - 1):
        open_windows = open_windows + (windows[k] + GAUSSIAN[k] * value,)  # noqa: RUF005
    return windows[0] + GAUSSIAN[0] * value, open_windows + (GAUSSIAN[0] * value,)  # noqa: RUF005


@triton.jit
def _slopes(e_x, e_y, e_xx, e_yy, e_xy):
    """Return SSIM of windows, and its derivatives by E[x], E[x²] and E[xy].

    It depends on E[x²] + E[y²] alone, but one blur of both would err more where a photo is white.
    """
    c1 = 0.01 * 0.01
    c2 = 0.03 * 0.03
    of_means = reciprocal(e_x * e_x + e_y * e_y + c1)
    luminance = (2 * e_x * e_y + c1) * of_means
    of_variances = reciprocal(e_xx - e_x * e_x + e_yy - e_y * e_y + c2)
    structure = (2 * (e_xy - e_x * e_y) + c2) * of_variances
    by_xx = -luminance * structure * of_variances
    by_xy = 2 * luminance * of_variances
    by_x = 2 * (e_y - e_x * luminance) * of_means * structure - 2 * e_x * by_xx - e_y * by_xy
    return luminance * structure, by_x, by_xx, by_xy


# One view of several may begin at no multiple of 16 bytes: Triton would compile another kernel for that.
@triton.jit(do_not_specialize=["n", "height", "row", "rows"], do_not_specialize_on_alignment=["y"])
def _similarity(
    x, y, slopes, sums, n, height, row, rows, clipped_from,
    EXCUSES: tl.constexpr, GAUSSIAN: tl.constexpr, COLUMNS: tl.constexpr,
):  # fmt: skip
    """Sum SSIM, |x − y| and (x − y)² of a strip, and write SSIM's derivatives by E[x], E[x²] and E[xy].

    With EXCUSES, y takes the place of x where `_is_excused`. The derivatives lie where a window begins, and are 0 where
    no whole window does. `_MARGIN` zeros precede the first, so that before each row of each map lie the zeros of
    another's end.
    """
    reach = tl.constexpr(len(GAUSSIAN) - 1)
    c = tl.program_id(0) * COLUMNS + tl.arange(0, COLUMNS)
    first = tl.program_id(1) * rows
    last = tl.minimum(first + rows, height)
    inside = c < row
    whole = c < row - 3 * reach
    # What begins too far to the right is moved into the image: loads need no mask, and nothing reads the result.
    begin = tl.minimum(c, row - 3 * reach - 1)
    top = tl.program_id(2) * height * row
    size = tl.cast(n, tl.int64)
    zero = tl.zeros([COLUMNS], tl.float32)
    similarity = zero
    absolute = zero
    square = zero
    of_x = _no_windows(GAUSSIAN, COLUMNS)
    of_y = of_x
    of_xx = of_x
    of_yy = of_x
    of_xy = of_x
    for r in range(first, tl.minimum(last + reach, height)):
        x_row = x + (top + r * row + begin)
        y_row = y + (top + r * row + begin)
        e_x = zero
        e_y = zero
        e_xx = zero
        e_yy = zero
        e_xy = zero
        for k in tl.static_range(len(GAUSSIAN)):
            a = tl.load(x_row + 3 * k)
            b = _target(y_row, 3 * k, True)
            if EXCUSES:
                a = tl.where(_is_excused(a, b, clipped_from), b, a)
            wa = GAUSSIAN[k] * a
            wb = GAUSSIAN[k] * b
            e_x += wa
            e_y += wb
            e_xx += wa * a
            e_yy += wb * b
            e_xy += wa * b
        e_x, of_x = _add_row(of_x, e_x, GAUSSIAN)
        e_y, of_y = _add_row(of_y, e_y, GAUSSIAN)
        e_xx, of_xx = _add_row(of_xx, e_xx, GAUSSIAN)
        e_yy, of_yy = _add_row(of_yy, e_yy, GAUSSIAN)
        e_xy, of_xy = _add_row(of_xy, e_xy, GAUSSIAN)
        i = top + r * row + c
        counted = inside & (r < last)
        rendered = tl.load(x + i, counted, 0.0)
        photo = _target(y, i, counted)
        difference = rendered - photo
        if EXCUSES:
            difference = tl.where(_is_excused(rendered, photo, clipped_from), 0.0, difference)
        absolute += tl.abs(difference)
        square += difference * difference
        if r >= first + reach:  # The windows that end here have begun in this strip.
            of_window, by_x, by_xx, by_xy = _slopes(e_x, e_y, e_xx, e_yy, e_xy)
            similarity += tl.where(whole, of_window, 0.0)
            by_x = tl.where(whole, by_x, 0.0)
            by_xx = tl.where(whole, by_xx, 0.0)
            by_xy = tl.where(whole, by_xy, 0.0)
            store3(slopes, _MARGIN + i - reach * row, by_x, by_xx, by_xy, inside, size)
    for r in range(tl.maximum(first, height - reach), last):
        store3(slopes, _MARGIN + top + r * row + c, zero, zero, zero, inside, size)
    program = (tl.program_id(2) * tl.num_programs(1) + tl.program_id(1)) * tl.num_programs(0) + tl.program_id(0)
    if program == 0:
        tl.store(slopes + tl.arange(0, _MARGIN), tl.zeros([_MARGIN], tl.float32))
    programs = tl.num_programs(0) * tl.num_programs(1) * tl.num_programs(2)
    store3(sums, program, tl.sum(similarity), tl.sum(absolute), tl.sum(square), True, programs)


@triton.jit
def _total(values, count, LANES: tl.constexpr):
    """Sum all values in an order that is always the same; each lane adds few, so that rounding stays a tree's."""
    sums = tl.zeros([LANES], tl.float32)
    for start in range(0, count, LANES):
        i = start + tl.arange(0, LANES)
        sums += tl.load(values + i, i < count, 0.0)
    return tl.sum(sums)


@triton.jit(do_not_specialize=["n", "num_programs", "num_parts"])
def _finish(
    sums, parts, loss, psnr, n, num_programs, num_parts,
    ssim_lambda, l1_weight, ssim_weight, l2_weight, LANES: tl.constexpr,
):  # fmt: skip
    """Compute the loss and PSNR from the sums of `_similarity`, in one program, and add that of `parts` to the loss."""
    similarity = _total(sums, num_programs, LANES)
    absolute = _total(sums + num_programs, num_programs, LANES)
    square = _total(sums + 2 * num_programs, num_programs, LANES)
    photometric = l1_weight * absolute + (ssim_lambda - ssim_weight * similarity) + l2_weight * square
    tl.store(loss + tl.program_id(0), photometric + _total(parts, num_parts, LANES))
    mse = square / n
    decibels = -3.010299956639812 * tl.log2(tl.where(mse > 0, mse, 1.0))
    tl.store(psnr + tl.program_id(0), tl.where(mse > 0, decibels, tl.where(mse == 0, float("inf"), mse)))


@triton.jit(do_not_specialize=["n", "height", "row", "rows"], do_not_specialize_on_alignment=["y"])
def _gradient(
    x, y, slopes, upstream, gradient, n, height, row, rows, l1_weight, ssim_weight, l2_weight, clipped_from,
    EXCUSES: tl.constexpr, GAUSSIAN: tl.constexpr, COLUMNS: tl.constexpr,
):  # fmt: skip
    """Compute the gradient of the whole loss by x, with the adjoint of the blur of a strip's derivatives.

    With EXCUSES it is 0 where `_is_excused`.
    """
    reach = tl.constexpr(len(GAUSSIAN) - 1)
    c = tl.program_id(0) * COLUMNS + tl.arange(0, COLUMNS)
    first = tl.program_id(1) * rows
    last = tl.minimum(first + rows, height)
    inside = c < row
    end = tl.minimum(c, row - 1)  # Loads need no mask.
    top = tl.program_id(2) * height * row
    size = tl.cast(n, tl.int64)
    zero = tl.zeros([COLUMNS], tl.float32)
    factor = tl.load(upstream)
    of_x = _no_windows(GAUSSIAN, COLUMNS)
    of_xx = of_x
    of_xy = of_x
    for r in range(tl.maximum(first - reach, 0), last):
        by_x_row = slopes + _MARGIN + (top + r * row + end)
        by_xx_row = by_x_row + size
        by_xy_row = by_xx_row + size
        by_x = zero
        by_xx = zero
        by_xy = zero
        for k in tl.static_range(len(GAUSSIAN)):
            by_x += GAUSSIAN[k] * tl.load(by_x_row - 3 * k)
            by_xx += GAUSSIAN[k] * tl.load(by_xx_row - 3 * k)
            by_xy += GAUSSIAN[k] * tl.load(by_xy_row - 3 * k)
        by_x, of_x = _add_row(of_x, by_x, GAUSSIAN)
        by_xx, of_xx = _add_row(of_xx, by_xx, GAUSSIAN)
        by_xy, of_xy = _add_row(of_xy, by_xy, GAUSSIAN)
        if r >= first:
            i = top + r * row + c
            a = tl.load(x + i, inside, 0.0)
            b = _target(y, i, inside)
            sign = tl.where(a > b, 1.0, 0.0) - tl.where(a < b, 1.0, 0.0)
            of_ssim = by_x + 2 * a * by_xx + b * by_xy
            total = l1_weight * sign + 2 * l2_weight * (a - b) - ssim_weight * of_ssim
            if EXCUSES:
                total = tl.where(_is_excused(a, b, clipped_from), 0.0, total)
            tl.store(gradient + i, factor * total, inside)


def _strips(views: int, height: int, row: int) -> tuple[tuple[int, int, int], int]:
    """Return the grid of programs, and how many rows of an image each handles, so that all run at the same time."""
    columns = cdiv(row, _COLUMNS)
    most_strips = max(_PROGRAMS // (columns * views), 1)
    rows = max(cdiv(height, most_strips), _FEWEST_ROWS)
    return (columns, cdiv(height, rows), views), rows


class _PhotometricLoss(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, x: Tensor, y: Tensor, window: tuple[float, ...], ssim_lambda: float, l2_lambda: float,
        parts: Tensor | None, clipped_from: float | None,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        views, height, width, _ = x.shape
        n = x.numel()
        row = 3 * width
        grid, rows = _strips(views, height, row)
        slopes = x.new_empty(_MARGIN.value + 3 * n)
        sums = x.new_empty((3, math.prod(grid)))
        ctx.clipped = (0.0, False)  # Without EXCUSES the kernels ignore the value.
        if clipped_from is not None:
            ctx.clipped = (clipped_from, True)
        _similarity[grid](x, y, slopes, sums, n, height, row, rows, *ctx.clipped, window, _COLUMNS)
        ctx.save_for_backward(x, y, slopes)
        ctx.window = window
        ctx.num_parts = 0 if parts is None else len(parts)
        n_valid = 3 * views * (height - len(window) + 1) * (width - len(window) + 1)
        ctx.weights = (1 - ssim_lambda) / n, ssim_lambda / n_valid, l2_lambda / n
        loss = x.new_empty(())
        psnr = x.new_empty(())
        _finish[1,](
            sums, sums if parts is None else parts, loss, psnr,
            n, math.prod(grid), ctx.num_parts, ssim_lambda, *ctx.weights, _LANES,
        )  # fmt: skip
        ctx.mark_non_differentiable(psnr)
        ctx.set_materialize_grads(False)  # torch would fill PSNR's gradient with zeros on the device
        return loss, psnr

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, upstream: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        x, y, slopes = ctx.saved_tensors
        views, height, width, _ = x.shape
        gradient = torch.empty_like(x)
        grid, rows = _strips(views, height, 3 * width)
        _gradient[grid](
            x, y, slopes, upstream, gradient,
            x.numel(), height, 3 * width, rows, *ctx.weights, *ctx.clipped, ctx.window, _COLUMNS,
        )  # fmt: skip
        of_parts = None
        if ctx.num_parts:
            of_parts = upstream.expand(ctx.num_parts)
        return gradient, None, None, None, None, of_parts, None


def photometric_loss(
    predicted: Tensor, target: Tensor, window: tuple[float, ...],
    *, ssim_lambda: float, l2_lambda: float, parts: Tensor | None = None, clipped_from: float | None = None,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Do what `method.losses.photometric_loss` does, for views at least as large as SSIM's window.

    `window` has its weights along one axis, and is symmetric. `predicted` and `parts` are float32, `parts` contiguous.
    """
    check_pixels(*predicted.shape[:3])
    return _PhotometricLoss.apply(  # type: ignore[return-value]
        predicted.contiguous(), target.contiguous(), window, ssim_lambda, l2_lambda, parts, clipped_from
    )
