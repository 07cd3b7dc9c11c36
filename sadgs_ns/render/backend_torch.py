"""Gaussian splatting in plain torch, as gsplat draws, in float32 or float64, by chunks that bound the memory."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from sadgs_ns.gsplat_compat import FAR_PLANE, RADII_PER_AXIS, SCREEN_BLUR
from sadgs_ns.render.ewa import covariances, perspective, spherical_harmonics, world_to_camera
from sadgs_ns.render.off_axis import cull_off_axis
from sadgs_ns.render.types import Cameras, Gaussians, Projected, RenderOptions

TILE_SIZE = 16  # Size of tiles in px

# These three are the constants of gsplat's compositing.
_MAX_ALPHA = 0.999
_MIN_ALPHA = 1.0 / 255.0
_MIN_TRANSMITTANCE = 1e-4
_MAX_SIGMA = 60.0  # exp(-sigma) is invisible long before; beyond 87 it would be subnormal, many times slower to compute
_CHUNK_PAIRS = 1 << 18  # Pairs of a pixel and a Gaussian held at a time in ten temporaries, unless a segment has more
_SEGMENT = 128  # Most Gaussians of a tile's list that are composited at once, so that opaque tiles can stop early


class _Tiles(NamedTuple):
    """Lists of the Gaussians that each tile draws, front to back. T = C * tile_height * tile_width."""

    size: int  # pixels per side
    origins: Tensor  # [T, 2] pixel coordinates of the tile's corner
    offsets: Tensor  # [T] start of the tile's list in `flatten_ids`
    counts: Tensor  # [T] length of the tile's list
    flatten_ids: Tensor  # [n_isects] indices into the flattened [C * N]


class _Segment(NamedTuple):
    """Part of the lists of B tiles, padded to the same length L. S is the tile size."""

    ids: Tensor  # [B, L] indices into the flattened [C * N]
    dx: Tensor  # [B, 1, S, L] means2d - pixel centre
    dy: Tensor  # [B, S, 1, L]
    conics: tuple[Tensor, Tensor, Tensor]  # 3 x [B, 1, 1, L]
    opacities: Tensor  # [B, L], zero in the padding
    alphas: Tensor  # [B, S, S, L], zero where a Gaussian is skipped
    transmittances: Tensor  # [B, S, S, L + 1] before each Gaussian, then after the last
    weights: Tensor  # [B, S, S, L] alpha * transmittance, zero once the pixel is done


def project(gaussians: Gaussians, cameras: Cameras, options: RenderOptions, begin_tiles: bool = True) -> Projected:
    """Do what `rasterization.project` says; differentiable by all but `Ks`."""
    means, quats, scales, opacities, _ = gaussians
    colors = gaussians.joined_colors()
    viewmats, Ks, width, height = cameras
    C = len(viewmats)
    N = len(means)
    means2d, depths, conics, covars2d, valid = _project(
        means, quats, scales, viewmats, Ks, width, height, options.near_plane
    )
    opacities = opacities.expand(C, N)
    radii = _radii(means2d, covars2d, opacities, valid, width, height)
    if options.max_off_axis > 0:
        radii = cull_off_axis(radii, means2d, width, height, options.max_off_axis)
    if options.sh_degree is not None:
        dirs = means - torch.inverse(viewmats)[:, None, :3, 3]  # [C, N, 3]
        colors = spherical_harmonics(options.sh_degree, dirs, colors.expand(C, N, -1, 3))
        colors = (colors + 0.5).clamp_min(0.0)
    return Projected(radii, means2d, depths, conics, opacities, colors.expand(C, N, -1), width, height)


def composite(projected: Projected, options: RenderOptions) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Composite as `rasterization.composite` does, without expected depth; the last result goes into its info."""
    radii, means2d, depths, conics, opacities, colors, width, height, _ = projected
    C = len(means2d)
    if radii.dim() < means2d.dim():
        radii = radii[..., None].expand_as(means2d)
    extents = radii.to(means2d.dtype)  # [C, N, 2]
    tiles = _bin_into_tiles(means2d, depths, extents, width, height)
    rows = math.ceil(height / TILE_SIZE)
    columns = math.ceil(width / TILE_SIZE)
    canvas: Tensor = _Composite.apply(means2d, conics, colors, opacities, tiles, options.absgrad)  # type: ignore[assignment]
    # [T, S * S, D + 1] -> [C, H, W, D + 1]: put the tiles' pixels in rows and crop what overhangs the image.
    canvas = canvas.reshape(C, rows, columns, TILE_SIZE, TILE_SIZE, -1).transpose(2, 3)
    canvas = canvas.reshape(C, rows * TILE_SIZE, columns * TILE_SIZE, -1)[:, :height, :width]
    return canvas[..., :-1], canvas[..., -1:], {"flatten_ids": tiles.flatten_ids}


def _project(
    means: Tensor, quats: Tensor, scales: Tensor, viewmats: Tensor, Ks: Tensor, width: int, height: int, near: float
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Project as EWA does: means2d [C, N, 2], depths [C, N], conics [C, N, 3], covars2d [C, N, 2, 2], valid [C, N]."""
    means_c, covars_c = world_to_camera(means, covariances(quats, scales), viewmats)  # [C, N, 3], [C, N, 3, 3]
    depths = means_c[..., 2]
    valid = (depths >= near) & (depths <= FAR_PLANE)
    # Culled Gaussians are projected from somewhere harmless, or dividing by their depth could put NaN in gradients.
    means_c = torch.where(valid[..., None], means_c, means_c.new_tensor([0.0, 0.0, 1.0]))
    means2d, covars2d = perspective(means_c, covars_c, Ks, width, height)
    # Gaussians of billions of px, whose determinant overflows, have no inverse and are culled, too.
    valid = valid & _determinant(covars2d.detach()).isfinite()
    identity = torch.eye(2, dtype=means.dtype, device=means.device)
    covars2d = torch.where(valid[..., None, None], covars2d, identity) + SCREEN_BLUR * identity
    det = _determinant(covars2d)
    valid = valid & (det > 0)
    det = torch.where(valid, det, 1.0)
    adjugates = torch.stack([covars2d[..., 1, 1], -covars2d[..., 0, 1], covars2d[..., 0, 0]], dim=-1)
    conics = adjugates / det[..., None]
    return means2d, depths, conics, covars2d, valid


def _determinant(matrices: Tensor) -> Tensor:
    """Determinants [...] of matrices [..., 2, 2]; torch.linalg.det would make LU decompositions."""
    return matrices[..., 0, 0] * matrices[..., 1, 1] - matrices[..., 0, 1] * matrices[..., 1, 0]


@torch.no_grad()
def _radii(means2d: Tensor, covars2d: Tensor, opacities: Tensor, valid: Tensor, width: int, height: int) -> Tensor:
    """Half sizes in whole pixels of the rectangles in which the Gaussians are drawn, as `Projected.radii`."""
    if RADII_PER_AXIS:
        valid = valid & (opacities >= _MIN_ALPHA)
        sigmas = (2.0 * (opacities / _MIN_ALPHA).clamp_min(1.0).log()).sqrt().clamp_max(3.33)
        extents = (sigmas[..., None] * covars2d.diagonal(dim1=-2, dim2=-1).sqrt()).ceil()
    else:
        half_trace = 0.5 * (covars2d[..., 0, 0] + covars2d[..., 1, 1])
        long_axis = half_trace + (half_trace.square() - _determinant(covars2d)).clamp_min(0.01).sqrt()
        extents = (3.0 * long_axis.sqrt()).ceil()[..., None].expand_as(means2d)
    image = extents.new_tensor([width, height])
    on_screen = ((means2d + extents > 0) & (means2d - extents < image)).all(dim=-1)
    # The ceiling keeps the radii of enormous Gaussians inside int32.
    radii = torch.where((valid & on_screen)[..., None], extents.clamp_max(1e9), 0.0).int()
    if not RADII_PER_AXIS:
        return radii[..., 0]
    return radii


@torch.no_grad()
def _bin_into_tiles(
    means2d: Tensor,  # [C, N, 2]
    depths: Tensor,  # [C, N]
    extents: Tensor,  # [C, N, 2], radii along x and y
    width: int,
    height: int,
) -> _Tiles:
    """Make the tiles' lists, as gsplat's `isect_tiles` and `isect_offset_encode` do."""
    C, N = depths.shape
    device = means2d.device
    tile_width = math.ceil(width / TILE_SIZE)
    tile_height = math.ceil(height / TILE_SIZE)
    n_tiles = tile_width * tile_height
    grid = torch.tensor([tile_width, tile_height], device=device)
    visible = (extents > 0).all(dim=-1)
    # gsplat divides before it adds; the same order rounds to the same tiles.
    centers = means2d / TILE_SIZE
    reach = extents / TILE_SIZE
    low = (centers - reach).floor().clamp(-1e9, 1e9).long().clamp_min(0).minimum(grid)  # [C, N, 2]
    high = (centers + reach).ceil().clamp(-1e9, 1e9).long().clamp_min(0).minimum(grid)
    spans = (high - low) * visible[..., None]  # [C, N, 2]
    counts = spans.prod(dim=-1).flatten()  # [C * N]
    flatten_ids = torch.repeat_interleave(counts)  # [n_isects]
    starts = counts.cumsum(0) - counts  # [C * N]
    nth = torch.arange(len(flatten_ids), device=device) - starts[flatten_ids]
    columns = spans.reshape(-1, 2)[flatten_ids, 0]
    first_x, first_y = low.reshape(-1, 2)[flatten_ids].unbind(dim=1)
    tile_x = first_x + nth % columns
    tile_y = first_y + nth // columns
    tile_ids = tile_y * tile_width + tile_x
    camera_ids = flatten_ids // max(N, 1)
    # A key has the camera, the tile and the bits of the float32 depth, whose order is that of depths ≥ 0.
    depth_bits = depths.flatten().float().view(torch.int32).long()[flatten_ids]
    keys = (camera_ids << (32 + n_tiles.bit_length())) | (tile_ids << 32) | depth_bits
    flatten_ids = flatten_ids[keys.argsort(stable=True)]
    per_tile = torch.bincount(camera_ids * n_tiles + tile_ids, minlength=C * n_tiles)  # [T]
    offsets = per_tile.cumsum(0) - per_tile
    tops = TILE_SIZE * torch.arange(tile_height, device=device)
    lefts = TILE_SIZE * torch.arange(tile_width, device=device)
    origins = torch.cartesian_prod(tops, lefts).flip(1).repeat(C, 1)
    return _Tiles(TILE_SIZE, origins, offsets, per_tile, flatten_ids)


class _Composite(torch.autograd.Function):
    """Front-to-back alpha compositing of tile lists into [T, S * S, D + 1], whose last channel is alpha."""

    @staticmethod
    def forward(
        ctx: Any,
        means2d: Tensor,  # [C, N, 2]
        conics: Tensor,  # [C, N, 3]
        colors: Tensor,  # [C, N, D]
        opacities: Tensor,  # [C, N]
        tiles: _Tiles,
        absgrad: bool,
    ) -> Tensor:
        values = torch.cat([colors, torch.ones_like(colors[..., :1])], dim=-1).flatten(0, 1)  # [C * N, D + 1]
        canvas = values.new_zeros(len(tiles.counts), tiles.size**2, values.shape[-1])
        # Of the pairs only the transmittance before each segment is kept: the backward pass begins with the last.
        ctx.starts = []
        for chunk, length in _chunks(tiles):
            starts = [values.new_ones(len(chunk), tiles.size, tiles.size)]
            for begin in range(0, length, _SEGMENT):
                segment = _segment(means2d, conics, opacities, tiles, chunk, begin, length, starts[-1])
                canvas[chunk] += segment.weights.flatten(1, 2) @ values[segment.ids]
                transmittance = segment.transmittances[..., -1].clone()
                if begin + _SEGMENT >= length or not (transmittance > _MIN_TRANSMITTANCE).any():
                    break
                starts.append(transmittance)
            ctx.starts.append(starts)
        ctx.save_for_backward(means2d, conics, colors, opacities, canvas)
        ctx.tiles = tiles
        ctx.absgrad = absgrad
        return canvas

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        means2d, conics, colors, opacities, canvas = ctx.saved_tensors
        tiles: _Tiles = ctx.tiles
        v_canvas = grad_outputs[0]  # [T, S * S, D + 1]
        D = colors.shape[-1]
        flat_colors = colors.flatten(0, 1)
        sizes = [2, 3, 1, D]
        if ctx.absgrad:
            sizes.append(2)
        grads = means2d.new_zeros(opacities.numel(), sum(sizes))  # [C * N, 6 + D (+ 2)]
        for (chunk, length), starts in zip(_chunks(tiles), ctx.starts, strict=True):
            v_colors, v_alphas = v_canvas[chunk].split([D, 1], dim=-1)  # [B, S * S, D], [B, S * S, 1]
            # The colour behind a Gaussian, dotted with v_colors. Alpha is a channel with a background of −1.
            behind = (canvas[chunk][..., -1:] - 1.0) * v_alphas  # [B, S * S, 1]
            for index in reversed(range(len(starts))):
                begin = index * _SEGMENT
                segment = _segment(means2d, conics, opacities, tiles, chunk, begin, length, starts[index])
                rows, behind = _segment_gradients(segment, flat_colors[segment.ids], v_colors, behind, ctx.absgrad)
                grads.index_add_(0, segment.ids.flatten(), rows)
        v_means2d, v_conics, v_opacities, v_values, *v_absolute = (
            grad.reshape(*opacities.shape, grad.shape[-1]) for grad in grads.split(sizes, dim=-1)
        )
        if ctx.absgrad:
            means2d.absgrad = v_absolute[0]
        return v_means2d, v_conics, v_values, v_opacities[..., 0], None, None


def _chunks(tiles: _Tiles) -> Iterator[tuple[Tensor, int]]:
    """Groups [B] of tiles, longest lists first, whose padded segments fit `_CHUNK_PAIRS`, with their longest length."""
    order = tiles.counts.argsort(descending=True, stable=True)
    lengths = tiles.counts[order].tolist()
    start = 0
    while start < len(lengths) and lengths[start] > 0:
        size = max(1, _CHUNK_PAIRS // (tiles.size**2 * min(lengths[start], _SEGMENT)))
        yield order[start : start + size], lengths[start]
        start += size


def _segment(
    means2d: Tensor,  # [C, N, 2]
    conics: Tensor,  # [C, N, 3]
    opacities: Tensor,  # [C, N]
    tiles: _Tiles,
    chunk: Tensor,  # [B]
    begin: int,
    length: int,
    start: Tensor,  # [B, S, S] transmittance before the segment
) -> _Segment:
    """Composite the entries from `begin` of the lists of a chunk of tiles; the longest list has this `length`."""
    positions = torch.arange(begin, min(begin + _SEGMENT, length), device=means2d.device)
    counts = tiles.counts[chunk, None]  # [B, 1]
    # The padding repeats a tile's own last Gaussian, with opacity zero.
    ids = tiles.flatten_ids[tiles.offsets[chunk, None] + positions.minimum(counts - 1)]
    x, y = means2d.reshape(-1, 2)[ids].unbind(-1)  # [B, L]
    a, b, c = conics.reshape(-1, 3)[ids][:, None, None].unbind(-1)  # [B, 1, 1, L]
    opacity = opacities.reshape(-1)[ids] * (positions < counts)
    centers = torch.arange(tiles.size, dtype=x.dtype, device=x.device) + 0.5
    pixels = tiles.origins[chunk, :, None] + centers  # [B, 2, S]
    dx = x[:, None, None] - pixels[:, 0, None, :, None]
    dy = y[:, None, None] - pixels[:, 1, :, None, None]
    sigmas = (0.5 * a * dx * dx + 0.5 * c * dy * dy).addcmul_(b * dy, dx)  # [B, S, S, L]
    negative = sigmas < 0
    alphas = sigmas.clamp_max_(_MAX_SIGMA).neg_().exp_().mul_(opacity[:, None, None]).clamp_max_(_MAX_ALPHA)
    alphas.masked_fill_(negative.logical_or_(alphas < _MIN_ALPHA), 0.0)
    transmittances = torch.cat([start[..., None], 1.0 - alphas], dim=-1).cumprod(dim=-1)
    # The Gaussian that would leave too little transmittance, and all behind it, are not drawn.
    weights = (alphas * transmittances[..., :-1]).masked_fill_(transmittances[..., 1:] <= _MIN_TRANSMITTANCE, 0.0)
    return _Segment(ids, dx, dy, (a, b, c), opacity, alphas, transmittances, weights)


def _segment_gradients(
    segment: _Segment,
    colors: Tensor,  # [B, L, D]
    v_colors: Tensor,  # [B, S * S, D]
    behind: Tensor,  # [B, S * S, 1] the colour behind the segment, dotted with v_colors
    absgrad: bool,
) -> tuple[Tensor, Tensor]:
    """Return gradients [B * L, 6 + D (+ 2)] of means2d, conics, opacity, colours (and absgrad), and a new `behind`.

    The new `behind` is for the segment before this one: it includes this segment. `v_name` is the gradient of the loss
    by `name`.
    """
    dx = segment.dx
    dy = segment.dy
    alphas = segment.alphas
    weights = segment.weights
    a, b, c = segment.conics
    dots = v_colors @ colors.mT  # [B, S * S, L]
    # The colour that each Gaussian adds to the pixel, dotted with v_colors; the last entry is all behind the segment.
    added = torch.cat([weights.flatten(1, 2) * dots, behind], dim=-1)  # [B, S * S, L + 1]
    from_behind = added.flip(-1).cumsum(dim=-1).flip(-1)  # Each entry and those behind it. [B, S * S, L + 1]
    hidden = from_behind[..., 1:].reshape_as(alphas).div_(1.0 - alphas)
    v_alphas = dots.view_as(alphas) * segment.transmittances[..., :-1]
    v_alphas.sub_(hidden)
    v_sigmas = v_alphas.mul_(alphas).neg_()
    # Nothing flows through a Gaussian that is not drawn or whose alpha is cut off at the top.
    has_no_gradient = (weights == 0) | (alphas >= _MAX_ALPHA)
    v_sigmas.masked_fill_(has_no_gradient, 0.0)
    # Sums of v_sigmas over the pixels, times dx (mx), dy (my) and their products (mxx, mxy, myy). dx depends on the
    # column only and dy on the row only, so that the other axis is summed first.
    column_sums = v_sigmas.sum(dim=1, keepdim=True)  # [B, 1, S, L]
    row_sums = v_sigmas.sum(dim=2, keepdim=True)  # [B, S, 1, L]
    row_sums_x = (v_sigmas * dx).sum(dim=2, keepdim=True)  # [B, S, 1, L]
    # [B, L]
    total = row_sums.sum(dim=(1, 2))
    mx = (column_sums * dx).sum(dim=(1, 2))
    my = (row_sums * dy).sum(dim=(1, 2))
    mxx = (column_sums * dx * dx).sum(dim=(1, 2))
    mxy = (row_sums_x * dy).sum(dim=(1, 2))
    myy = (row_sums * dy * dy).sum(dim=(1, 2))
    a0 = a[:, 0, 0]
    b0 = b[:, 0, 0]
    c0 = c[:, 0, 0]
    # alpha = opacity * exp(-sigma) wherever v_sigma is not zero, and then opacity >= _MIN_ALPHA.
    v_opacity = -total / segment.opacities.clamp_min(_MIN_ALPHA)
    v_x = a0 * mx + b0 * my
    v_y = b0 * mx + c0 * my
    v_geometry = torch.stack([v_x, v_y, 0.5 * mxx, mxy, 0.5 * myy, v_opacity], dim=-1)  # [B, L, 6]
    parts = [v_geometry, weights.flatten(1, 2).mT @ v_colors]
    if absgrad:
        # [B, S, S, L]
        slopes_x = a * dx + b * dy
        slopes_y = b * dx + c * dy
        absolute_x = slopes_x.mul_(v_sigmas).abs_()
        absolute_y = slopes_y.mul_(v_sigmas).abs_()
        absolute = [absolute_x.sum(dim=(1, 2)), absolute_y.sum(dim=(1, 2))]
        parts.append(torch.stack(absolute, dim=-1))
    return torch.cat(parts, dim=-1).flatten(0, 1), from_behind[..., :1]
