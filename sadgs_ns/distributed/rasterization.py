"""Rasterization of Gaussians that are spread over several processes."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

from torch import Tensor

from sadgs_ns.distributed.bands import Band, share_rows
from sadgs_ns.distributed.exchange import Exchange
from sadgs_ns.distributed.world import World
from sadgs_ns.render import rasterization as render
from sadgs_ns.render.types import Cameras, Gaussians, RenderOptions


class Picture(NamedTuple):
    """Rows of one view, or all views, that this process composited."""

    band: Band | None  # Which rows of one view they are, and which of them count; None is all rows of all views
    colors: Tensor  # [B, H', W, D]
    alphas: Tensor  # [B, H', W, 1]


def rasterize(
    world: World, gaussians: Gaussians, cameras: Cameras, options: RenderOptions, color_maps: Tensor | None = None
) -> tuple[list[Picture], dict[str, Any]]:
    """Render the Gaussians of all processes into V cameras; each process composites its share of the rows.

    Every process must call this with the same cameras, options and colour maps (`project` tells of these), and then
    `backward`, in the same order. `gaussians` are those of this process, and `world.sizes` must be right. Several
    processes wait for the exact lengths of tile lists, and give `viewmats` no gradient. Raises InputError as
    `render.rasterization.rasterize`.

    Returns the pictures that this process composited, and the `info` of its Gaussians in all views. A single process
    composites one picture of everything. With several processes, `info` has `anchor`, which `Exchange.send` returns,
    and `num_pairs` and `num_pixels` that this process composited.
    """
    if world.is_single:
        colors, alphas, info = render.rasterize(gaussians, cameras, options, color_maps=color_maps)
        return [Picture(None, colors, alphas)], info
    options = replace(options, tile_capacity=None)
    projected = render.project(gaussians, cameras, options, color_maps=color_maps, begin_tiles=False)
    bands = share_rows(len(cameras.viewmats), cameras.height, world.num_ranks)
    exchange = Exchange(world, projected, bands)
    anchor, received = exchange.send(projected, options.absgrad)
    pictures = []
    num_pairs = 0
    num_pixels = 0
    for band, splats in zip(exchange.bands, received, strict=True):
        colors, alphas, info = render.composite(splats, options)
        pictures.append(Picture(band, colors, alphas))
        num_pairs += len(info["flatten_ids"])
        num_pixels += splats.height * splats.width
    of_exchange = {"anchor": anchor, "num_pairs": num_pairs, "num_pixels": num_pixels}
    return pictures, projected.info() | of_exchange
