"""gsplat's CUDA kernels behind `project` and `composite`, by gsplat's public functions alone."""

from __future__ import annotations

from typing import Any

import gsplat
import torch
from torch import Tensor

from sadgs_ns import gsplat_compat
from sadgs_ns.render.ewa import view_directions
from sadgs_ns.render.off_axis import cull_off_axis
from sadgs_ns.render.types import Cameras, Gaussians, Projected, RenderOptions

TILE_SIZE = 16  # Size of tiles in px: gsplat's own choice, with which its kernels are fastest


def project(gaussians: Gaussians, cameras: Cameras, options: RenderOptions, begin_tiles: bool = True) -> Projected:
    """Do what `rasterization.project` says."""
    viewmats, _, width, height = cameras
    radii, means2d, depths, conics = gsplat_compat.project(*gaussians[:4], *cameras, options.near_plane)
    if options.max_off_axis > 0:
        radii = cull_off_axis(radii, means2d, width, height, options.max_off_axis)
    opacities = opacities_in_views(gaussians.opacities, len(viewmats))
    colors = colors_in_views(gaussians, viewmats, radii, means2d, options.sh_degree)
    return Projected(radii, means2d, depths, conics, opacities, colors, width, height)


def opacities_in_views(opacities: Tensor, num_views: int) -> Tensor:
    """Return opacities [N] once for each view. [C, N]"""
    if num_views == 1:
        return opacities[None]
    # Torch reduces the gradient of `expand` ten times as slowly as it adds.
    return torch.stack([opacities] * num_views)


def colors_in_views(
    gaussians: Gaussians, viewmats: Tensor, radii: Tensor, means2d: Tensor, sh_degree: int | None
) -> Tensor:
    """Return colours as cameras see them [C, N, D], computed where Gaussians are drawn."""
    num_views = len(viewmats)
    colors = gaussians.joined_colors()
    if sh_degree is None:
        return colors.expand(num_views, -1, -1)
    directions = view_directions(gaussians.means, viewmats)
    coefficients = colors.expand(num_views, -1, -1, -1)
    drawn = gsplat_compat.drawn(radii, means2d)
    colors = gsplat.spherical_harmonics(sh_degree, directions, coefficients, masks=drawn)
    return torch.clamp_min(colors + 0.5, 0.0)


def composite(projected: Projected, options: RenderOptions) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Composite as `rasterization.composite` does, without expected depth; the last result goes into its info."""
    radii, means2d, depths, conics, opacities, colors, width, height, _ = projected
    columns = -(-width // TILE_SIZE)
    rows = -(-height // TILE_SIZE)
    _, keys, flatten_ids = gsplat.isect_tiles(means2d, radii, depths, TILE_SIZE, columns, rows)
    starts = gsplat.isect_offset_encode(keys, len(means2d), columns, rows)
    renders, alphas = gsplat.rasterize_to_pixels(
        means2d, conics, colors, opacities, width, height, TILE_SIZE, starts, flatten_ids, absgrad=options.absgrad
    )
    return renders, alphas, {"flatten_ids": flatten_ids}
