"""Our rasterizer on a CPU: Triton's interpreter makes the tile lists, and torch does what gsplat does in CUDA."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from gsplat.cuda._torch_impl import _fully_fused_projection
from torch import Tensor

from sadgs_ns import gsplat_compat
from sadgs_ns.kernels import TILE_SIZE
from sadgs_ns.render import backend_torch, rasterization

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
    calc_compensations: bool,
    near_plane: float = 0.01,
) -> tuple[Tensor, ...]:
    """`gsplat_compat.project` in torch."""
    covariances = gsplat_compat.torch_quat_scale_to_covar_preci(quats, scales, True, False)[0]
    return _fully_fused_projection(
        means,
        covariances,  # type: ignore[arg-type]
        viewmats,
        Ks,
        width,
        height,
        calc_compensations=calc_compensations,
        near_plane=near_plane,
    )


def composite(
    means2d: Tensor,  # [C, N, 2]
    conics: Tensor,  # [C, N, 3]
    colors: Tensor,  # [C, N, 3]
    opacities: Tensor,  # [C, N]
    width: int,
    height: int,
    starts: Tensor,  # [C, tile rows, tile columns]
    ids: Tensor,  # [number of pairs]
    absgrad: bool,
) -> tuple[Tensor, Tensor]:
    """`compositing.rasterize_to_pixels` in torch: a list ends where the next begins, and the last at the end."""
    views, size = len(starts), TILE_SIZE
    rows, columns = -(-height // size), -(-width // size)
    ends = torch.cat([starts.flatten()[1:], torch.tensor([len(ids)])]).view_as(starts)
    starts, ends = (places[:, :rows].flatten().long() for places in (starts, ends))
    row, column = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    origins = (torch.stack([column, row], dim=-1) * size).reshape(-1, 2).repeat(views, 1)
    tiles = backend_torch._Tiles(size, origins, starts, ends - starts, ids.long())
    canvas: Any = backend_torch._Composite.apply(means2d, conics, colors, opacities, tiles, absgrad)
    image = canvas.reshape(views, rows, columns, size, size, 4).transpose(2, 3).reshape(views, rows * size, -1, 4)
    return image[:, :height, :width, :3], image[:, :height, :width, 3:]


def use_our_rasterizer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have runs draw with it."""
    monkeypatch.setattr(rasterization, "use_triton", lambda place: True)
    monkeypatch.setattr(gsplat_compat, "project", project)
    monkeypatch.setattr(compositing, "rasterize_to_pixels", composite)
    lanes = [(tiles, "_LANES"), (harmonics, "_LANES"), (harmonics, "_BACKWARD_LANES"), (projection, "_LANES")]
    for module, name in lanes:
        monkeypatch.setattr(module, name, 1024)  # The interpreter runs one program after the other.
