"""Several processes draw and differentiate what one does."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from helpers.closeness import assert_within, assert_within_share
from helpers.gloo_ranks import run_ranks
from helpers.sharded_rendering import GAUSSIANS, HEIGHT, color_maps, inputs, splats, weights
from sadgs_ns.distributed.bands import ROWS, share_rows, views_of_rank
from sadgs_ns.distributed.rasterization import rasterize
from sadgs_ns.distributed.world import World
from sadgs_ns.render.rasterization import rasterize as rasterize_alone
from sadgs_ns.render.rasterization import visible
from sadgs_ns.render.types import RenderOptions


def draw_together(world: World, views: int, uneven: bool, fused: bool) -> dict[str, Any]:
    if fused:
        from helpers.interpreted_rasterizer import use_our_rasterizer

        use_our_rasterizer(pytest.MonkeyPatch())
    part = world.take_even_part(GAUSSIANS)
    if uneven:  # The last process has nothing that anybody sees.
        world.sizes = [GAUSSIANS - 3 * (world.num_ranks - 1), *[3] * (world.num_ranks - 1)]
        start = sum(world.sizes[: world.rank])
        part = slice(start, start + world.sizes[world.rank])
    leaves = inputs(part)
    options = RenderOptions(sh_degree=1, absgrad=True, max_off_axis=1.5)
    world.flags_out = 1 << world.rank
    rendered, info = rasterize(world, *splats(leaves, views), options, color_maps(views))
    loss = info["anchor"]
    images = []
    for band, colors, alphas in rendered:
        assert band is not None
        rows = slice(band.first - band.top, band.last - band.top)
        image = torch.cat([colors, alphas], dim=-1)[0, rows]
        loss = loss + (image * weights(views)[band.view, band.first : band.last]).sum()
        images.append((band, image.detach()))
    loss.backward()
    return {
        "images": images,
        "loss": loss.detach(),
        "gradients": {name: leaf.grad for name, leaf in leaves.items()},
        "absgrad": info["means2d"].absgrad,
        "grad2d": info["means2d"].grad2d,
        "visible": visible(info),
        "flags": world.flags_in,
    }


@pytest.mark.parametrize(
    ("ranks", "views", "uneven", "fused"),
    [(2, 2, False, False), (3, 4, False, False), (3, 1, True, False), (2, 3, False, True)],
)
def test_processes_draw_and_differentiate_what_one_does(
    ranks: int, views: int, uneven: bool, fused: bool, tmp_path: Path
):
    """With `fused`, the processes draw with our kernels in Triton's interpreter."""
    if fused:
        if torch.cuda.is_available():
            pytest.skip("Triton is interpreted where there is no GPU")
        pytest.importorskip("helpers.interpreted_rasterizer", reason="Triton is not installed", exc_type=ImportError)
    leaves = inputs()
    options = RenderOptions(sh_degree=1, absgrad=True, max_off_axis=1.5)
    colors, alphas, info = rasterize_alone(*splats(leaves, views), options, color_maps=color_maps(views))
    info["means2d"].retain_grad()
    expected = torch.cat([colors, alphas], dim=-1)
    loss = (expected * weights(views)).sum()
    loss.backward()
    assert not visible(info).all(), "some Gaussians should be out of sight"

    results = run_ranks(draw_together, ranks, tmp_path, views, uneven, fused)

    covered = torch.zeros(views, HEIGHT)
    for result in results:
        for band, image in result["images"]:
            covered[band.view, band.first : band.last] += 1
            assert_within(image, expected[band.view, band.first : band.last], 1e-5)
        assert result["flags"] == (1 << ranks) - 1
    assert (covered == 1).all()
    actual = sum(result["loss"] for result in results)
    assert_within_share(actual, loss.detach(), 1e-5)

    def together(name: str, dim: int) -> Tensor:
        return torch.cat([result[name] for result in results], dim=dim)

    seen = visible(info)
    assert torch.equal(together("visible", 1), seen)
    assert info["means2d"].grad is not None
    for name, tensor in (("grad2d", info["means2d"].grad), ("absgrad", info["means2d"].absgrad)):
        scale = float(tensor[seen].abs().max())
        actual = together(name, 1)[seen]
        assert_close(actual, tensor[seen], atol=1e-5 * scale, rtol=1e-4)
    for name, leaf in leaves.items():
        assert leaf.grad is not None
        gradient = torch.cat([result["gradients"][name] for result in results])
        assert_close(gradient, leaf.grad, atol=1e-5 * float(leaf.grad.abs().max()), rtol=1e-4)


@pytest.mark.parametrize(("views", "height", "ranks"), [(4, 100, 2), (1, 33, 3), (3, 75, 2), (2, 10, 3), (5, 64, 3)])
def test_bands_cover_every_row_once_and_evenly(views: int, height: int, ranks: int):
    bands = share_rows(views, height, ranks)
    actual = [(b.view, b.first) for b in bands]
    expected = sorted((b.view, b.first) for b in bands)
    assert actual == expected
    assert [b.rank for b in bands] == sorted(b.rank for b in bands)
    rows = [(b.view, row) for b in bands for row in range(b.first, b.last)]
    assert rows == [(view, row) for view in range(views) for row in range(height)]
    if views % ranks == 0:
        for b in bands:
            assert (b.first, b.last, b.top, b.bottom) == (0, height, 0, height)
    shares = [0] * ranks
    for band in bands:
        shares[band.rank] += band.last - band.first
    assert max(shares) - min(shares) <= max(2 * ROWS, height if height < ROWS else 0)


def test_views_of_several_sizes_are_shared_out_size_by_size():
    sizes = (48, 64), (30, 40), (48, 64), (48, 64), (30, 40)
    actual = [views_of_rank(sizes, 3, rank) for rank in range(3)]
    expected = [(0,), (2, 1), (3, 4)]
    assert actual == expected
    assert [views_of_rank(sizes[:2], 2, rank) for rank in range(2)] == [(0,), (0, 1)]  # 30 rows are not cut.
