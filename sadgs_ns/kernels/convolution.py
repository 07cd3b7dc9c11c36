"""One-dimensional convolutions of images; cuDNN's depthwise ones take several times as long for these long kernels."""

# pyright: reportArgumentType=false, reportCallIssue=false, reportIndexIssue=false
# (Triton's launch syntax, kernel[grid](...), is not in its types.)

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

_TILES = {2: (16, 64), 3: (2, 512)}  # rows and columns a program handles: tall where the neighbours are above and below


@triton.jit(do_not_specialize=["height", "width", "taps"])
def _correlate(
    image, kernel, result, height, width, taps,
    VERTICAL: tl.constexpr, ROWS: tl.constexpr, COLUMNS: tl.constexpr,
):  # fmt: skip
    row = tl.program_id(1) * ROWS + tl.arange(0, ROWS)[:, None]
    column = tl.program_id(0) * COLUMNS + tl.arange(0, COLUMNS)[None, :]
    inside = (row < height) & (column < width)
    start = tl.program_id(2).to(tl.int64) * height * width
    total = tl.zeros([ROWS, COLUMNS], tl.float32)
    for k in range(taps):
        step = k - taps // 2
        if VERTICAL:
            there = inside & (row + step >= 0) & (row + step < height)
            value = tl.load(image + start + (row + step) * width + column, there, 0.0)
        else:
            there = inside & (column + step >= 0) & (column + step < width)
            value = tl.load(image + start + row * width + column + step, there, 0.0)
        total += tl.load(kernel + k) * value
    tl.store(result + start + row * width + column, total, inside)


def correlate(image: Tensor, kernel: Tensor, axis: int) -> Tensor:
    """Correlate along one image axis with zeros outside, as torch's conv2d with the same kernel for every channel.

    Args:
        image: float32 [B, C, H, W]
        kernel: float32 [K], K odd.
        axis: 2 for rows (y), 3 for columns (x).
    """
    image = image.contiguous()
    batch, channels, height, width = image.shape
    result = torch.empty_like(image)
    rows, columns = _TILES[axis]
    grid = (triton.cdiv(width, columns), triton.cdiv(height, rows), batch * channels)
    _correlate[grid](image, kernel, result, height, width, len(kernel), axis == 2, rows, columns)
    return result
