"""`method.quantization.quantize` in one kernel."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from sadgs_ns.kernels import cdiv
from sadgs_ns.kernels.shared import TINY, load3, store3

_PIXELS = 1024  # Pixels that one program handles


@triton.jit
def _to_byte(value, HIGHEST: tl.constexpr, OCTAVES: tl.constexpr):
    """Return the byte of a squared frequency plus a half, so that cutting off the fraction rounds it."""
    octaves = 0.5 * tl.log2(tl.maximum(value, TINY) / (HIGHEST * HIGHEST))
    return tl.minimum(tl.maximum(255 + 254 * octaves / OCTAVES, 0.0), 255.0) + 0.5


@triton.jit(do_not_specialize=["n"])
def _quantize(
    tensor, quantized, n, HIGHEST: tl.constexpr, OCTAVES: tl.constexpr, INVALID: tl.constexpr, PIXELS: tl.constexpr
):
    pixel = tl.program_id(0).to(tl.int64) * PIXELS + tl.arange(0, PIXELS)
    exists = pixel < n
    xx, xy, yy = load3(tensor, 3 * pixel, exists)
    # NaN is told by comparison, for Triton's maximum drops it on a GPU, and no integer is made of it.
    known = (xx == xx) & (xy == xy) & (yy == yy)
    xx = tl.where(known, xx, 0.0)
    xy = tl.where(known, xy, 0.0)
    yy = tl.where(known, yy, 0.0)
    product = tl.sqrt(tl.maximum(xx, 0.0)) * tl.sqrt(tl.maximum(yy, 0.0))
    correlation = tl.where(product > 0, xy / tl.maximum(product, TINY), 0.0)
    correlation = 127.5 + 127 * tl.minimum(tl.maximum(correlation, -1.0), 1.0)
    correlation = tl.where(known, correlation, INVALID)
    x = _to_byte(xx, HIGHEST, OCTAVES)
    y = _to_byte(yy, HIGHEST, OCTAVES)
    store3(quantized, 3 * pixel, x.to(tl.uint8), correlation.to(tl.uint8), y.to(tl.uint8), exists)


def quantize(tensor: Tensor, highest_frequency: float, octaves: float, invalid: int) -> Tensor:
    """Do what `method.quantization.quantize` does in float32, with its constants; rounding may change a byte by 1."""
    tensor = tensor.contiguous()
    quantized = torch.empty_like(tensor, dtype=torch.uint8)
    n = tensor.numel() // 3
    _quantize[cdiv(n, _PIXELS),](tensor, quantized, n, highest_frequency, octaves, invalid, _PIXELS)
    return quantized
