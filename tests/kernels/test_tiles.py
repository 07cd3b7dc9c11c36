"""The kernels of tile lists against the ellipses' formula, view by view, and torch's sort."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from sadgs_ns.render.off_axis import cull_off_axis

triton = pytest.importorskip("triton", reason="Triton is not installed")
tiles = pytest.importorskip("sadgs_ns.kernels.tiles", reason="Triton is not installed")

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")


def projected_gaussians(num_views: int, n: int, width: int, height: int) -> dict[str, Tensor]:
    """Projected Gaussians of all sizes, of which some are long and thin, faint, culled or off the image."""
    generator = torch.Generator().manual_seed(0)

    def random(*shape: int) -> Tensor:
        return torch.rand((num_views, n, *shape), generator=generator)

    factors = torch.randn((num_views, n, 2, 2), generator=generator) * torch.exp(4 * random(1, 1) - 1)
    factors[:, ::4, :, 1] *= 1e-3
    covariances = factors @ factors.mT + 0.3 * torch.eye(2)
    inverses = torch.linalg.inv(covariances.double()).float()
    opacities = random()
    opacities[:, ::7] = 0.003
    radii = torch.ceil(3 * torch.linalg.eigvalsh(covariances)[..., -1].sqrt()).int()
    radii[:, ::11] = 0
    conics = torch.stack([inverses[..., 0, 0], inverses[..., 0, 1], inverses[..., 1, 1]], dim=-1)
    conics[:, ::11] = torch.nan  # what gsplat leaves unwritten
    return {
        "means2d": random(2) * torch.tensor([width, height]) * 1.4 - torch.tensor([width, height]) * 0.2,
        "radii": radii,
        "depths": random(),
        "conics": conics,
        "opacities": opacities,
    }


@pytest.mark.parametrize(("tile_size", "radius_per_axis"), [(8, False), (16, True)])
def test_tiles_list_the_gaussians_that_reach_them_and_hardly_more(tile_size, radius_per_axis):
    width = 75
    height = 50
    n = 120
    gaussians = projected_gaussians(2, n, width, height)
    radii = gaussians["radii"][..., None].expand(-1, -1, 2).float()  # [C, N, 2]
    if radius_per_axis:  # as gsplat 1.5
        gaussians["radii"] = gaussians["radii"][..., None] * torch.tensor([1, 2], dtype=torch.int32)
        radii = gaussians["radii"].float()
    on_device = {name: value.to(DEVICE) for name, value in gaussians.items()}
    starts, ids, _ = tiles.intersect_tiles(**on_device, width=width, height=height, tile_size=tile_size).lists()
    rows = math.ceil(height / tile_size)
    columns = math.ceil(width / tile_size)
    assert starts.shape == (2, rows, columns)
    lists = ids.cpu().tensor_split(starts.cpu().flatten().tolist()[1:])
    n_listed = n_needed = n_square = 0
    for number, listed in enumerate(lists):
        view = number // (rows * columns)
        row = number // columns % rows
        column = number % columns
        depths = gaussians["depths"].flatten()[listed.long()]
        assert (depths.diff() >= 0).all()
        y, x = torch.meshgrid(torch.arange(tile_size) + 0.5, torch.arange(tile_size) + 0.5, indexing="ij")
        pixels = torch.stack([x + column * tile_size, y + row * tile_size], dim=-1).reshape(1, -1, 2)
        delta = (gaussians["means2d"][view, :, None] - pixels).double()  # [N, pixels, 2]
        a, b, c = gaussians["conics"][view].double()[..., None].unbind(dim=1)
        sigma = (a * delta[..., 0] ** 2 + c * delta[..., 1] ** 2) / 2 + b * delta[..., 0] * delta[..., 1]
        reaches = (gaussians["opacities"][view, :, None] * torch.exp(-sigma) >= 1 / 255).any(dim=1)
        low = ((gaussians["means2d"][view] - radii[view]) / tile_size).floor()
        high = ((gaussians["means2d"][view] + radii[view]) / tile_size).ceil()
        here = torch.tensor([column, row])
        in_square = (radii[view] > 0).all(dim=1) & (low <= here).all(dim=1) & (high > here).all(dim=1)
        needed = set((view * n + (reaches & in_square).nonzero().flatten()).tolist())
        assert len(listed) == len(set(listed.tolist()))
        assert needed <= set(listed.tolist()) <= set((view * n + in_square.nonzero().flatten()).tolist())
        n_listed = n_listed + len(listed)
        n_needed = n_needed + len(needed)
        n_square = n_square + int(in_square.sum())
    assert n_needed > 500
    assert n_listed < 1.02 * n_needed < 0.7 * n_square


def test_more_tiles_than_16_bits_number_are_listed_as_view_by_view():
    n = 40
    width = 1480  # 23,125 tiles a view, 69,375 in three
    height = 1000
    gaussians = {name: value.to(DEVICE) for name, value in projected_gaussians(3, n, width, height).items()}
    starts, ids, _ = tiles.intersect_tiles(**gaussians, width=width, height=height, tile_size=8).lists()
    assert starts.shape == (3, 125, 185)
    assert starts.numel() > 2**16
    parts = []
    for view in range(3):
        alone = {name: value[view : view + 1] for name, value in gaussians.items()}
        start, listed, _ = tiles.intersect_tiles(**alone, width=width, height=height, tile_size=8).lists()
        parts.append((start[0] + sum(len(ids) for _, ids in parts), listed + view * n))
    assert torch.equal(starts, torch.stack([start for start, _ in parts]))
    assert torch.equal(ids, torch.cat([listed for _, listed in parts]))
    assert len(ids) > 500


def test_a_gaussian_that_is_listed_in_parts_is_listed_as_by_one_lane(monkeypatch):
    """Also where a Gaussian has more parts than rows, whose last rows are few, and where programs share many parts."""
    gaussians = {name: value.to(DEVICE) for name, value in projected_gaussians(2, 60, 320, 240).items()}
    gaussians["radii"][:, 1] = 2000  # It covers all tiles.
    gaussians["conics"][:, 1] = torch.tensor([1e-6, 0.0, 1e-6])
    found = []
    for few, part, programs in ((10**9, 256, 8), (64, 256, 8), (0, 256, 8), (0, 16, 1)):
        monkeypatch.setattr(tiles, "_FEW_PAIRS", few)
        monkeypatch.setattr(tiles, "_PART_PAIRS", part)
        monkeypatch.setattr(tiles, "_PROGRAMS", programs)
        found.append(tiles.intersect_tiles(**gaussians, width=320, height=240, tile_size=8).lists())
    for lists in found[1:]:
        for one, other in zip(found[0], lists, strict=True):
            assert torch.equal(one, other)
    for g in (1, 61):
        assert (found[0][1] == g).sum() == 40 * 30
    assert len(found[0][1]) > 2 * 40 * 30 + 500


def listed_by_tile(lists: tuple[Tensor, ...], rows: int) -> list[list[int]]:
    """What gsplat's forward pass reads for each tile of the image, view by view."""
    starts, ids = (values.cpu() for values in lists[:2])
    places = starts.flatten().tolist()
    by_tile = [ids[begin:end].tolist() for begin, end in zip(places, [*places[1:], len(ids)], strict=True)]
    tiles_per_view = starts[0].numel()
    columns = starts.shape[2]
    return [listed for number, listed in enumerate(by_tile) if number % tiles_per_view < rows * columns]


@pytest.fixture
def few_programs(monkeypatch):
    """Each program handles more Gaussians than on a GPU, since the interpreter runs one program after the other."""
    if DEVICE.type == "cpu":
        monkeypatch.setattr(tiles, "_LANES", 128)


@pytest.mark.parametrize("per_axis_radii", [False, True], ids=["gsplat 1.4", "gsplat 1.5"])
@pytest.mark.parametrize(("num_views", "width", "height"), [(1, 75, 50), (3, 75, 50), (2, 64, 48)])
def test_lists_longer_than_needed_equal_the_exact_ones_tile_by_tile(
    few_programs, num_views, width, height, per_axis_radii
):
    """The last height is a multiple of a tile's: padding must not reach the image's last row of tiles there."""
    gaussians = projected_gaussians(num_views, 120, width, height)
    if per_axis_radii:
        gaussians["radii"] = gaussians["radii"][..., None].repeat(1, 1, 2)
    on_device = {name: value.to(DEVICE, copy=True) for name, value in gaussians.items()}
    pending = tiles.intersect_tiles(**on_device, width=width, height=height, tile_size=8)
    rows = math.ceil(height / 8)
    columns = math.ceil(width / 8)
    exact = pending.lists()
    num_pairs = len(exact[1])
    counts = pending.pair_counts
    views = exact[1].cpu() // 120  # Each view has 120 Gaussians.
    assert counts.wait() == torch.bincount(views, minlength=num_views).tolist()
    assert counts.ready()
    assert sum(counts.wait()) == num_pairs > 500
    for capacity in (num_pairs, num_pairs + 1, 2 * num_pairs):
        starts, ids, overflowed = pending.lists(capacity)
        assert overflowed.tolist() == [0]
        assert starts.shape == (num_views, rows + 1, columns)
        assert len(ids) == capacity
        assert starts.dtype == ids.dtype == torch.int32
        assert listed_by_tile((starts, ids), rows) == listed_by_tile(exact, rows)
        assert starts.flatten()[-1] == num_pairs, "padding is valid and at the end"
        assert (ids[num_pairs:] == 0).all(), "padding is valid and at the end"
    assert torch.equal(on_device["radii"].cpu(), gaussians["radii"])


@pytest.mark.parametrize("per_axis_radii", [False, True], ids=["gsplat 1.4", "gsplat 1.5"])
@pytest.mark.parametrize("missing", [1, 400])
def test_lists_shorter_than_needed_are_empty_and_nothing_counts_as_drawn(few_programs, per_axis_radii, missing):
    gaussians = projected_gaussians(2, 120, 75, 50)
    if per_axis_radii:
        gaussians["radii"] = gaussians["radii"][..., None].repeat(1, 1, 2)
    on_device = {name: value.to(DEVICE) for name, value in gaussians.items()}
    pending = tiles.intersect_tiles(**on_device, width=75, height=50, tile_size=8)
    needed = sum(pending.pair_counts.wait())
    lists = pending.lists(needed - missing)
    assert len(lists[1]) == needed - missing
    assert (lists[1] == 0).all()
    assert lists.overflowed.tolist() == [1]
    assert not any(listed_by_tile(lists, rows=7))
    assert (on_device["radii"] == 0).all()
    assert sum(pending.pair_counts.wait()) == needed


def test_a_row_of_tiles_below_the_image_may_need_numbers_of_32_bits(few_programs):
    """The image's 65,536 tiles have numbers of 16 bits; with the row below it they have not."""
    gaussians = {name: value.to(DEVICE) for name, value in projected_gaussians(1, 40, 2048, 2048).items()}
    pending = tiles.intersect_tiles(**gaussians, width=2048, height=2048, tile_size=8)
    exact = pending.lists()
    actual = listed_by_tile(pending.lists(len(exact[1]) + 50), 256)
    assert actual == listed_by_tile(exact, 256)


def test_no_gaussian_in_sight_makes_empty_lists():
    gaussians = projected_gaussians(1, 5, 32, 32)
    gaussians["radii"] = torch.zeros_like(gaussians["radii"])
    on_device = {name: value.to(DEVICE) for name, value in gaussians.items()}
    starts, ids, _ = tiles.intersect_tiles(**on_device, width=32, height=32, tile_size=16).lists()
    assert len(ids) == 0
    assert (starts == 0).all()


@pytest.mark.parametrize("per_axis_radii", [False, True], ids=["gsplat 1.4", "gsplat 1.5"])
def test_far_off_the_axis_radii_are_zero_as_torch_makes_them(few_programs, per_axis_radii):
    """The lists are those of the radii that torch culls."""
    gaussians = projected_gaussians(2, 150, 40, 30)
    if per_axis_radii:
        gaussians["radii"] = gaussians["radii"][..., None] * torch.tensor([1, 2], dtype=torch.int32)
    gaussians["means2d"][0, :4] = torch.tensor([[math.nan, 1.0], [1.0, math.inf], [-15.0, 15.0], [20.0, 36.5]])
    expected = cull_off_axis(gaussians["radii"], gaussians["means2d"], 40, 30, 0.8)
    assert 60 < (expected > 0).sum() < (gaussians["radii"] > 0).sum() - 60
    lists = []
    for radii, max_off_axis in ((expected, 0.0), (gaussians["radii"], 0.8)):
        on_device = {name: value.to(DEVICE, copy=True) for name, value in (gaussians | {"radii": radii}).items()}
        pending = tiles.intersect_tiles(**on_device, width=40, height=30, tile_size=8, max_off_axis=max_off_axis)
        lists.append(pending.lists())
        assert torch.equal(on_device["radii"].cpu(), expected)
    assert all(map(torch.equal, *lists))
    assert len(lists[0][1]) > 100


@pytest.mark.parametrize("dtype", [torch.int16, torch.int32])
@pytest.mark.parametrize(("num_pairs", "num_tiles"), [(0, 5), (1, 1), (700, 40), (1000, 1500), (513, 512)])
def test_the_lists_order_and_starts_are_torchs(dtype, num_pairs, num_tiles):
    """Most tiles have no pair in the longest case, and neither number is a multiple of what a program handles."""
    generator = torch.Generator().manual_seed(0)
    numbers = torch.randint(0, num_tiles, (num_pairs,), generator=generator) - 2**15
    sorted_tiles, by_tile = numbers.to(dtype).to(DEVICE).sort(stable=True)
    ids = torch.randperm(num_pairs, generator=generator).int().to(DEVICE)
    ordered = torch.empty_like(ids)
    starts = ids.new_empty(num_tiles)
    lanes = tiles._ORDER_LANES
    of_pairs = triton.cdiv(num_pairs, lanes)
    tiles._order[of_pairs + triton.cdiv(num_tiles, lanes),](
        sorted_tiles, by_tile, ids, ordered, starts, num_pairs, num_tiles, of_pairs, num_pairs.bit_length(), lanes
    )
    every = torch.arange(num_tiles, device=DEVICE) - 2**15
    assert torch.equal(starts, torch.searchsorted(sorted_tiles.long(), every, out_int32=True))
    assert torch.equal(ordered, ids[by_tile])
