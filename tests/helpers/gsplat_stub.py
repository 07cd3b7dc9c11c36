"""gsplat's public functions in torch, for the gsplat backend where there is no GPU."""

from __future__ import annotations

from typing import Any

import gsplat
import pytest
import torch
from torch import Tensor

from sadgs_ns import gsplat_compat
from sadgs_ns.render import backend_torch, ewa


def stub_gsplat(monkeypatch: pytest.MonkeyPatch, per_axis_radii: bool) -> None:
    """Put torch functions in the place of gsplat's, with radii as gsplat 1.5 makes them, or as 1.4 does."""
    monkeypatch.setattr(gsplat_compat, "RADII_PER_AXIS", per_axis_radii)
    monkeypatch.setattr(backend_torch, "RADII_PER_AXIS", per_axis_radii)

    def fully_fused_projection(
        means: Tensor, covars: None, quats: Tensor, scales: Tensor, viewmats: Tensor, Ks: Tensor,
        width: int, height: int, *, near_plane: float, **bound: Tensor,
    ) -> tuple[Tensor | None, ...]:  # fmt: skip
        assert bound.keys() == ({"opacities"} if per_axis_radii else set())
        opacities = bound.get("opacities", means.new_ones(len(means)))
        radii, means2d, depths, conics = project(
            means, quats, scales, opacities, viewmats, Ks, width, height, near_plane
        )
        drawn = gsplat_compat.drawn(radii, means2d)[..., None]
        # The kernel does not write what it culls.
        conics = torch.where(drawn, conics, torch.nan)
        return radii, means2d, depths, conics, None

    def spherical_harmonics(degree: int, dirs: Tensor, coeffs: Tensor, masks: Tensor) -> Tensor:
        assert dirs.shape[:-1] == coeffs.shape[:-2] == masks.shape
        return torch.where(masks[..., None], ewa.spherical_harmonics(degree, dirs, coeffs), 0.0)

    def isect_tiles(
        means2d: Tensor, radii: Tensor, depths: Tensor, tile_size: int, tile_width: int, tile_height: int
    ) -> tuple[Tensor, Any, Tensor]:
        assert tile_size == backend_torch.TILE_SIZE
        assert radii.dtype == torch.int32
        extents = (radii if per_axis_radii else radii[..., None].expand_as(means2d)).to(means2d.dtype)
        tiles = backend_torch._bin_into_tiles(
            means2d, depths, extents, tile_width * tile_size, tile_height * tile_size
        )  # fmt: skip
        counts = torch.bincount(tiles.flatten_ids, minlength=depths.numel()).view_as(depths)
        return counts.int(), tiles, tiles.flatten_ids.int()

    def isect_offset_encode(keys: Any, num_views: int, tile_width: int, tile_height: int) -> Tensor:
        return keys.offsets.int().view(num_views, tile_height, tile_width)

    stubs = (fully_fused_projection, spherical_harmonics, isect_tiles, isect_offset_encode, rasterize_to_pixels)
    for function in stubs:
        monkeypatch.setattr(gsplat, function.__name__, function)


def project(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, viewmats: Tensor, Ks: Tensor,
    width: int, height: int, near_plane: float = 0.01,
) -> tuple[Tensor, ...]:  # fmt: skip
    """`gsplat_compat.project`, with radii as the torch backend has them."""
    means2d, depths, conics, covars2d, valid = backend_torch._project(
        means, quats, scales, viewmats, Ks, width, height, near_plane
    )
    radii = backend_torch._radii(means2d, covars2d, opacities.expand(depths.shape), valid, width, height)
    return radii, means2d, depths, conics


def rasterize_to_pixels(
    means2d: Tensor,  # [C, N, 2]
    conics: Tensor,  # [C, N, 3]
    colors: Tensor,  # [C, N, D]
    opacities: Tensor,  # [C, N]
    width: int,
    height: int,
    tile_size: int,
    starts: Tensor,  # [C, tile rows, tile columns]; rows below the image are passed over
    ids: Tensor,  # [number of pairs]
    absgrad: bool,
) -> tuple[Tensor, Tensor]:
    """gsplat's: a list ends where the next begins, and the last at the end."""
    views = len(starts)
    size = tile_size
    rows = -(-height // size)
    columns = -(-width // size)
    ends = torch.cat([starts.flatten()[1:], torch.tensor([len(ids)])]).view_as(starts)
    starts = starts[:, :rows].flatten().long()
    ends = ends[:, :rows].flatten().long()
    row, column = torch.meshgrid(torch.arange(rows), torch.arange(columns), indexing="ij")
    origins = (torch.stack([column, row], dim=-1) * size).reshape(-1, 2).repeat(views, 1)
    tiles = backend_torch._Tiles(size, origins, starts, ends - starts, ids.long())
    canvas: Any = backend_torch._Composite.apply(means2d, conics, colors, opacities, tiles, absgrad)
    canvas = canvas.reshape(views, rows, columns, size, size, -1).transpose(2, 3)
    canvas = canvas.reshape(views, rows * size, columns * size, -1)[:, :height, :width]
    return canvas[..., :-1], canvas[..., -1:]
