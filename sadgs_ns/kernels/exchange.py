"""`pack` and `unpack` of `distributed.exchange` in one launch each, where torch takes one for each tensor."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from sadgs_ns.kernels import cdiv

_ROWS = 64  # Rows that one program handles
_COLUMNS = 16  # A power of two ≥ the columns: centre 2, conic 3, opacity 1, colour 3, depth 1 and radius 1 or 2


@triton.jit
def _float_column(k, at, means2d, conics, opacities, colors, depths):
    """Return where column k < 10 of the rows of the Gaussians `at` lies in the tensors."""
    where = tl.where(k < 2, means2d + 2 * at + k, conics + 3 * at + k - 2)
    where = tl.where(k == 5, opacities + at, where)
    where = tl.where(k > 5, colors + 3 * at + k - 6, where)
    return tl.where(k == 9, depths + at, where)


@triton.jit(do_not_specialize=["n"])
def _pack(
    places, means2d, conics, opacities, colors, depths, radii, packed, n,
    PER_GAUSSIAN: tl.constexpr, ROWS: tl.constexpr, COLUMNS: tl.constexpr,
):  # fmt: skip
    row = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS)[:, None]
    k = tl.arange(0, COLUMNS)[None, :]
    exists = row < n
    at = tl.load(places + row, exists, 0)
    values = tl.load(_float_column(k, at, means2d, conics, opacities, colors, depths), exists & (k < 10), 0.0)
    radius = tl.load(radii + PER_GAUSSIAN * at + k - 10, exists & (k >= 10) & (k < 10 + PER_GAUSSIAN), 0)
    width = 10 + PER_GAUSSIAN
    tl.store(packed + row * width + k, tl.where(k < 10, values, radius.to(tl.float32)), exists & (k < width))


@triton.jit(do_not_specialize=["n", "top"])
def _unpack(
    packed, means2d, conics, opacities, colors, depths, radii, n, top,
    PER_GAUSSIAN: tl.constexpr, ROWS: tl.constexpr, COLUMNS: tl.constexpr,
):  # fmt: skip
    """Write the tensors of rows, with centres counted from the image row `top`."""
    row = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS)[:, None]
    k = tl.arange(0, COLUMNS)[None, :]
    width = 10 + PER_GAUSSIAN
    exists = (row < n) & (k < width)
    values = tl.load(packed + row * width + k, exists, 0.0)
    shifted = tl.where(k == 1, values - top, values)
    tl.store(_float_column(k, row, means2d, conics, opacities, colors, depths), shifted, exists & (k < 10))
    tl.store(radii + PER_GAUSSIAN * row + k - 10, values.to(tl.int32), exists & (k >= 10))


def pack(
    radii: Tensor, means2d: Tensor, depths: Tensor, conics: Tensor, opacities: Tensor, colors: Tensor, places: Tensor
) -> Tensor:
    """Do what `distributed.exchange.pack` does, for colours of three channels and contiguous tensors."""
    per_gaussian = radii.dim() - 1
    rows = means2d.new_empty((len(places), 10 + per_gaussian))
    if len(places):
        _pack[cdiv(len(places), _ROWS),](
            places, means2d, conics, opacities, colors, depths, radii, rows, len(places), per_gaussian, _ROWS, _COLUMNS
        )  # fmt: skip
    return rows


def unpack(rows: Tensor, top: int) -> tuple[Tensor, ...]:
    """Do what `distributed.exchange.unpack` does, for colours of three channels and contiguous rows."""
    n = len(rows)
    per_gaussian = rows.shape[1] - 10
    radii = rows.new_empty((1, n, 2) if per_gaussian == 2 else (1, n), dtype=torch.int32)
    means2d, conics, colors = (rows.new_empty((1, n, width)) for width in (2, 3, 3))
    opacities = rows.new_empty((1, n))
    depths = rows.new_empty((1, n))
    if n:
        _unpack[cdiv(n, _ROWS),](
            rows, means2d, conics, opacities, colors, depths, radii, n, float(top), per_gaussian, _ROWS, _COLUMNS
        )  # fmt: skip
    return radii, means2d, depths, conics, opacities, colors
