"""gsplat's alpha compositing of three channels, forward: a warp draws a tile of 64 pixels.

gsplat's kernel gives each pixel a thread, which goes through the tile's list Gaussian by Gaussian. Here a thread holds
batches of Gaussians of two pixels, as in the backward pass (compositing.py), so that the arithmetic of a batch does not
wait for one another. The image is the same but for rounding: a weight errs by some 1e-7 of itself.
"""

from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

from sadgs_ns.kernels import TILE_SIZE
from sadgs_ns.kernels.compositing_blocks import (
    SCALE,
    alphas,
    highest_alpha,
    load_gaussians,
    load_tile,
    reciprocal,
    row,
    split4,
)

_GAUSSIANS, _WARPS = 8, 1
"""Gaussians of a batch, and warps of a program. With 16 Gaussians the kernel takes 1.2 times as long, with 32 of them
1.5 times (docs/results.md#parts-of-a-step)."""


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
    tl.store(renders + 3 * at, red + nan, inside)
    tl.store(renders + 3 * at + 1, green + nan, inside)
    tl.store(renders + 3 * at + 2, blue + nan, inside)
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
