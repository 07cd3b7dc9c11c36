"""What a level of the structure tensor does to each pixel between its convolutions: two kernels instead of forty."""

# pyright: reportArgumentType=false, reportCallIssue=false, reportIndexIssue=false
# (Triton's launch syntax, kernel[grid](...), is not in its types.)

from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

_PIXELS = 1024  # a program handles
_TINY = 1.1754943508222875e-38  # the smallest normal float32, whose logarithm is finite


@triton.jit(do_not_specialize=["n", "channels", "weight_stride"])
def _differentiate(
    blurred, blurred_x, blurred_y, reach, reach_x, reach_y, weight, previous, products, energy,
    n, channels, weight_stride, PIXELS: tl.constexpr,
):  # fmt: skip
    pixel = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    exists = pixel < n
    image = tl.program_id(1).to(tl.int64)
    of_weight = image * weight_stride + pixel
    within = tl.load(weight + of_weight, exists, 0.0)
    total = tl.load(reach + of_weight, exists, 1.0)
    total_x = tl.load(reach_x + of_weight, exists, 0.0)
    total_y = tl.load(reach_y + of_weight, exists, 0.0)
    xx = tl.zeros([PIXELS], tl.float32)
    xy, yy, band = xx, xx, xx
    for channel in range(channels):
        at = (image * channels + channel) * n + pixel
        smoothed = tl.load(blurred + at, exists, 0.0) / total
        x = (tl.load(blurred_x + at, exists, 0.0) - smoothed * total_x) / total
        y = (tl.load(blurred_y + at, exists, 0.0) - smoothed * total_y) / total
        difference = tl.load(previous + at, exists, 0.0) - smoothed
        xx, xy, yy, band = xx + x * x, xy + x * y, yy + y * y, band + difference * difference
        tl.store(blurred + at, smoothed, exists)
    at = 3 * image * n + pixel
    tl.store(products + at, xx * within, exists)
    tl.store(products + at + n, xy * within, exists)
    tl.store(products + at + 2 * n, yy * within, exists)
    tl.store(energy + image * n + pixel, band * within, exists)


@triton.jit(do_not_specialize=["n", "weight_stride", "exponent", "frequency", "sigma"])
def _accumulate(
    products, reach, energy, reach_of_energy, noise, numerator, denominator,
    n, weight_stride, exponent, frequency, sigma, TINY: tl.constexpr, PIXELS: tl.constexpr,
):  # fmt: skip
    pixel = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    exists = pixel < n
    image = tl.program_id(1).to(tl.int64)
    of_weight = image * weight_stride + pixel
    total = tl.load(reach + of_weight, exists, 1.0)
    at = 3 * image * n + pixel
    xx = tl.load(products + at, exists, 0.0) / total
    xy = tl.load(products + at + n, exists, 0.0) / total
    yy = tl.load(products + at + 2 * n, exists, 0.0) / total
    band = tl.load(energy + image * n + pixel, exists, 0.0)
    band = band / tl.load(reach_of_energy + of_weight, exists, 1.0)
    scale_weight = tl.where(band > 0, tl.exp(exponent * tl.log(tl.maximum(band, TINY))), 0.0)
    floor = tl.load(noise + image) / sigma
    factor = scale_weight * frequency * frequency / (xx + yy + floor * floor)
    tl.store(numerator + at, tl.load(numerator + at, exists, 0.0) + factor * xx, exists)
    tl.store(numerator + at + n, tl.load(numerator + at + n, exists, 0.0) + factor * xy, exists)
    tl.store(numerator + at + 2 * n, tl.load(numerator + at + 2 * n, exists, 0.0) + factor * yy, exists)
    at = image * n + pixel
    tl.store(denominator + at, tl.load(denominator + at, exists, 0.0) + scale_weight, exists)


def differentiate(blurs: tuple[Tensor, ...], reaches: tuple[Tensor, ...], weight: Tensor, previous: Tensor) -> tuple[
    Tensor, Tensor, Tensor
]:  # fmt: skip
    """Normalise a level's blurs; form the products of its gradients and the energy of its band.

    Args:
        blurs: The image's blur and its derivatives along x and y, float32 [B, C, H, W]. The first is overwritten.
        reaches: The same of `weight`, the first positive. [1 or B, 1, H, W]
        weight: Of the pixels, [1 or B, 1, H, W].
        previous: The level before. [B, C, H, W]

    Returns:
        The smoothed image [B, C, H, W], and times `weight` the products xx, xy, yy [B, 3, H, W] and the energy
        [B, 1, H, W].
    """
    batch, channels, height, width = blurs[0].shape
    products, energy = (blurs[0].new_empty((batch, planes, height, width)) for planes in (3, 1))
    n = height * width
    _differentiate[triton.cdiv(n, _PIXELS), batch](
        *blurs, *reaches, weight, previous, products, energy,
        n, channels, n * (len(weight) > 1), _PIXELS,
    )  # fmt: skip
    return blurs[0], products, energy


def accumulate(
    tensor: tuple[Tensor, Tensor],
    energy: tuple[Tensor, Tensor],
    noise: Tensor,
    sums: tuple[Tensor, Tensor],
    exponent: float,
    frequency: float,
    sigma: float,
) -> None:
    """Add a level to the sums of eq. 5.

    Args:
        tensor: The blurred products, float32 [B, 3, H, W], and the same blur of the weight, [1 or B, 1, H, W].
        energy: The blurred energy [B, 1, H, W], and the same.
        noise: Amplitude under which structure fades. [B, 1, 1, 1]
        sums: Numerator [B, 3, H, W] and denominator [B, 1, H, W], updated in place.
        exponent: γ / 2.
        frequency: c / σ_l, 1/px.
        sigma: σ_l, px.
    """
    n = tensor[0].shape[2] * tensor[0].shape[3]
    _accumulate[triton.cdiv(n, _PIXELS), len(tensor[0])](
        *tensor, *energy, noise, *sums, n, n * (len(tensor[1]) > 1), exponent, frequency, sigma, _TINY, _PIXELS
    )
