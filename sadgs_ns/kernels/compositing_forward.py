"""gsplat's alpha compositing of three channels, forward, and the functions of a tile that both passes share.

gsplat's kernel gives each pixel a thread, which goes through the tile's list Gaussian by Gaussian. Here a warp draws a
tile of 64 pixels in blocks [Gaussians, pixels], as in the backward pass (compositing.py): a thread holds all Gaussians
of a batch for its two pixels, so that their arithmetic does not wait for one another. The image is the same but for
rounding: a weight errs by some 1e-7 of itself.
"""

from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

from sadgs_ns.kernels import TILE_SIZE
from sadgs_ns.kernels.shared import store3

SCALE = tl.constexpr(0.8493218002880191)
"""√(log2(e) / 2), of offsets in px: exp(-σ) is then exp2 of a plain polynomial. It stands
on the right of products, as Triton's interpreter needs it."""
_FAINTEST = tl.constexpr(0x3B808081)
"""Bits of 1/255."""
_GAUSSIANS, _WARPS = 8, 1
"""Gaussians of a batch, and warps of a program. With 16 Gaussians the kernel takes 1.2 times as long, with 32 of them
1.5 times (docs/results.md#parts-of-a-step)."""


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


@triton.jit
def _load_with_flaws(means2d, conics, colors, opacities, g):
    """Load what `load_gaussians` loads, with 1 beside a colour that is not finite, else 0."""
    centres, conic, rgb = load_gaussians(means2d, conics, colors, opacities, g)
    k = tl.arange(0, 4)[None, :]
    value = tl.load(colors + 3 * g + tl.minimum(k, 2))
    flaw = tl.max(tl.where(tl.abs(value) < float("inf"), 0.0, 1.0), axis=1)[:, None]
    return centres, conic, tl.where(k == 3, flaw, rgb)


@triton.jit(do_not_specialize=["num_pairs", "height", "width", "tile_width", "tile_height"])
def _composite_forward(
    means2d, conics, colors, opacities, starts, ids, renders, drawn_alphas, last_ids,
    num_pairs, height, width, tile_width, tile_height, TILE: tl.constexpr, GAUSSIANS: tl.constexpr,
):  # fmt: skip
    """Draw one tile, from front to back, in blocks [Gaussians, pixels]."""
    PIXELS: tl.constexpr = TILE * TILE
    OPAQUE = tl.constexpr(1e-4)
    x, y, inside, at, centre_x, centre_y, start, end = load_tile(
        tl.program_id(0), starts, num_pairs, height, width, tile_width, tile_height, TILE
    )  # fmt: skip
    scaled_x, scaled_y = (x.to(tl.float32) - (TILE - 1) / 2) * SCALE, (y.to(tl.float32) - (TILE - 1) / 2) * SCALE

    # `passed` is what all Gaussians of the list so far let through. Where it falls to 1e-4 nothing more is drawn, not
    # even what made it fall, and `left` keeps what it was before.
    left = tl.where(inside, 1.0, 0.0)
    passed = left
    red, green, blue = tl.zeros([PIXELS], tl.float32), tl.zeros([PIXELS], tl.float32), tl.zeros([PIXELS], tl.float32)
    flaws = tl.zeros([PIXELS], tl.float32)
    last = tl.zeros([PIXELS], tl.int32)
    rows = tl.arange(0, GAUSSIANS)
    first_row = rows[:, None] == 0
    next_g = tl.load(ids + tl.minimum(start + rows, num_pairs - 1))
    next_centre, next_conic, next_rgb = _load_with_flaws(means2d, conics, colors, opacities, next_g[:, None])
    done = start
    while (done < end) & (tl.max(passed) > OPAQUE):
        position = done + rows
        mean_x, mean_y, opacity, _ = split4(next_centre)
        a, b, c, _ = split4(next_conic)
        r, g, b_, flaw = split4(next_rgb)
        # The next batch is loaded while this one is computed.
        done += GAUSSIANS
        next_g = tl.load(ids + tl.minimum(done + rows, num_pairs - 1))
        next_centre, next_conic, next_rgb = _load_with_flaws(means2d, conics, colors, opacities, next_g[:, None])

        limit = highest_alpha(position < end, opacity)[:, None]
        dx = (mean_x - centre_x)[:, None] * SCALE - scaled_x[None, :]
        dy = (mean_y - centre_y)[:, None] * SCALE - scaled_y[None, :]
        alpha = alphas(dx, dy, a, b, c, opacity, limit)

        through = 1 - alpha
        behind = tl.cumprod(tl.where(first_row, through * passed[None, :], through), 0)
        drawn = behind > OPAQUE
        weight = tl.where(drawn, alpha * behind * reciprocal(through), 0.0)
        red += tl.sum(weight * r[:, None], axis=0)
        green += tl.sum(weight * g[:, None], axis=0)
        blue += tl.sum(weight * b_[:, None], axis=0)
        flaws += tl.sum(weight * flaw[:, None], axis=0)
        left = tl.minimum(left, tl.min(tl.where(drawn, behind, 1.0), axis=0))
        last = tl.maximum(last, tl.max(tl.where(weight > 0, position[:, None], 0), axis=0))
        passed = row(behind, GAUSSIANS - 1)
    nan = tl.where(flaws > 0, float("nan"), 0.0)
    store3(renders, 3 * at, red + nan, green + nan, blue + nan, inside)
    tl.store(drawn_alphas + at, 1 - left, inside)
    tl.store(last_ids + at, last, inside)


def composite_forward(
    means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, width: int, height: int,
    isect_offsets: Tensor, flatten_ids: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
    """Do what gsplat's `rasterize_to_pixels` does, for three channels and tiles of TILE_SIZE.

    All tensors are contiguous, with shapes as in `render.types.Projected`. `isect_offsets` and `flatten_ids` are the
    `starts` and `ids` of `tiles.TileLists`; lists of tiles below the image are passed over. A colour that is not finite
    makes the pixels that see it NaN, and no others.

    Returns:
        Colours [C, height, width, 3]; alphas [C, height, width, 1]; and the place in the lists of the last Gaussian
        that a pixel drew, int32 [C, height, width].
    """
    views, tile_height, tile_width = isect_offsets.shape
    if not len(flatten_ids):
        return (
            means2d.new_zeros((views, height, width, 3)),
            means2d.new_zeros((views, height, width, 1)),
            flatten_ids.new_zeros((views, height, width)),
        )
    renders, alphas = means2d.new_empty((views, height, width, 3)), means2d.new_empty((views, height, width, 1))
    last_ids = flatten_ids.new_empty((views, height, width))
    _composite_forward[(isect_offsets.numel(),)](
        means2d, conics, colors, opacities, isect_offsets, flatten_ids, renders, alphas, last_ids,
        len(flatten_ids), height, width, tile_width, tile_height, TILE_SIZE, _GAUSSIANS,
        num_warps=_WARPS, num_stages=1,
    )  # fmt: skip
    return renders, alphas, last_ids
