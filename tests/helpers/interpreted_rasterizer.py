"""Our rasterizer on a CPU: Triton's interpreter projects and makes the tile lists, and torch composites."""

from __future__ import annotations

import pytest
from torch import Tensor

from helpers.gsplat_stub import rasterize_to_pixels
from sadgs_ns.kernels import TILE_SIZE
from sadgs_ns.render import rasterization

compositing = pytest.importorskip("sadgs_ns.kernels.compositing", reason="Triton is not installed")
harmonics = pytest.importorskip("sadgs_ns.kernels.harmonics", reason="Triton is not installed")
projection = pytest.importorskip("sadgs_ns.kernels.projection", reason="Triton is not installed")
projection_forward = pytest.importorskip("sadgs_ns.kernels.projection_forward", reason="Triton is not installed")
tiles = pytest.importorskip("sadgs_ns.kernels.tiles", reason="Triton is not installed")


def composite(
    means2d: Tensor,
    conics: Tensor,
    colors: Tensor,
    opacities: Tensor,
    width: int,
    height: int,
    starts: Tensor,
    ids: Tensor,
    absgrad: bool,
) -> tuple[Tensor, Tensor]:
    """`compositing.rasterize_to_pixels` in torch."""
    splats = means2d, conics, colors, opacities, width, height
    return rasterize_to_pixels(*splats, TILE_SIZE, starts, ids, absgrad)


def use_our_rasterizer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have runs draw with it."""
    monkeypatch.setattr(rasterization, "use_triton", lambda place: True)
    monkeypatch.setattr(compositing, "rasterize_to_pixels", composite)
    lanes = [(tiles, "_LANES"), (harmonics, "_LANES")]
    lanes += [(projection, "_LANES"), (projection_forward, "_LANES")]
    for module, name in lanes:
        monkeypatch.setattr(module, name, 1024)  # The interpreter runs one program after the other.
    monkeypatch.setattr(tiles, "_ORDER_LANES", 8192)
    monkeypatch.setattr(tiles, "_PROGRAMS", 1)
