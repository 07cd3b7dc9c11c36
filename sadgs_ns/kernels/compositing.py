"""gsplat's alpha compositing in kernels of our own for three channels; backward, tensor cores sum over the pixels.

gsplat's kernel gives each pixel a thread, which goes through the tile's list Gaussian by Gaussian. Here a warp draws a
tile of 64 pixels in blocks [Gaussians, pixels]: a thread holds all Gaussians of a batch for its two pixels, so that
their arithmetic does not wait for one another. Rounding changes a weight by some 1e-7 of itself.

gsplat's backward pass sums nine quantities per Gaussian over the lanes of a warp, which takes most of its instructions.
All nine are linear in two numbers per Gaussian and pixel: the weight of the Gaussian's colour, and the gradient of its
exponent σ. A colour's gradient is the weights times the pixels' gradients; those of centre, conic and opacity follow
from the moments of σ's gradient over the tile. Both are products of [Gaussians, pixels] matrices.

Gradients are as accurate as gsplat's, but for two. Moments are moved from the tile's centre to the Gaussian's: conics
of Gaussians of standard deviation s err by about 1e-6 px²/s², at most 3e-6 behind gsplat's blur. A pixel's share of the
absolute gradient is rounded to 11 bits, an error of 2e-4 on average, which shrinks as a Gaussian covers more pixels.
"""

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from sadgs_ns.kernels import TILE_SIZE
from sadgs_ns.kernels.shared import load3, reciprocal, store3

SCALE = tl.constexpr(0.8493218002880191)  # √(log2(e) / 2), of offsets in px: exp(-σ) is then exp2 of a plain polynomial
_FAINTEST = tl.constexpr(0x3B808081)  # Bits of 1/255
_GAUSSIANS = 8  # Gaussians of a forward batch: 16 take 1.2 times as long, 32 take 1.5 times
_BACKWARD_GAUSSIANS = 16  # Gaussians of a backward batch
_WARPS = 1  # Warps of a program
PRECISION = "tf32x3"
"""How Triton multiplies float32 on tensor cores: three products of the two parts of 11 bits of each factor. "tf32" is
one, takes a fifth less time and errs by 4e-4 instead of 2e-5; "ieee" takes twice the time."""
_STRIDE = 12  # In a row of gradients: centre 2, conic 3, opacity 1, colour 3, centre's absolute gradient 2, unused 1


@triton.jit
def row(values, ROW: tl.constexpr):
    """Return one row of a block. Adding −0.0 changes nothing, so that the compiler removes the sum."""
    rows = tl.arange(0, values.shape[0])[:, None]
    return tl.sum(tl.where(rows == ROW, values, -0.0), axis=0)


@triton.jit
def split4(values):
    """Return the columns of a block [N, 4]."""
    even, odd = tl.split(tl.reshape(values, [values.shape[0], 2, 2]))
    c0, c2 = tl.split(even)
    c1, c3 = tl.split(odd)
    return c0, c1, c2, c3


@triton.jit
def load_gaussians(means2d, conics, colors, opacities, g, FLAWS: tl.constexpr):
    """Load centre and opacity, conic, and colour of the Gaussians with indices g [N, 1] into three blocks [N, 4].

    Columns that are left over repeat the one before. With FLAWS, a colour's last column is 1 if the colour is not
    finite, else 0. The blocks have four columns because Triton spreads only a block with at least as many values as
    there are threads over these; each thread would load all of a smaller one.
    """
    column = tl.arange(0, 4)[None, :]
    centres = tl.load(tl.where(column < 2, means2d + 2 * g + column, opacities + g))
    of_three = tl.minimum(column, 2)
    rgb = tl.load(colors + 3 * g + of_three)
    # A colour that is not finite makes the pixels that see it NaN. Elsewhere its weight is 0, but 0 · NaN would reach
    # the gradients of the Gaussians in front of it: here it counts as 0.
    finite = tl.abs(rgb) < float("inf")
    rgb = tl.where(finite, rgb, 0.0)
    if FLAWS:
        flaw = tl.max(tl.where(finite, 0.0, 1.0), axis=1)[:, None]
        rgb = tl.where(column == 3, flaw, rgb)
    return centres, tl.load(conics + 3 * g + of_three), rgb


@triton.jit
def load_tile(tile, starts, num_pairs, height, width, tile_width, tile_height, TILE: tl.constexpr):
    """Find what the program of a tile draws; there is one for each tile of all views.

    Returns:
        Column and row of its pixels in the tile, int32 [TILE²]; which of them are in the image, and their indices in
        C · height · width; the tile's centre in px; and where its list of Gaussians starts and ends.
    """
    view = tile // (tile_height * tile_width)
    tile_row = tile // tile_width % tile_height
    column = tile % tile_width
    pixel = tl.arange(0, TILE * TILE)
    x = pixel % TILE
    y = pixel // TILE
    inside = (tile_row * TILE + y < height) & (column * TILE + x < width)
    at = (view * height + tile_row * TILE + y) * width + column * TILE + x
    start = tl.load(starts + tile)
    end = num_pairs
    if tile + 1 < tl.num_programs(0):
        end = tl.load(starts + tile + 1)
    centre_x = column.to(tl.float32) * TILE + TILE / 2
    centre_y = tile_row.to(tl.float32) * TILE + TILE / 2
    return x, y, inside, at, centre_x, centre_y, start, end


@triton.jit
def highest_alpha(listed, opacity):
    """Return what `alphas` compares with, from 0 where a Gaussian is not listed: 1/255 <= alpha <= opacity.

    The latter is σ >= 0, with some units in the last place for rounding. One unsigned comparison of bits finds both.
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
    scaled_x = (x.to(tl.float32) - (TILE - 1) / 2) * SCALE
    scaled_y = (y.to(tl.float32) - (TILE - 1) / 2) * SCALE

    # `passed` is what all Gaussians of the list so far let through. Where it falls to 1e-4 nothing more is drawn, not
    # even what made it fall, and `left` keeps what it was before.
    left = tl.where(inside, 1.0, 0.0)
    passed = left
    red = tl.zeros([PIXELS], tl.float32)
    green = tl.zeros([PIXELS], tl.float32)
    blue = tl.zeros([PIXELS], tl.float32)
    flaws = tl.zeros([PIXELS], tl.float32)
    last = tl.zeros([PIXELS], tl.int32)
    rows = tl.arange(0, GAUSSIANS)
    first_row = rows[:, None] == 0
    next_g = tl.load(ids + tl.minimum(start + rows, num_pairs - 1))
    next_centre, next_conic, next_rgb = load_gaussians(means2d, conics, colors, opacities, next_g[:, None], True)
    done = start
    while (done < end) & (tl.max(passed) > OPAQUE):
        position = done + rows
        mean_x, mean_y, opacity, _ = split4(next_centre)
        a, b, c, _ = split4(next_conic)
        r, g, b_, flaw = split4(next_rgb)
        # The next batch is loaded while this one is computed.
        done += GAUSSIANS
        next_g = tl.load(ids + tl.minimum(done + rows, num_pairs - 1))
        next_centre, next_conic, next_rgb = load_gaussians(means2d, conics, colors, opacities, next_g[:, None], True)

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

    All tensors are contiguous, with shapes as in `render.types.Projected`. `isect_offsets` and `flatten_ids` are
    `tiles.TileLists`; tiles below the image are passed over. Only pixels that see a colour that is not finite are NaN.

    Returns:
        Colours [C, height, width, 3]; alphas [C, height, width, 1]; and the place in the lists of each pixel's last
        Gaussian, int32 [C, height, width].
    """
    views, tile_height, tile_width = isect_offsets.shape
    make = means2d.new_empty if len(flatten_ids) else means2d.new_zeros
    renders = make((views, height, width, 3))
    alphas = make((views, height, width, 1))
    last_ids = make((views, height, width), dtype=flatten_ids.dtype)
    if len(flatten_ids):
        _composite_forward[(isect_offsets.numel(),)](
            means2d, conics, colors, opacities, isect_offsets, flatten_ids, renders, alphas, last_ids,
            len(flatten_ids), height, width, tile_width, tile_height, TILE_SIZE, _GAUSSIANS,
            num_warps=_WARPS, num_stages=1,
        )  # fmt: skip
    return renders, alphas, last_ids


@triton.jit
def _rounded(values):
    """Round values to the nearest that tensor cores read, which cut the rest off: errors then average out."""
    return ((values.to(tl.int32, bitcast=True) + 4096) & -8192).to(tl.float32, bitcast=True)


@triton.jit
def _split8(values):
    """Return the columns of a block [N, 8]."""
    even, odd = tl.split(tl.reshape(values, [values.shape[0], 4, 2]))
    c0, c2, c4, c6 = split4(even)
    c1, c3, c5, c7 = split4(odd)
    return c0, c1, c2, c3, c4, c5, c6, c7


@triton.jit
def _join4(c0, c1, c2, c3):
    """Make a block [N, 4] of its columns."""
    return tl.reshape(tl.join(tl.join(c0, c2), tl.join(c1, c3)), [c0.shape[0], 4])


@triton.jit(do_not_specialize=["num_pairs", "height", "width", "tile_width", "tile_height"])
def _composite_backward(
    means2d, conics, colors, opacities, starts, ids, drawn_alphas, last_ids, v_renders, v_alphas, gradients,
    num_pairs, height, width, tile_width, tile_height,
    TILE: tl.constexpr, GAUSSIANS: tl.constexpr, STRIDE: tl.constexpr, ALPHAS: tl.constexpr,
    ABSGRAD: tl.constexpr, PRECISION: tl.constexpr,
):  # fmt: skip
    """Add one tile's share to the gradients [C * N, STRIDE].

    The kernel goes through the list from the back, in blocks [Gaussians, pixels]. With one warp, a thread holds all
    Gaussians of its two pixels, and what accumulates from Gaussian to Gaussian stays in its registers.
    """
    PIXELS: tl.constexpr = TILE * TILE
    x, y, inside, at, centre_x, centre_y, start, end = load_tile(
        tl.program_id(0), starts, num_pairs, height, width, tile_width, tile_height, TILE
    )  # fmt: skip
    last = tl.load(last_ids + at, inside, -1)
    end = tl.minimum(end, tl.max(last) + 1)
    # Pixels are counted from the tile's centre: these offsets are small, and exact in 11 bits.
    x = x.to(tl.float32) - (TILE - 1) / 2
    y = y.to(tl.float32) - (TILE - 1) / 2
    scaled_x = x * SCALE
    scaled_y = y * SCALE

    red, green, blue = load3(v_renders, 3 * at, inside)
    v_alpha = red * 0
    if ALPHAS:
        v_alpha = tl.load(v_alphas + at, inside, 0.0)
    # In a matrix product 0 * NaN would reach all Gaussians of the batch. A pixel whose gradient is not finite counts as
    # 2^100 in the colours' sums and as 0 elsewhere; sums that large become NaN below, in the Gaussians that it sees.
    finite = tl.maximum(tl.maximum(tl.abs(red), tl.abs(green)), tl.maximum(tl.abs(blue), tl.abs(v_alpha))) < 1e18
    finite = finite & (red == red) & (green == green) & (blue == blue) & (v_alpha == v_alpha)
    red = tl.where(finite, red, 0.0)
    green = tl.where(finite, green, 0.0)
    blue = tl.where(finite, blue, 0.0)
    transmittance = 1 - tl.load(drawn_alphas + at, inside, 0.0)
    # The colour behind the present Gaussian times the pixel's gradient; alpha counts as minus a background of one.
    behind = tl.where(finite, -v_alpha, 0.0) * transmittance

    k = tl.arange(0, 8)[None, :]
    powers_x = tl.where((k == 1) | (k == 4), x[:, None], tl.where(k == 3, (x * x)[:, None], 1.0))
    powers_y = tl.where((k == 2) | (k == 4), y[:, None], tl.where(k == 5, (y * y)[:, None], 1.0))
    moments = tl.where(k < 6, powers_x * powers_y, 0.0)  # 1, x, y, x², xy, y²
    v_rgb = tl.load(v_renders + 3 * at[:, None] + k, inside[:, None] & (k < 3), 0.0)
    v_rgb = tl.where(finite[:, None] | (k >= 3), v_rgb, 1.2676506002282294e30)
    ones = tl.zeros([PIXELS // 2, 1], tl.float32) + 1
    to_x = tl.where(k == 6, ones, 0.0)
    to_y = tl.where(k == 7, ones, 0.0)

    rows = tl.arange(0, GAUSSIANS)
    first_row = rows[:, None] == 0
    next_g = tl.load(ids + tl.minimum(tl.maximum(end - 1 - rows, start), num_pairs - 1))
    next_centre, next_conic, next_rgb = load_gaussians(means2d, conics, colors, opacities, next_g[:, None], False)
    for done in range(0, end - start, GAUSSIANS):
        position = end - 1 - done - rows
        g = next_g
        mean_x, mean_y, opacity, _ = split4(next_centre)
        a, b, c, _ = split4(next_conic)
        r, g_, b_, _ = split4(next_rgb)
        # The next batch is loaded while this one is computed.
        next_g = tl.load(ids + tl.maximum(position - GAUSSIANS, start))
        next_centre, next_conic, next_rgb = load_gaussians(means2d, conics, colors, opacities, next_g[:, None], False)
        mean_x -= centre_x
        mean_y -= centre_y

        limit = highest_alpha(position >= start, opacity)[:, None]
        limit = tl.where(position[:, None] <= last[None, :], limit, 0)
        dx = mean_x[:, None] * SCALE - scaled_x[None, :]
        dy = mean_y[:, None] * SCALE - scaled_y[None, :]
        alpha = alphas(dx, dy, a, b, c, opacity, limit)

        ratio = reciprocal(1 - alpha)
        front = tl.cumprod(tl.where(first_row, ratio * transmittance[None, :], ratio), 0)
        transmittance = row(front, GAUSSIANS - 1)
        weight = alpha * front
        color = r[:, None] * red[None, :] + g_[:, None] * green[None, :] + b_[:, None] * blue[None, :]
        share = weight * color
        share = tl.cumsum(tl.where(first_row, share + behind[None, :], share), 0)
        behind = row(share, GAUSSIANS - 1)
        by_color = tl.dot(weight, v_rgb, input_precision=PRECISION)
        # This is front · color − behind / (1 − alpha), where `share` includes the Gaussian's own share in `behind`.
        v_sigma = tl.where(alpha < 0.999, alpha * ratio * (share - color * front), 0.0)
        if ABSGRAD:
            # Each thread adds its two pixels first.
            slope_x = tl.abs(v_sigma * (a[:, None] * dx + b[:, None] * dy))
            slope_x = tl.sum(tl.reshape(slope_x, [GAUSSIANS, 2, PIXELS // 2]), axis=1)
            slope_y = tl.abs(v_sigma * (b[:, None] * dx + c[:, None] * dy))
            slope_y = tl.sum(tl.reshape(slope_y, [GAUSSIANS, 2, PIXELS // 2]), axis=1)
            by_color = tl.dot(_rounded(slope_x), to_x, by_color, input_precision="tf32")
            by_color = tl.dot(_rounded(slope_y), to_y, by_color, input_precision="tf32")
        by_moment = tl.dot(v_sigma, moments, input_precision=PRECISION)

        r, g_, b_, _, _, _, abs_x, abs_y = _split8(by_color)
        s, sx, sy, sxx, sxy, syy, _, _ = _split8(by_moment)
        nan = tl.where(tl.maximum(tl.abs(r), tl.maximum(tl.abs(g_), tl.abs(b_))) < 1e18, 0.0, float("nan"))
        # Moments of the offset from pixel to centre, mean - (x, y). The conic is applied to mean and (x, y) apart: far
        # from the centre of a long, thin Gaussian the sums would cancel.
        v_x = (a * mean_x + b * mean_y) * s - (a * sx + b * sy)
        v_y = (b * mean_x + c * mean_y) * s - (b * sx + c * sy)
        v_a = 0.5 * (mean_x * (mean_x * s - 2 * sx) + sxx)
        v_b = mean_x * (mean_y * s - sy) - mean_y * sx + sxy
        v_c = 0.5 * (mean_y * (mean_y * s - 2 * sy) + syy)
        v_opacity = -s / tl.maximum(opacity, 1 / 255)
        at_row = gradients + (g.to(tl.int64) * STRIDE)[:, None] + tl.arange(0, 4)[None, :]
        exists = (position >= start)[:, None]
        tl.atomic_add(at_row, _join4(v_x + nan, v_y + nan, v_a + nan, v_b + nan), exists, sem="relaxed")
        tl.atomic_add(at_row + 4, _join4(v_c + nan, v_opacity + nan, r + nan, g_ + nan), exists, sem="relaxed")
        tl.atomic_add(at_row + 8, _join4(b_ + nan, abs_x / SCALE, abs_y / SCALE, 0 * s), exists, sem="relaxed")


def composite_backward(
    means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, isect_offsets: Tensor, flatten_ids: Tensor,
    alphas: Tensor, last_ids: Tensor, v_renders: Tensor, v_alphas: Tensor | None, absgrad: bool,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor | None]:  # fmt: skip
    """Differentiate `composite_forward`, given its arguments and results; all tensors are contiguous.

    `v_renders` and `v_alphas` are the gradients of its colours and alphas; the latter is None where nothing depends on
    alphas. Only Gaussians seen by a pixel whose gradient is not finite, or at least 1e18, have gradients of NaN.

    Returns:
        Gradients of means2d, conics, colors and opacities, in their shapes, and with `absgrad` the sum of the absolute
        gradients of the centres [C, N, 2]: parts of the rows of one tensor.
    """
    gradients = means2d.new_zeros((*opacities.shape, _STRIDE))
    if len(flatten_ids):
        height, width = last_ids.shape[1:]
        _composite_backward[(isect_offsets.numel(),)](
            means2d, conics, colors, opacities, isect_offsets, flatten_ids, alphas, last_ids,
            v_renders, alphas if v_alphas is None else v_alphas, gradients,
            len(flatten_ids), height, width, isect_offsets.shape[2], isect_offsets.shape[1],
            TILE_SIZE, _BACKWARD_GAUSSIANS, _STRIDE, v_alphas is not None, absgrad, PRECISION,
            num_warps=_WARPS, num_stages=1,
        )  # fmt: skip
    v_means2d, v_conics, v_opacities, v_colors, v_absolute, _ = gradients.split([2, 3, 1, 3, 2, 1], dim=-1)
    return v_means2d, v_conics, v_colors, v_opacities[..., 0], v_absolute if absgrad else None


class _RasterizeToPixels(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, width: int, height: int,
        isect_offsets: Tensor, flatten_ids: Tensor, absgrad: bool,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        ctx.set_materialize_grads(False)  # torch would fill an image with zeros where nothing depends on alphas
        renders, alphas, last_ids = composite_forward(
            means2d, conics, colors, opacities, width, height, isect_offsets, flatten_ids
        )
        ctx.save_for_backward(means2d, conics, colors, opacities, isect_offsets, flatten_ids, alphas, last_ids)
        ctx.absgrad = absgrad
        return renders, alphas

    @staticmethod
    @once_differentiable
    def backward(  # type: ignore[override]
        ctx: Any, v_renders: Tensor | None, v_alphas: Tensor | None
    ) -> tuple[Tensor | None, ...]:
        means2d, conics, colors, opacities, starts, ids, alphas, last_ids = ctx.saved_tensors
        if v_renders is None:
            v_renders = torch.zeros((*last_ids.shape, 3), device=colors.device)
        v_means2d, v_conics, v_colors, v_opacities, v_absolute = composite_backward(
            means2d, conics, colors, opacities, starts, ids, alphas, last_ids,
            v_renders.contiguous(), None if v_alphas is None else v_alphas.contiguous(), ctx.absgrad,
        )  # fmt: skip
        if ctx.absgrad:
            means2d.absgrad = v_absolute
            means2d.grad2d = v_means2d
        return v_means2d, v_conics, v_colors, v_opacities, *[None] * 5


def rasterize_to_pixels(
    means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, width: int, height: int,
    isect_offsets: Tensor, flatten_ids: Tensor, absgrad: bool,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Call `composite_forward` differentiably, and return its colours and alphas.

    With `absgrad`, `backward` sets two attributes of `means2d`: `absgrad`, the sum of its absolute gradients, and
    `grad2d`, its gradient, which is None until then: `retain_grad` would copy the gradient.
    """
    means2d = means2d.contiguous()
    if absgrad:
        means2d.grad2d = None  # type: ignore[attr-defined]
    return _RasterizeToPixels.apply(  # type: ignore[return-value]
        means2d, conics.contiguous(), colors.contiguous(), opacities.contiguous(),
        width, height, isect_offsets, flatten_ids, absgrad,
    )  # fmt: skip


def rasterize_channels(
    means2d: Tensor, conics: Tensor, colors: Tensor, opacities: Tensor, width: int, height: int,
    isect_offsets: Tensor, flatten_ids: Tensor,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Composite any number of channels [C, N, D], three at a time; otherwise as `rasterize_to_pixels` without absgrad.

    Returns:
        Colours [C, height, width, D], and alphas [C, height, width, 1].
    """
    num_channels = colors.shape[-1]
    missing = -num_channels % 3
    padded = torch.nn.functional.pad(colors, (0, missing))
    renders = []
    alphas = []
    for three in padded.split(3, dim=-1):
        render, alpha = rasterize_to_pixels(
            means2d, conics, three, opacities, width, height, isect_offsets, flatten_ids, False
        )  # fmt: skip
        renders.append(render)
        alphas.append(alpha)
    return torch.cat(renders, dim=-1)[..., :num_channels], alphas[0]
