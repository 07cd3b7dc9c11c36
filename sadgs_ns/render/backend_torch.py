"""Gaussian splatting in plain torch, for machines without a CUDA device.

`rasterization` draws what gsplat's `rasterization` draws, with the same arguments, cut-offs, tile lists and `info`, in
float32 or float64, on any device. It exists so that models and densification strategies can be trained and tested on a
CPU; on a GPU gsplat is much faster.

Projection and spherical harmonics are gsplat's own torch functions. Compositing is an autograd function which handles
bounded chunks of (pixel, Gaussian) pairs and evaluates them again in the backward pass, so that the peak memory does
not grow with the number of pairs.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from sadgs_ns.gsplat_compat import (
    FAR_PLANE,
    NEAR_PLANE,
    RADII_PER_AXIS,
    SCREEN_BLUR,
    torch_persp_proj,
    torch_quat_scale_to_covar_preci,
    torch_spherical_harmonics,
    torch_world_to_cam,
)
from sadgs_ns.render.off_axis import near_axis
from sadgs_ns.render.projected import Projected

RenderMode = Literal["RGB", "D", "ED", "RGB+D", "RGB+ED"]
RasterizeMode = Literal["classic", "antialiased"]

# These are the constants of gsplat's compositing.
_MAX_ALPHA = 0.999
_MIN_ALPHA = 1.0 / 255.0
_MIN_TRANSMITTANCE = 1e-4
# exp(-sigma) is invisible long before this. Beyond 87 it would be subnormal, which is many times slower to compute.
_MAX_SIGMA = 60.0

# This many (pixel, Gaussian) pairs are held at a time at most, unless a segment of one tile has more. About ten
# temporaries have this many elements.
_CHUNK_PAIRS = 1 << 18
# Tile lists are composited in segments of at most this many Gaussians, so that opaque tiles can stop early.
_SEGMENT = 128


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


def rasterization(
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    scales: Tensor,  # [N, 3]
    opacities: Tensor,  # [N]
    colors: Tensor,  # [(C,) N, D] or [(C,) N, K, 3]
    viewmats: Tensor,  # [C, 4, 4]
    Ks: Tensor,  # [C, 3, 3]
    width: int,
    height: int,
    near_plane: float = NEAR_PLANE,
    far_plane: float = FAR_PLANE,
    radius_clip: float = 0.0,
    eps2d: float = SCREEN_BLUR,
    sh_degree: int | None = None,
    packed: bool = False,
    tile_size: int = 16,
    backgrounds: Tensor | None = None,  # [C, D]
    render_mode: RenderMode = "RGB",
    *,
    absgrad: bool = False,
    rasterize_mode: RasterizeMode = "classic",
    per_axis_radii: bool | None = None,
    max_off_axis: float = 0.0,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render N Gaussians into C pinhole cameras, as gsplat's `rasterization(..., packed=False)` does.

    Differentiable with respect to all float arguments except `Ks`. Where nothing is said here, an argument is gsplat's,
    and is explained for `render.rasterization.rasterize`, too.

    Args:
        far_plane: Gaussians whose centre is farther are culled, in world units.
        radius_clip: Gaussians with a screen radius of at most this many pixels are culled.
        eps2d: Added to the diagonal of the projected covariances, in pixels squared.
        packed: Only False is supported.
        tile_size: Pixels per side of a tile.
        backgrounds: Colours behind the Gaussians. [C, D]
        render_mode: "RGB" renders colours, "D" accumulated depth, "ED" expected depth; the sums append depth.
        rasterize_mode: "antialiased" multiplies opacities by the area ratio of the Gaussians before and after `eps2d`.
        per_axis_radii: Whether `info["radii"]` and the culling follow gsplat >= 1.5 (int32 [C, N, 2], the extent in x
            and y at which alpha falls below 1/255) or gsplat 1.4 (int32 [C, N], three standard deviations of the long
            axis); None follows the installed gsplat.
        max_off_axis: Gaussians further off the axis are culled, which gsplat cannot (off_axis.py); 0 culls none.

    Returns:
        `render_colors` [C, height, width, X] with X = D, 1 or D + 1 by `render_mode`; `render_alphas`
        [C, height, width, 1] in [0, 1]; and gsplat's `info`. As in gsplat, rows of `info["means2d"]`,
        `info["conics"]` and `info["opacities"]` have no meaning where the radii are zero.

    Raises:
        ValueError: If `packed` is True, a mode is unknown, or a shape does not match.
    """
    C, N = viewmats.shape[0], means.shape[0]
    if packed:
        raise ValueError("packed=True is not supported by the torch splatter; pass packed=False")
    if render_mode not in ("RGB", "D", "ED", "RGB+D", "RGB+ED"):
        raise ValueError(f"unknown render_mode {render_mode!r}")
    if rasterize_mode not in ("classic", "antialiased"):
        raise ValueError(f"unknown rasterize_mode {rasterize_mode!r}")
    shapes = {
        "means": (means, (N, 3)),
        "quats": (quats, (N, 4)),
        "scales": (scales, (N, 3)),
        "opacities": (opacities, (N,)),
        "viewmats": (viewmats, (C, 4, 4)),
        "Ks": (Ks, (C, 3, 3)),
    }
    for name, (tensor, shape) in shapes.items():
        if tensor.shape != shape:
            raise ValueError(f"{name} has shape {tuple(tensor.shape)}, expected {shape}")
    features = 1 if sh_degree is None else 2
    if colors.shape[:-features] not in ((N,), (C, N)) or (sh_degree is not None and colors.shape[-1] != 3):
        raise ValueError(f"colors has shape {tuple(colors.shape)}, which does not fit {C} cameras and {N} Gaussians")
    if sh_degree is not None and (sh_degree + 1) ** 2 > colors.shape[-2]:
        raise ValueError(f"sh_degree {sh_degree} needs {(sh_degree + 1) ** 2} coefficients, got {colors.shape[-2]}")
    options = (eps2d, near_plane, far_plane, radius_clip, rasterize_mode == "antialiased", max_off_axis, per_axis_radii)
    projected = project(
        means, quats, scales, opacities, colors, viewmats, Ks, width, height, sh_degree, *options
    )  # fmt: skip
    return composite(projected, width, height, tile_size, render_mode, backgrounds, absgrad)


def project(
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    scales: Tensor,  # [N, 3]
    opacities: Tensor,  # [N]
    colors: Tensor,  # [(C,) N, D] or [(C,) N, K, 3]
    viewmats: Tensor,  # [C, 4, 4]
    Ks: Tensor,  # [C, 3, 3]
    width: int,
    height: int,
    sh_degree: int | None,
    eps2d: float = SCREEN_BLUR,
    near_plane: float = NEAR_PLANE,
    far_plane: float = FAR_PLANE,
    radius_clip: float = 0.0,
    antialiased: bool = False,
    max_off_axis: float = 0.0,
    per_axis_radii: bool | None = None,
) -> Projected:
    """Project Gaussians and compute their colours; arguments are those of `rasterization`, and are not checked."""
    C, N = viewmats.shape[0], means.shape[0]
    if per_axis_radii is None:
        per_axis_radii = RADII_PER_AXIS
    means2d, depths, conics, compensations, covars2d, valid = _project(
        means, quats, scales, viewmats, Ks, width, height, eps2d, near_plane, far_plane
    )
    if max_off_axis > 0:
        valid = valid & near_axis(means2d, width, height, max_off_axis)
    opacities = opacities.expand(C, N)
    if antialiased:
        opacities = opacities * compensations
    extents = _extents(means2d, covars2d, opacities, valid, width, height, radius_clip, per_axis_radii)
    radii = extents.int() if per_axis_radii else extents[..., 0].int()
    if sh_degree is not None:
        dirs = means - torch.inverse(viewmats)[:, None, :3, 3]  # [C, N, 3]
        colors = torch_spherical_harmonics(sh_degree, dirs, colors.expand(C, N, -1, 3))
        colors = (colors + 0.5).clamp_min(0.0)
    return Projected(radii, means2d, depths, conics, opacities, colors.expand(C, N, -1))


def composite(
    projected: Projected,
    width: int,
    height: int,
    tile_size: int = 16,
    render_mode: RenderMode = "RGB",
    backgrounds: Tensor | None = None,  # [C, D]
    absgrad: bool = False,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Make the tile lists and composite; arguments and results are those of `rasterization`."""
    radii, means2d, depths, conics, opacities, colors = projected
    C = len(means2d)
    per_axis_radii = radii.dim() == means2d.dim()
    extents = (radii if per_axis_radii else radii[..., None].expand_as(means2d)).to(means2d.dtype)
    tiles_per_gauss, isect_ids, flatten_ids, tiles = _bin_into_tiles(means2d, depths, extents, width, height, tile_size)
    tile_height, tile_width = math.ceil(height / tile_size), math.ceil(width / tile_size)
    info: dict[str, Any] = {
        "camera_ids": None,
        "gaussian_ids": None,
        "radii": radii,
        "means2d": means2d,
        "depths": depths,
        "conics": conics,
        "opacities": opacities,
        "tile_width": tile_width,
        "tile_height": tile_height,
        "tiles_per_gauss": tiles_per_gauss,
        "isect_ids": isect_ids,
        "flatten_ids": flatten_ids,
        "isect_offsets": tiles.offsets.int().reshape(C, tile_height, tile_width),
        "width": width,
        "height": height,
        "tile_size": tile_size,
        "n_cameras": C,
    }
    if per_axis_radii:
        info |= {"batch_ids": None, "n_batches": 1}

    if render_mode != "RGB":
        colors = depths[..., None] if render_mode in ("D", "ED") else torch.cat([colors, depths[..., None]], dim=-1)
        if backgrounds is not None:
            nothing = backgrounds.new_zeros(C, 1)
            backgrounds = nothing if render_mode in ("D", "ED") else torch.cat([backgrounds, nothing], dim=-1)

    canvas: Tensor = _Composite.apply(means2d, conics, colors, opacities, tiles, absgrad)  # type: ignore[assignment]
    # [T, S * S, D + 1] -> [C, H, W, D + 1]: put the tiles' pixels in rows and crop what overhangs the image.
    canvas = canvas.reshape(C, tile_height, tile_width, tile_size, tile_size, -1).transpose(2, 3)
    canvas = canvas.reshape(C, tile_height * tile_size, tile_width * tile_size, -1)[:, :height, :width]
    render_colors, render_alphas = canvas[..., :-1], canvas[..., -1:]
    if backgrounds is not None:
        render_colors = render_colors + (1.0 - render_alphas) * backgrounds[:, None, None, :]
    if render_mode in ("ED", "RGB+ED"):
        expected_depths = render_colors[..., -1:] / render_alphas.clamp_min(1e-10)
        render_colors = torch.cat([render_colors[..., :-1], expected_depths], dim=-1)
    return render_colors, render_alphas, info


def _project(
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    scales: Tensor,  # [N, 3]
    viewmats: Tensor,  # [C, 4, 4]
    Ks: Tensor,  # [C, 3, 3]
    width: int,
    height: int,
    eps2d: float,
    near_plane: float,
    far_plane: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Project the Gaussians as EWA splatting does.

    gsplat's own `_fully_fused_projection` is not used because its radii differ between versions and from its kernels,
    and because its gradients are NaN for Gaussians in the camera plane.

    Returns:
        means2d [C, N, 2], depths [C, N], conics [C, N, 3], compensations [C, N], covars2d [C, N, 2, 2], valid [C, N].
    """
    covars, _ = torch_quat_scale_to_covar_preci(quats, scales, compute_preci=False)
    assert covars is not None
    means_c, covars_c = torch_world_to_cam(means, covars, viewmats)  # [C, N, 3], [C, N, 3, 3]
    depths = means_c[..., 2]
    valid = (depths >= near_plane) & (depths <= far_plane)
    # Culled Gaussians are projected from somewhere harmless, or dividing by their depth could put NaN in gradients.
    means_c = torch.where(valid[..., None], means_c, means_c.new_tensor([0.0, 0.0, 1.0]))
    means2d, covars2d = torch_persp_proj(means_c, covars_c, Ks, width, height)
    # Gaussians of billions of px, whose determinant overflows, have no inverse and are culled, too.
    valid = valid & _determinant(covars2d.detach()).isfinite()
    covars2d = torch.where(valid[..., None, None], covars2d, torch.eye(2, dtype=means.dtype, device=means.device))

    det_sharp = _determinant(covars2d)
    covars2d = covars2d + eps2d * torch.eye(2, dtype=means.dtype, device=means.device)
    det = _determinant(covars2d)
    valid = valid & (det > 0)
    det = torch.where(valid, det, 1.0)
    conics = torch.stack([covars2d[..., 1, 1], -covars2d[..., 0, 1], covars2d[..., 0, 0]], dim=-1) / det[..., None]
    # The floor keeps the square root's gradient finite for flat Gaussians seen edge-on; it is itself invisible.
    compensations = (det_sharp / det).clamp_min(1e-12).sqrt()
    return means2d, depths, conics, compensations, covars2d, valid


def _determinant(matrices: Tensor) -> Tensor:
    """Determinants [...] of matrices [..., 2, 2]; torch.linalg.det would make LU decompositions."""
    return matrices[..., 0, 0] * matrices[..., 1, 1] - matrices[..., 0, 1] * matrices[..., 1, 0]


@torch.no_grad()
def _extents(
    means2d: Tensor,  # [C, N, 2]
    covars2d: Tensor,  # [C, N, 2, 2]
    opacities: Tensor,  # [C, N]
    valid: Tensor,  # [C, N]
    width: int,
    height: int,
    radius_clip: float,
    per_axis: bool,
) -> Tensor:
    """Half sizes in whole pixels of the rectangles in which the Gaussians are drawn, zero where culled. [C, N, 2]"""
    if per_axis:
        valid = valid & (opacities >= _MIN_ALPHA)
        sigmas = (2.0 * (opacities / _MIN_ALPHA).clamp_min(1.0).log()).sqrt().clamp_max(3.33)
        extents = (sigmas[..., None] * covars2d.diagonal(dim1=-2, dim2=-1).sqrt()).ceil()
    else:
        half_trace = 0.5 * (covars2d[..., 0, 0] + covars2d[..., 1, 1])
        long_axis = half_trace + (half_trace.square() - _determinant(covars2d)).clamp_min(0.01).sqrt()
        extents = (3.0 * long_axis.sqrt()).ceil()[..., None].expand_as(means2d)
    image = extents.new_tensor([width, height])
    on_screen = ((means2d + extents > 0) & (means2d - extents < image)).all(dim=-1)
    valid = valid & on_screen & (extents > radius_clip).any(dim=-1)
    # The ceiling keeps the radii of enormous Gaussians inside int32.
    return torch.where(valid[..., None], extents.clamp_max(1e9), 0.0)


@torch.no_grad()
def _bin_into_tiles(
    means2d: Tensor,  # [C, N, 2]
    depths: Tensor,  # [C, N]
    extents: Tensor,  # [C, N, 2]
    width: int,
    height: int,
    tile_size: int,
) -> tuple[Tensor, Tensor, Tensor, _Tiles]:
    """Make gsplat's `tiles_per_gauss` [C, N], `isect_ids` and `flatten_ids` [n_isects], and the tiles' lists."""
    C, N = depths.shape
    device = means2d.device
    tile_width, tile_height = math.ceil(width / tile_size), math.ceil(height / tile_size)
    n_tiles = tile_width * tile_height
    grid = torch.tensor([tile_width, tile_height], device=device)
    visible = (extents > 0).all(dim=-1)
    # gsplat divides before it adds; the same order rounds to the same tiles.
    centers, reach = means2d / tile_size, extents / tile_size
    low = (centers - reach).floor().clamp(-1e9, 1e9).long().clamp_min(0).minimum(grid)  # [C, N, 2]
    high = (centers + reach).ceil().clamp(-1e9, 1e9).long().clamp_min(0).minimum(grid)
    spans = (high - low) * visible[..., None]
    tiles_per_gauss = spans.prod(dim=-1)

    counts = tiles_per_gauss.flatten()
    flatten_ids = torch.repeat_interleave(counts)  # [n_isects]
    nth = torch.arange(len(flatten_ids), device=device) - (counts.cumsum(0) - counts)[flatten_ids]
    columns = spans.reshape(-1, 2)[flatten_ids, 0]
    tile_x = low.reshape(-1, 2)[flatten_ids, 0] + nth % columns
    tile_y = low.reshape(-1, 2)[flatten_ids, 1] + nth // columns
    tile_ids = tile_y * tile_width + tile_x
    camera_ids = flatten_ids // max(N, 1)
    # A key has the camera, the tile and the bits of the float32 depth, whose order is that of depths ≥ 0.
    depth_bits = depths.flatten().float().view(torch.int32).long()[flatten_ids]
    isect_ids = (camera_ids << (32 + n_tiles.bit_length())) | (tile_ids << 32) | depth_bits
    isect_ids, order = isect_ids.sort(stable=True)
    flatten_ids = flatten_ids[order]

    per_tile = torch.bincount(camera_ids * n_tiles + tile_ids, minlength=C * n_tiles)  # [T]
    rows, cols = torch.meshgrid(
        torch.arange(tile_height, device=device), torch.arange(tile_width, device=device), indexing="ij"
    )
    origins = (torch.stack([cols, rows], dim=-1) * tile_size).reshape(-1, 2).repeat(C, 1)
    tiles = _Tiles(tile_size, origins, per_tile.cumsum(0) - per_tile, per_tile, flatten_ids)
    return tiles_per_gauss.int(), isect_ids, flatten_ids.int(), tiles


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
        # Alpha is the image of Gaussians of colour one.
        values = torch.cat([colors, torch.ones_like(colors[..., :1])], dim=-1).flatten(0, 1)  # [C * N, D + 1]
        canvas = values.new_zeros(len(tiles.counts), tiles.size**2, values.shape[-1])
        # The transmittance at the start of each segment is kept for each chunk, since the backward pass starts from the
        # last one. Of the pairs of long lists nothing else is kept: one number for `_SEGMENT` pairs.
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
        ctx.tiles, ctx.absgrad = tiles, absgrad
        return canvas

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        means2d, conics, colors, opacities, canvas = ctx.saved_tensors
        tiles: _Tiles = ctx.tiles
        v_canvas = grad_outputs[0]  # [T, S * S, D + 1]
        D = colors.shape[-1]
        flat_colors = colors.flatten(0, 1)
        sizes = [2, 3, 1, D] + [2] * ctx.absgrad
        grads = means2d.new_zeros(opacities.numel(), sum(sizes))  # [C * N, 6 + D (+ 2)]
        for (chunk, length), starts in zip(_chunks(tiles), ctx.starts, strict=True):
            v_colors, v_alphas = v_canvas[chunk].split([D, 1], dim=-1)  # [B, S * S, D], [B, S * S, 1]
            # This is what lies behind a Gaussian, dotted with v_colors: behind the last, minus what is left to cover.
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
    """Alpha, transmittance and weight of each (pixel, Gaussian) pair of the lists' entries from `begin`."""
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
    behind: Tensor,  # [B, S * S, 1] what is behind the segment, dotted with v_colors
    absgrad: bool,
) -> tuple[Tensor, Tensor]:
    """Gradients [B * L, 6 + D (+ 2)] of means2d, conics, opacity, colours (and absgrad), and what is behind `begin`."""
    dx, dy, alphas, weights = segment.dx, segment.dy, segment.alphas, segment.weights
    a, b, c = segment.conics
    dots = v_colors @ colors.mT  # [B, S * S, L]
    shares = torch.cat([weights.flatten(1, 2) * dots, behind], dim=-1)
    shares = shares.flip(-1).cumsum(dim=-1).flip(-1)  # [B, S * S, L + 1] from each Gaussian backwards
    v_alphas = (dots.view_as(alphas) * segment.transmittances[..., :-1]).sub_(
        shares[..., 1:].reshape_as(alphas).div_(1.0 - alphas)
    )
    # Nothing flows through a Gaussian that is not drawn or whose alpha is cut off at the top.
    v_sigmas = v_alphas.mul_(alphas).neg_().masked_fill_((weights == 0) | (alphas >= _MAX_ALPHA), 0.0)

    # These are moments of v_sigmas over the pixels. dx depends on the column only and dy on the row only, so that the
    # other axis is summed first.
    columns, rows = v_sigmas.sum(dim=1, keepdim=True), v_sigmas.sum(dim=2, keepdim=True)  # [B, 1, S, L], [B, S, 1, L]
    mixed = (v_sigmas * dx).sum(dim=2, keepdim=True)  # [B, S, 1, L]
    total, mx, my, mxx, mxy, myy = (
        moment.sum(dim=(1, 2))
        for moment in (rows, columns * dx, rows * dy, columns * dx * dx, mixed * dy, rows * dy * dy)
    )  # [B, L]
    a0, b0, c0 = a[:, 0, 0], b[:, 0, 0], c[:, 0, 0]
    # alpha = opacity * exp(-sigma) wherever v_sigma is not zero, and then opacity >= _MIN_ALPHA.
    v_opacity = -total / segment.opacities.clamp_min(_MIN_ALPHA)
    columns_of = [a0 * mx + b0 * my, b0 * mx + c0 * my, 0.5 * mxx, mxy, 0.5 * myy, v_opacity]
    parts = [torch.stack(columns_of, dim=-1), weights.flatten(1, 2).mT @ v_colors]
    if absgrad:
        slopes = (a * dx + b * dy, b * dx + c * dy)  # [B, S, S, L]
        parts.append(torch.stack([slope.mul_(v_sigmas).abs_().sum(dim=(1, 2)) for slope in slopes], dim=-1))
    return torch.cat(parts, dim=-1).flatten(0, 1), shares[..., :1]
