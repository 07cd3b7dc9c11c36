"""The three operations of `method.structure_tensor`.

With such long convolution kernels cuDNN takes several times as long, and torch needs forty launches more for a level.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from sadgs_ns.kernels import cdiv
from sadgs_ns.kernels.shared import TINY, load3, store3

_TILES = {2: (16, 64), 3: (2, 512)}  # Rows and columns of a program, by the axis: tall for neighbours above and below
_PIXELS = 1024  # Pixels that a program handles where no neighbours matter


@triton.jit(do_not_specialize=["height", "width", "taps"])
def _correlate(
    image, kernel, result, height, width, taps, VERTICAL: tl.constexpr, ROWS: tl.constexpr, COLUMNS: tl.constexpr
):
    """Correlate ROWS × COLUMNS pixels of one channel with a kernel along columns (VERTICAL) or rows; outside is 0."""
    row = tl.program_id(1) * ROWS + tl.arange(0, ROWS)[:, None]
    column = tl.program_id(0) * COLUMNS + tl.arange(0, COLUMNS)[None, :]
    inside = (row < height) & (column < width)
    plane = tl.program_id(2).to(tl.int64) * height * width
    total = tl.zeros([ROWS, COLUMNS], tl.float32)
    for k in range(taps):
        shift = k - taps // 2
        if VERTICAL:
            exists = inside & (row + shift >= 0) & (row + shift < height)
            value = tl.load(image + plane + (row + shift) * width + column, exists, 0.0)
        else:
            exists = inside & (column + shift >= 0) & (column + shift < width)
            value = tl.load(image + plane + row * width + column + shift, exists, 0.0)
        total += tl.load(kernel + k) * value
    tl.store(result + plane + row * width + column, total, inside)


@triton.jit(do_not_specialize=["n", "channels", "weight_stride"])
def _differentiate(
    blurred, blurred_x, blurred_y, total, total_x, total_y, weight, previous, products, energy,
    n, channels, weight_stride, PIXELS: tl.constexpr,
):  # fmt: skip
    pixel = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    exists = pixel < n
    image = tl.program_id(1).to(tl.int64)
    of_weight = image * weight_stride + pixel
    within = tl.load(weight + of_weight, exists, 0.0)
    totals = tl.load(total + of_weight, exists, 1.0)
    slope_x = tl.load(total_x + of_weight, exists, 0.0)
    slope_y = tl.load(total_y + of_weight, exists, 0.0)
    xx = tl.zeros([PIXELS], tl.float32)
    xy = xx
    yy = xx
    band = xx
    for channel in range(channels):
        at = (image * channels + channel) * n + pixel
        smoothed = tl.load(blurred + at, exists, 0.0) / totals
        x = (tl.load(blurred_x + at, exists, 0.0) - smoothed * slope_x) / totals
        y = (tl.load(blurred_y + at, exists, 0.0) - smoothed * slope_y) / totals
        difference = tl.load(previous + at, exists, 0.0) - smoothed
        xx = xx + x * x
        xy = xy + x * y
        yy = yy + y * y
        band = band + difference * difference
        tl.store(blurred + at, smoothed, exists)
    store3(products, 3 * image * n + pixel, xx * within, xy * within, yy * within, exists, n)
    tl.store(energy + image * n + pixel, band * within, exists)


@triton.jit(do_not_specialize=["n", "weight_stride", "exponent", "frequency"])
def _aggregate(
    products, total, energy, total_of_energy, trace_floor, numerator, denominator,
    n, weight_stride, exponent, frequency, PIXELS: tl.constexpr,
):  # fmt: skip
    pixel = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    exists = pixel < n
    image = tl.program_id(1).to(tl.int64)
    of_weight = image * weight_stride + pixel
    totals = tl.load(total + of_weight, exists, 1.0)
    at = 3 * image * n + pixel
    xx, xy, yy = load3(products, at, exists, n)
    xx = xx / totals
    xy = xy / totals
    yy = yy / totals
    band = tl.load(energy + image * n + pixel, exists, 0.0)
    band = band / tl.load(total_of_energy + of_weight, exists, 1.0)
    weight = tl.where(band > 0, tl.exp(exponent * tl.log(tl.maximum(band, TINY))), 0.0)
    factor = weight * frequency * frequency / (xx + yy + tl.load(trace_floor + image))
    sum_xx, sum_xy, sum_yy = load3(numerator, at, exists, n)
    store3(numerator, at, sum_xx + factor * xx, sum_xy + factor * xy, sum_yy + factor * yy, exists, n)
    at = image * n + pixel
    tl.store(denominator + at, tl.load(denominator + at, exists, 0.0) + weight, exists)


def correlate(image: Tensor, kernel: Tensor, axis: int) -> Tensor:
    """Do what `method.structure_tensor._correlate` does, in float32."""
    image = image.contiguous()
    batch, channels, height, width = image.shape
    result = torch.empty_like(image)
    rows, columns = _TILES[axis]
    grid = (cdiv(width, columns), cdiv(height, rows), batch * channels)
    _correlate[grid](image, kernel, result, height, width, len(kernel), axis == 2, rows, columns)
    return result


def differentiate(
    blurs: tuple[Tensor, Tensor, Tensor], totals: tuple[Tensor, Tensor, Tensor], weight: Tensor, previous: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Do what `method.structure_tensor._differentiate` does, in float32; the first of `blurs` is overwritten."""
    batch, channels, height, width = blurs[0].shape
    products, energy = (blurs[0].new_empty((batch, planes, height, width)) for planes in (3, 1))
    n = height * width
    _differentiate[cdiv(n, _PIXELS), batch](
        *blurs, *totals, weight, previous, products, energy, n, channels, n * (len(weight) > 1), _PIXELS
    )
    return blurs[0], products, energy


def aggregate(
    tensor: tuple[Tensor, Tensor], energy: tuple[Tensor, Tensor], trace_floor: Tensor,
    numerator: Tensor, denominator: Tensor, exponent: float, frequency: float,
) -> None:  # fmt: skip
    """Do what `method.structure_tensor._aggregate` does, in float32."""
    n = tensor[0].shape[2] * tensor[0].shape[3]
    _aggregate[cdiv(n, _PIXELS), len(tensor[0])](
        *tensor, *energy, trace_floor, numerator, denominator,
        n, n * (len(tensor[1]) > 1), exponent, frequency, _PIXELS,
    )  # fmt: skip
