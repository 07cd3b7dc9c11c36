"""Functions of both passes of compositing, for one tile in one warp.

A block is [Gaussians, pixels]. With one warp a thread holds all Gaussians of its two pixels.
"""

from __future__ import annotations

import triton
import triton.language as tl

SCALE = tl.constexpr(0.8493218002880191)
"""√(log2(e) / 2), of offsets in px: exp(-σ) is then exp2 of a plain polynomial. It stands
on the right of products, as Triton's interpreter needs it."""
_FAINTEST = tl.constexpr(0x3B808081)
"""Bits of 1/255."""


@triton.jit
def row(values, ROW: tl.constexpr):
    """Return one row of a block. Adding −0.0 changes nothing, so that the compiler removes the sum."""
    rows = tl.arange(0, values.shape[0])[:, None]
    return tl.sum(tl.where(rows == ROW, values, -0.0), axis=0)


if isinstance(row, triton.JITFunction):

    @triton.jit
    def reciprocal(value):
        """Return 1 / value in one instruction; Triton's division spends four more on denormals."""
        return tl.inline_asm_elementwise(
            "rcp.approx.ftz.f32 $0, $1;", "=r,r", [value], tl.float32, is_pure=True, pack=1
        )  # fmt: skip
else:  # Triton's interpreter, which knows no PTX

    @triton.jit
    def reciprocal(value):
        return 1 / value


@triton.jit
def split4(values):
    """Return the columns of a block [N, 4]."""
    even, odd = tl.split(tl.reshape(values, [values.shape[0], 2, 2]))
    c0, c2 = tl.split(even)
    c1, c3 = tl.split(odd)
    return c0, c1, c2, c3


@triton.jit
def load_gaussians(means2d, conics, colors, opacities, g):
    """Load centre and opacity, conic, and colour of the Gaussians with indices g [N, 1] into three blocks [N, 4].

    Triton spreads a block over the threads if it has at least as many values; of a smaller one every thread would load
    everything.
    """
    k = tl.arange(0, 4)[None, :]
    centres = tl.load(tl.where(k < 2, means2d + 2 * g + k, opacities + g))
    k = tl.minimum(k, 2)
    rgb = tl.load(colors + 3 * g + k)
    # A colour that is not finite makes the pixels that see it NaN. Elsewhere its weight is 0, but 0 · NaN would reach
    # the gradients of the Gaussians in front of it: here it counts as 0.
    return centres, tl.load(conics + 3 * g + k), tl.where(tl.abs(rgb) < float("inf"), rgb, 0.0)


@triton.jit
def load_tile(tile, starts, num_pairs, height, width, tile_width, tile_height, TILE: tl.constexpr):
    """Find what the program of a tile draws; there is one for each tile of all views.

    Returns:
        Column and row of its pixels in the tile, int32 [TILE²]; which of them are in the image, and their indices in
        C · height · width; the tile's centre in px; and where its list of Gaussians starts and ends.
    """
    view = tile // (tile_height * tile_width)
    tile_row, column = tile // tile_width % tile_height, tile % tile_width
    pixel = tl.arange(0, TILE * TILE)
    x, y = pixel % TILE, pixel // TILE
    inside = (tile_row * TILE + y < height) & (column * TILE + x < width)
    at = (view * height + tile_row * TILE + y) * width + column * TILE + x
    start = tl.load(starts + tile)
    end = num_pairs
    if tile + 1 < tl.num_programs(0):
        end = tl.load(starts + tile + 1)
    centre_x, centre_y = column.to(tl.float32) * TILE + TILE / 2, tile_row.to(tl.float32) * TILE + TILE / 2
    return x, y, inside, at, centre_x, centre_y, start, end


@triton.jit
def highest_alpha(listed, opacity):
    """Return what `alphas` compares with, from 0 where a Gaussian is not listed: 1/255 <= alpha <= opacity.

    The latter is σ >= 0, with some units in the last place for rounding. Bits of positive floats are ordered as these,
    so that one unsigned comparison finds both.
    """
    return tl.maximum(tl.where(listed, opacity, 0.0).to(tl.int32, bitcast=True) - _FAINTEST + 4, 0)


@triton.jit
def alphas(dx, dy, a, b, c, opacity, limit):
    """Return the opacity of each Gaussian at each pixel, 0 if it is not drawn.

    Args:
        dx, dy: SCALE times the offset from the pixel to the centre. [Gaussians, pixels]
        a, b, c: Conic, in 1/px². [Gaussians]
        opacity: In [0, 1]. [Gaussians]
        limit: Of `highest_alpha`, or 0 if a Gaussian is not drawn. [Gaussians, 1 or pixels]
    """
    exponent = dx * (a[:, None] * dx) + dy * (b[:, None] * (dx + dx) + c[:, None] * dy)
    alpha = opacity[:, None] * tl.exp2(-exponent)
    above = alpha.to(tl.int32, bitcast=True) - _FAINTEST
    seen = above.to(tl.uint32, bitcast=True) < limit.to(tl.uint32, bitcast=True)
    return tl.where(seen, tl.minimum(alpha, 0.999), 0.0)
