"""Our rasterizer on a CPU: Triton's interpreter makes the tile lists, and torch does what gsplat does in CUDA."""

from __future__ import annotations

import pytest
from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci
from gsplat_stub import rasterize_to_pixels
from torch import Tensor

from sadgs_ns import gsplat_compat
from sadgs_ns.kernels import TILE_SIZE
from sadgs_ns.render import rasterization

compositing = pytest.importorskip("sadgs_ns.kernels.compositing", reason="Triton is not installed")
harmonics = pytest.importorskip("sadgs_ns.kernels.harmonics", reason="Triton is not installed")
projection = pytest.importorskip("sadgs_ns.kernels.projection", reason="Triton is not installed")
tiles = pytest.importorskip("sadgs_ns.kernels.tiles", reason="Triton is not installed")


def project(
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    scales: Tensor,  # [N, 3]
    opacities: Tensor,  # [N]
    viewmats: Tensor,  # [C, 4, 4]
    Ks: Tensor,  # [C, 3, 3]
    width: int,
    height: int,
    near_plane: float = 0.01,
) -> tuple[Tensor, ...]:
    """`gsplat_compat.project` in torch."""
    covariances = _quat_scale_to_covar_preci(quats, scales, True, False)[0]
    assert covariances is not None
    return _fully_fused_projection(means, covariances, viewmats, Ks, width, height, near_plane=near_plane)[:4]


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
    monkeypatch.setattr(gsplat_compat, "project", project)
    monkeypatch.setattr(compositing, "rasterize_to_pixels", composite)
    lanes = [(tiles, "_LANES"), (harmonics, "_LANES"), (harmonics, "_BACKWARD_LANES"), (projection, "_LANES")]
    for module, name in lanes:
        monkeypatch.setattr(module, name, 1024)  # The interpreter runs one program after the other.
