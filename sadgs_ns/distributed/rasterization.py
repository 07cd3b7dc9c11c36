"""Rasterization of Gaussians that are spread over several processes."""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

from torch import Tensor

from sadgs_ns.distributed.bands import Band, share_out
from sadgs_ns.distributed.exchange import Exchange
from sadgs_ns.distributed.world import World
from sadgs_ns.gsplat_compat import NEAR_PLANE
from sadgs_ns.render.rasterization import composite, project


class RenderedBand(NamedTuple):
    """Rows of a view that this process composited, from `band.top` to `band.bottom`."""

    band: Band
    """Which rows they are, and which of them count."""
    colors: Tensor
    """[1, H', W, D]"""
    alphas: Tensor
    """[1, H', W, 1]"""


def rasterize(
    world: World,
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    scales: Tensor,  # [N, 3]
    opacities: Tensor,  # [N]
    colors: Tensor | tuple[Tensor, Tensor],  # [(V,) N, D], [(V,) N, K, 3] or [N, 3] and [N, K - 1, 3]
    viewmats: Tensor,  # [V, 4, 4]
    Ks: Tensor,  # [V, 3, 3]
    width: int,
    height: int,
    *,
    sh_degree: int | None = None,
    absgrad: bool = False,
    rasterize_mode: Literal["classic", "antialiased"] = "classic",
    max_off_axis: float = 0.0,
    near_plane: float = NEAR_PLANE,
) -> tuple[list[RenderedBand], Tensor, dict[str, Any]]:
    """Render the Gaussians of all processes into V pinhole cameras, of which each process composites its share.

    Every process must call this, and `backward` of something to which the anchor was added, in the same order. Raises
    InputError as `render.rasterization.rasterize`.

    Args:
        world: The processes, whose `sizes` are right.
        means, quats, scales, opacities, colors: The Gaussians of this process, as for `render.rasterization.rasterize`.
        viewmats, Ks, width, height: The same cameras in all processes; `viewmats` gets no gradient.
        sh_degree, absgrad, rasterize_mode, max_off_axis, near_plane: As for `render.rasterization.rasterize`,
            the same in all processes.

    Returns:
        The bands of this process; the anchor, a zero that must be added to the loss; and gsplat's `info` of this
        process's Gaussians in all views, whose `means2d` has `absgrad` and `grad2d` after `backward` where `absgrad`
        was asked for. In `info`, `num_pairs` and `num_pixels` are those of what this process composited.
    """
    projected = project(
        means, quats, scales, opacities, colors, viewmats, Ks, width, height,
        sh_degree=sh_degree, rasterize_mode=rasterize_mode, max_off_axis=max_off_axis, near_plane=near_plane,
    )  # fmt: skip
    exchange = Exchange(world, projected, share_out(len(viewmats), height, world.num_ranks))
    anchor, received = exchange.send(projected, absgrad)
    rendered, num_pairs, num_pixels = [], 0, 0
    for band, splats in zip(exchange.bands, received, strict=True):
        rows = band.bottom - band.top
        renders, alphas, info = composite(splats, width, rows, absgrad=absgrad)
        rendered.append(RenderedBand(band, renders, alphas))
        num_pairs, num_pixels = num_pairs + len(info["flatten_ids"]), num_pixels + rows * width
    radii, means2d, depths, conics, opacities, _ = projected
    info = {
        "radii": radii,
        "means2d": means2d,
        "depths": depths,
        "conics": conics,
        "opacities": opacities,
        "width": width,
        "height": height,
        "n_cameras": len(viewmats),
        "num_pairs": num_pairs,
        "num_pixels": num_pixels,
    }
    return rendered, anchor, info
