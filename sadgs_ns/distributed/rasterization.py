"""Rasterization of Gaussians that are spread over several processes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

from torch import Tensor

from sadgs_ns.distributed.bands import Band, share_out
from sadgs_ns.distributed.exchange import Exchange
from sadgs_ns.distributed.world import World
from sadgs_ns.render.rasterization import composite, project
from sadgs_ns.render.types import DEFAULTS, Cameras, Gaussians, RenderOptions


class RenderedBand(NamedTuple):
    """Rows of a view that this process composited, from `band.top` to `band.bottom`."""

    band: Band
    """Which rows they are, and which of them count."""
    colors: Tensor
    """[1, H', W, D]"""
    alphas: Tensor
    """[1, H', W, 1]"""


def rasterize(
    world: World, gaussians: Gaussians, cameras: Cameras, options: RenderOptions = DEFAULTS
) -> tuple[list[RenderedBand], Tensor, dict[str, Any]]:
    """Render the Gaussians of all processes into V cameras, of which each process composites its share.

    Every process must call this, and `backward` of something to which the anchor was added, in the same order. Raises
    InputError as `render.rasterization.rasterize`.

    Args:
        world: The processes, whose `sizes` are right.
        gaussians: Those of this process.
        cameras: The same in all processes; `viewmats` gets no gradient.
        options: The same in all processes. The exact lengths of tile lists are waited for.

    Returns:
        The bands of this process; the anchor, a zero that must be added to the loss; and gsplat's `info` of this
        process's Gaussians in all views, whose `means2d` has `absgrad` and `grad2d` after `backward` where `absgrad`
        was asked for. In `info`, `num_pairs` and `num_pixels` are those of what this process composited.
    """
    options = replace(options, tile_capacity=None)
    projected = project(gaussians, cameras, options, begin_tiles=False)
    exchange = Exchange(world, projected, share_out(len(cameras.viewmats), cameras.height, world.num_ranks))
    anchor, received = exchange.send(projected, options.absgrad)
    rendered, num_pairs, num_pixels = [], 0, 0
    for band, splats in zip(exchange.bands, received, strict=True):
        renders, alphas, info = composite(splats, options)
        rendered.append(RenderedBand(band, renders, alphas))
        num_pairs, num_pixels = num_pairs + len(info["flatten_ids"]), num_pixels + splats.height * splats.width
    return rendered, anchor, projected.info() | {"num_pairs": num_pairs, "num_pixels": num_pixels}
