"""gsplat's `rasterization`, assembled from its own parts with exact tile lists and our backward pass in between."""

from __future__ import annotations

from typing import Any, Literal

import torch
from torch import Tensor

from sadgs_ns import gsplat_compat
from sadgs_ns.gsplat_compat import NEAR_PLANE
from sadgs_ns.kernels import TILE_SIZE, compositing
from sadgs_ns.kernels import projection as kernels_projection
from sadgs_ns.kernels.harmonics import MAX_DEGREE, colors_from_harmonics
from sadgs_ns.kernels.limits import check_gaussians, check_pixels
from sadgs_ns.kernels.tiles import PendingTiles, intersect_tiles
from sadgs_ns.render.off_axis import cull_off_axis
from sadgs_ns.render.projected import Projected

BACKWARD: Literal["moments", "gsplat"] = "moments"
"""Whose kernels differentiate the projection and the compositing of three channels: ours (projection.py,
compositing.py), or gsplat's as a reference."""


def rasterization(
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    scales: Tensor,  # [N, 3]
    opacities: Tensor,  # [N]
    colors: Tensor | tuple[Tensor, Tensor],  # [(C,) N, D], [(C,) N, K, 3] or [N, 3] and [N, K - 1, 3]
    viewmats: Tensor,  # [C, 4, 4]
    Ks: Tensor,  # [C, 3, 3]
    width: int,
    height: int,
    *,
    sh_degree: int | None,
    packed: bool,
    render_mode: Literal["RGB", "RGB+ED"],
    absgrad: bool,
    rasterize_mode: Literal["classic", "antialiased"],
    max_off_axis: float = 0.0,
    near_plane: float = NEAR_PLANE,
    tile_capacity: int | None = None,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render as the installed `gsplat.rasterization(..., tile_size=TILE_SIZE)` does; see
    `render.rasterization.rasterize`.

    With `tile_capacity`, `isect_offsets` has one more row of tiles than `tile_height`, and the list of the last of them
    is not drawn (`PendingTiles.lists`).

    Raises:
        ValueError: If `packed`.
        InputError: If Gaussians, pixels or tile pairs are more than the kernels can address (limits.py).
    """
    if packed:
        raise ValueError("exact tile lists are made of unpacked projections: packed=False")
    num_views = len(viewmats)
    check_gaussians(num_views, len(means))
    check_pixels(num_views, height, width)
    radii, means2d, depths, conics, opacities, means = _geometry(
        means, quats, scales, opacities, viewmats, Ks, width, height, rasterize_mode == "antialiased", near_plane
    )
    # Without a capacity the host waits for the lists' length: the colours are computed meanwhile.
    pending_tiles = intersect_tiles(means2d, radii, depths, conics, opacities, width, height, TILE_SIZE, max_off_axis)
    colors = _colors(sh_degree, means, colors, viewmats, radii, means2d)
    projected = Projected(radii, means2d, depths, conics, opacities, colors)
    return _composite(projected, width, height, pending_tiles, render_mode, absgrad, tile_capacity)


def project(
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    scales: Tensor,  # [N, 3]
    opacities: Tensor,  # [N]
    colors: Tensor | tuple[Tensor, Tensor],  # [(C,) N, D], [(C,) N, K, 3] or [N, 3] and [N, K - 1, 3]
    viewmats: Tensor,  # [C, 4, 4]
    Ks: Tensor,  # [C, 3, 3]
    width: int,
    height: int,
    sh_degree: int | None,
    *,
    near_plane: float = NEAR_PLANE,
    antialiased: bool = False,
    max_off_axis: float = 0.0,
) -> Projected:
    """Project Gaussians and compute their colours; arguments are those of `rasterization`.

    Raises:
        InputError: If Gaussians are more than the kernels can address (limits.py).
    """
    check_gaussians(len(viewmats), len(means))
    radii, means2d, depths, conics, opacities, means = _geometry(
        means, quats, scales, opacities, viewmats, Ks, width, height, antialiased, near_plane
    )
    if max_off_axis > 0:
        radii = cull_off_axis(radii, means2d, width, height, max_off_axis)
    colors = _colors(sh_degree, means, colors, viewmats, radii, means2d)
    return Projected(radii, means2d, depths, conics, opacities, colors)


def composite(
    projected: Projected, width: int, height: int, *, absgrad: bool = False
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Make the tile lists and composite; arguments and results are those of `rasterization`.

    Raises:
        InputError: If Gaussians, pixels or tile pairs are more than the kernels can address (limits.py).
    """
    check_gaussians(*projected.depths.shape)
    check_pixels(len(projected.depths), height, width)
    radii, means2d, depths, conics, opacities, _ = projected
    pending_tiles = intersect_tiles(means2d, radii, depths, conics, opacities, width, height, TILE_SIZE)
    return _composite(projected, width, height, pending_tiles, "RGB", absgrad, None)


def _geometry(
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    scales: Tensor,  # [N, 3]
    opacities: Tensor,  # [N]
    viewmats: Tensor,  # [C, 4, 4]
    Ks: Tensor,  # [C, 3, 3]
    width: int,
    height: int,
    antialiased: bool,
    near_plane: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Project Gaussians, without their colours.

    Returns:
        radii [C, N(, 2)], means2d [C, N, 2], depths [C, N], conics [C, N, 3], opacities [C, N], and the centres [N, 3]
        from which colours are to be computed.
    """
    num_views = len(viewmats)
    geometry = means, quats, scales, opacities, viewmats, Ks, width, height, antialiased, near_plane
    if BACKWARD == "moments" and not viewmats.requires_grad:
        # Colours take these centres, so that their gradient is added in the projection's backward kernel.
        radii, means2d, depths, conics, compensations, means = kernels_projection.project(*geometry)
    else:
        radii, means2d, depths, conics, compensations = gsplat_compat.project(*geometry)
    radii = radii.contiguous()  # Culling, and tile lists that are too short, set these very radii to 0.
    if compensations is not None:
        opacities = opacities * compensations
    elif num_views == 1:
        opacities = opacities[None]
    else:
        # One copy serves the tiles and compositing. `expand` would be slower: torch reduces its gradient over the views
        # ten times as slowly as it adds.
        opacities = torch.stack([opacities] * num_views)
    return radii, means2d, depths, conics, opacities, means


def _colors(
    sh_degree: int | None,
    means: Tensor,  # [N, 3]
    colors: Tensor | tuple[Tensor, Tensor],  # [(C,) N, D], [(C,) N, K, 3] or [N, 3] and [N, K - 1, 3]
    viewmats: Tensor,  # [C, 4, 4]
    radii: Tensor,  # [C, N] or [C, N, 2]
    means2d: Tensor,  # [C, N, 2]
) -> Tensor:
    """Colours of the Gaussians that are drawn, as each camera sees them. [C, N, D]"""
    num_views = len(viewmats)
    if isinstance(colors, tuple) and sh_degree is not None and sh_degree <= MAX_DEGREE and not viewmats.requires_grad:
        return colors_from_harmonics(sh_degree, means, *colors, viewmats, radii)
    if isinstance(colors, tuple):
        colors = torch.cat([colors[0][:, None], colors[1]], dim=1)
    if sh_degree is None:
        return colors.expand(num_views, -1, -1)
    coefficients = colors.expand(num_views, -1, -1, -1)
    # gsplat inverts the matrices, which makes the host wait for the device.
    positions = -(viewmats[:, :3, :3].mT @ viewmats[:, :3, 3:]).mT  # [C, 1, 3]
    drawn = gsplat_compat.drawn(radii, means2d)  # [C, N]
    colors = gsplat_compat.spherical_harmonics(sh_degree, means - positions, coefficients, drawn)
    return torch.clamp_min(colors + 0.5, 0.0)


def _composite(
    projected: Projected,
    width: int,
    height: int,
    pending_tiles: PendingTiles,
    render_mode: Literal["RGB", "RGB+ED"],
    absgrad: bool,
    tile_capacity: int | None,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Composite the Gaussians in the tile lists; arguments and results are those of `rasterization`."""
    radii, means2d, depths, conics, opacities, colors = projected
    if render_mode == "RGB+ED":
        colors = torch.cat([colors, depths[..., None]], dim=-1)
    ours = BACKWARD == "moments" and colors.shape[-1] == 3
    # gsplat's backward kernel would read the unused places, too, one after the other in a single block.
    isect_offsets, flatten_ids = pending_tiles.lists(tile_capacity if ours else None)
    splats = (means2d, conics, colors, opacities, width, height)
    if ours:
        renders, alphas = compositing.rasterize_to_pixels(*splats, isect_offsets, flatten_ids, absgrad)
    else:
        renders, alphas = gsplat_compat.rasterize_to_pixels(*splats, TILE_SIZE, isect_offsets, flatten_ids, absgrad)
    if render_mode == "RGB+ED":
        renders = torch.cat([renders[..., :-1], renders[..., -1:] / alphas.clamp_min(1e-10)], dim=-1)
    info = {
        "camera_ids": None,
        "gaussian_ids": None,
        "radii": radii,
        "means2d": means2d,
        "depths": depths,
        "conics": conics,
        "opacities": opacities,
        "tile_width": pending_tiles.tile_counts[2],
        "tile_height": pending_tiles.tile_counts[1],
        "flatten_ids": flatten_ids,
        "isect_offsets": isect_offsets,
        "width": width,
        "height": height,
        "tile_size": TILE_SIZE,
        "n_cameras": len(means2d),
        "pair_counts": pending_tiles.pair_counts,
    }
    return renders, alphas, info
