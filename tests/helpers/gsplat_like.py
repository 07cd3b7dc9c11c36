"""This package's backends with the arguments of `gsplat.rasterization`."""

from __future__ import annotations

from typing import Any
from unittest.mock import patch

from torch import Tensor

from sadgs_ns.render import backend_torch
from sadgs_ns.render.rasterization import rasterize
from sadgs_ns.render.types import Cameras, Gaussians, RenderOptions


def rasterization(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor | tuple[Tensor, Tensor],
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    *,
    packed: bool = False,
    render_mode: str = "RGB",
    tile_size: int = 16,
    rasterize_mode: str = "classic",
    per_axis_radii: bool | None = None,
    **options: Any,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Draw what gsplat draws with these arguments, and `options` of `RenderOptions`.

    The torch backend has tiles of `tile_size` px, and radii as gsplat 1.5 has them, as 1.4, or as the installed one.
    """
    assert not packed
    assert render_mode in ("RGB", "RGB+ED")
    assert rasterize_mode == "classic"
    gaussians = Gaussians(means, quats, scales, opacities, colors)
    layout = backend_torch.RADII_PER_AXIS if per_axis_radii is None else per_axis_radii
    with patch.object(backend_torch, "RADII_PER_AXIS", layout), patch.object(backend_torch, "TILE_SIZE", tile_size):
        wanted = RenderOptions(expected_depth=render_mode == "RGB+ED", **options)
        return rasterize(gaussians, Cameras(viewmats, Ks, width, height), wanted)


def splatted(*args: Any, **options: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Do what `rasterization` does with the torch backend."""
    return rasterization(*args, backend="torch", **options)
