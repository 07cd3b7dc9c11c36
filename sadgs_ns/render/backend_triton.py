"""Our Triton kernels behind `project` and `composite`."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from sadgs_ns.errors import InputError
from sadgs_ns.kernels import TILE_SIZE, compositing
from sadgs_ns.kernels import projection as kernels_projection
from sadgs_ns.kernels.harmonics import MAX_DEGREE, colors_from_harmonics
from sadgs_ns.kernels.limits import check_gaussians, check_pixels
from sadgs_ns.kernels.tiles import intersect_tiles
from sadgs_ns.render.backend_gsplat import opacities_in_views
from sadgs_ns.render.ewa import spherical_harmonics, view_directions
from sadgs_ns.render.off_axis import cull_off_axis
from sadgs_ns.render.types import Cameras, Gaussians, Projected, RenderOptions


def project(gaussians: Gaussians, cameras: Cameras, options: RenderOptions, begin_tiles: bool = True) -> Projected:
    """Do what `rasterization.project` says."""
    viewmats, _, width, height = cameras
    check_gaussians(len(viewmats), len(gaussians.means))
    if begin_tiles:
        check_pixels(len(viewmats), height, width)
    # Colours take these centres, so that their gradient is added in the projection's backward kernel.
    radii, means2d, depths, conics, means = kernels_projection.project(*gaussians[:4], *cameras, options.near_plane)
    gaussians = gaussians._replace(means=means)
    radii = radii.contiguous()  # Culling, and tile lists that are too short, set these very radii to 0.
    opacities = opacities_in_views(gaussians.opacities, len(viewmats))
    tiles = None
    if begin_tiles:
        # Without a capacity the host waits for the lists' length: the colours are computed meanwhile.
        ellipses = means2d, radii, depths, conics, opacities
        tiles = intersect_tiles(*ellipses, width, height, TILE_SIZE, options.max_off_axis)
    elif options.max_off_axis > 0:
        radii = cull_off_axis(radii, means2d, width, height, options.max_off_axis)
    degree = options.sh_degree
    colors = gaussians.colors
    if isinstance(colors, tuple) and degree is not None and degree <= MAX_DEGREE:
        colors = colors_from_harmonics(degree, gaussians.means, *colors, viewmats, radii)
    else:
        colors = _colors_in_views(gaussians, viewmats, degree)
    return Projected(radii, means2d, depths, conics, opacities, colors, width, height, tiles)


def _colors_in_views(gaussians: Gaussians, viewmats: Tensor, sh_degree: int | None) -> Tensor:
    """Return features once for each view, or in torch the colours of coefficients that our kernel does not take.

    [C, N, D]
    """
    num_views = len(viewmats)
    colors = gaussians.joined_colors()
    if sh_degree is None:
        return colors.expand(num_views, -1, -1)
    if sh_degree > MAX_DEGREE:
        raise InputError(
            f"The backend triton draws spherical harmonics up to degree {MAX_DEGREE}, and these have {sh_degree}."
        )
    directions = view_directions(gaussians.means, viewmats)
    coefficients = colors.expand(num_views, -1, -1, -1)
    return torch.clamp_min(spherical_harmonics(sh_degree, directions, coefficients) + 0.5, 0.0)


def composite(projected: Projected, options: RenderOptions) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Composite as `rasterization.composite` does, without expected depth; the last result goes into its info.

    With `options.tile_capacity`, the tile lists have one more row of tiles than the image (`PendingTiles.lists`).
    """
    radii, means2d, depths, conics, opacities, colors, width, height, tiles = projected
    if options.absgrad and colors.shape[-1] != 3:
        problem = f"The backend triton sums absolute gradients of 3 channels, and these are {colors.shape[-1]}"
        raise InputError(f"{problem}: render depths or features without absgrad, or take the backend gsplat.")
    if tiles is None:
        check_gaussians(*depths.shape)
        check_pixels(len(depths), height, width)
        tiles = intersect_tiles(means2d, radii, depths, conics, opacities, width, height, TILE_SIZE)
    splats = (means2d, conics, colors, opacities, width, height)
    starts, flatten_ids, overflowed = tiles.lists(options.tile_capacity)
    if colors.shape[-1] == 3:
        renders, alphas = compositing.rasterize_to_pixels(*splats, starts, flatten_ids, options.absgrad)
    else:
        renders, alphas = compositing.rasterize_channels(*splats, starts, flatten_ids)
    lists = {"flatten_ids": flatten_ids, "pair_counts": tiles.pair_counts, "overflowed": overflowed}
    return renders, alphas, lists
