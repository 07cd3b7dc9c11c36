"""Depth maps by plane-sweep stereo: of drawn planes, whose depth is known."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from helpers.generators import seeded
from sadgs_ns.geometry import stereo
from sadgs_ns.geometry.stereo import DepthMap, depth_maps
from sadgs_ns.geometry.stereo_neighbours import choose_neighbours

WIDTH = 160
HEIGHT = 120
PLANES = {  # Normals n and offsets d of planes n · X = d. The nearest plane is seen.
    "frontal": [([0.0, 0.0, 1.0], 10.0)],
    "slanted": [([0.5, 0.2, 1.0], 10.0)],
    "ridge": [([0.5, 0.1, 1.0], 10.0), ([-0.6, 0.0, 1.0], 10.0)],
}
Capture = tuple[list[Tensor], Tensor, Tensor, Tensor]


def trace(planes: str, viewmat: Tensor, K: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
    """Points [h, w, 3] that a camera sees, and their depths [h, w]."""
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    rays = torch.stack([x, y, torch.ones_like(x)], dim=2).double() @ K.double().inverse().T @ viewmat[:3, :3]
    centre = viewmat.inverse()[:3, 3]
    normals = [(torch.tensor(normal).double(), offset) for normal, offset in PLANES[planes]]
    depth = torch.stack([(offset - centre @ normal) / (rays @ normal) for normal, offset in normals]).amin(dim=0)
    return centre + depth[..., None] * rays, depth


def texture(points: Tensor) -> Tensor:
    """Grey values in [0, 1] of points in space: sines of 8 to 60 px. [..., 3] → [...]"""
    directions = torch.randn((24, 3), generator=seeded(0)).double()
    waves = directions / directions.norm(dim=1, keepdim=True) * torch.logspace(0.2, 1.1, 24).double()[:, None]
    return (0.5 + 0.06 * torch.sin(points @ waves.T + torch.arange(24)).sum(dim=-1)).clamp(0, 1)


def capture(planes: str = "slanted", count: int = 5, sizes: list[tuple[int, int]] | None = None) -> Capture:
    """Images of a row of cameras that turn a little, their viewmats and Ks, and points on the planes."""
    viewmats = []
    Ks = []
    images = []
    points = []
    for v, (width, height) in enumerate(sizes or [(WIDTH, HEIGHT)] * count):
        offset = v - (count - 1) / 2
        cosine = math.cos(0.02 * offset)
        sine = math.sin(0.02 * offset)
        rotation = torch.tensor([[cosine, 0, sine], [0, 1, 0], [-sine, 0, cosine]]).double()
        viewmat = torch.eye(4).double()
        viewmat[:3, :3] = rotation
        viewmat[:3, 3] = -rotation @ torch.tensor([offset, 0.2 * (v % 2), 0]).double()
        K = torch.tensor([[150, 0, 0.48 * width], [0, 140, 0.53 * height], [0, 0, 1]]).double()
        seen, _ = trace(planes, viewmat, K, height, width)
        images.append(texture(seen).float()[..., None].expand(-1, -1, 3))
        points.append(seen[::8, ::8].flatten(0, 1))
        viewmats.append(viewmat)
        Ks.append(K)
    return images, torch.stack(viewmats), torch.stack(Ks), torch.cat(points)


def check(maps: list[DepthMap], planes: str, viewmats: Tensor, share: float = 0.7) -> None:
    """Depths are right, and a share of the pixels of all maps is confident. 1 px of disparity is 1.7 % or more."""
    confident = []
    for depth_map, viewmat in zip(maps, viewmats, strict=True):
        _, depth = trace(planes, viewmat, depth_map.K, *depth_map.depth.shape)
        known = depth_map.confidence > 0
        errors = (depth_map.depth / depth - 1)[known]
        assert (errors.abs() < 0.01).double().mean() > 0.95
        assert errors.abs().median() < 0.002
        assert errors.median().abs() < 0.0006
        assert torch.equal(known, depth_map.depth > 0)
        assert 0.9 < depth_map.confidence.max() <= 1
        confident.append(known.double().mean())
    assert torch.stack(confident).mean() > share


@pytest.mark.parametrize("planes", PLANES)
def test_depths_of_planes_are_found(planes: str):
    images, viewmats, Ks, points = capture(planes)
    maps = depth_maps(images.__getitem__, viewmats, Ks, points, device="cpu")
    check(maps, planes, viewmats, 0.8)
    for depth_map, K in zip(maps, Ks, strict=True):
        assert depth_map.depth.shape == depth_map.confidence.shape == (HEIGHT, WIDTH)
        assert_close(depth_map.K, K.float())


@pytest.mark.parametrize("planes", PLANES)
def test_reduced_images_have_their_depths_at_the_right_pixels(planes: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(stereo, "WORKING_SIDE", 100)
    images, viewmats, Ks, points = capture(planes)
    maps = depth_maps(lambda v: (255 * images[v]).round().byte(), viewmats, Ks, points, device="cpu")
    assert maps[0].depth.shape == (76, 100)
    check(maps, planes, viewmats)


def test_views_may_differ_in_size_and_be_loaded_one_by_one():
    sizes = [(WIDTH, HEIGHT) if v % 2 else (HEIGHT, WIDTH) for v in range(5)]
    images, viewmats, Ks, points = capture(sizes=sizes)
    maps = depth_maps(images.__getitem__, viewmats, Ks, points, device="cpu")
    actual = [tuple(depth_map.depth.shape[::-1]) for depth_map in maps]
    assert actual == sizes
    check(maps, "slanted", viewmats)


def test_far_from_the_origin_depths_are_as_good():
    images, viewmats, Ks, points = capture()
    shift = torch.tensor([1e5, -2e5, 1e5]).double()
    moved = viewmats.clone()
    moved[:, :3, 3] -= viewmats[:, :3, :3] @ shift
    check(depth_maps(images.__getitem__, moved, Ks, points + shift, device="cpu"), "slanted", viewmats, 0.8)


def test_masked_pixels_have_no_depth_and_are_no_evidence():
    images, viewmats, Ks, points = capture()
    mask = torch.ones((HEIGHT, WIDTH), dtype=torch.bool)
    mask[30:70, 50:100] = False
    # The same picture stands at the same place of all views, as a watermark does.
    marked = [torch.where(mask[..., None], image, images[0]) for image in images]
    maps = depth_maps(marked.__getitem__, viewmats, Ks, points, masks=[mask] * 5, device="cpu")
    check(maps, "slanted", viewmats, 0.6)
    for depth_map in maps:
        assert not (depth_map.confidence[~mask].any() or depth_map.depth[~mask].any())
    broken = [torch.where(mask[..., None], image, torch.nan) for image in images]
    transparent = [torch.cat([image, mask[..., None]], dim=2) for image in images]
    for same in (
        depth_maps(broken.__getitem__, viewmats, Ks, points, masks=[mask] * 5, device="cpu"),
        depth_maps(transparent.__getitem__, viewmats, Ks, points, device="cpu"),
    ):
        for a, b in zip(maps, same, strict=True):
            assert torch.equal(a.depth, b.depth)


def test_repeated_calls_give_the_same():
    images, *cameras = capture("ridge", 2)
    first, second = (depth_maps(images.__getitem__, *cameras, device="cpu") for _ in range(2))
    for a, b in zip(first, second, strict=True):
        assert torch.equal(a.depth, b.depth)
        assert torch.equal(a.confidence, b.confidence)
        assert (a.confidence > 0).double().mean() > 0.3


def test_nothing_is_known_without_texture_neighbours_or_points():
    images, viewmats, Ks, points = capture()
    for empty in (
        depth_maps(lambda v: torch.full_like(images[v], 0.7), viewmats, Ks, points, device="cpu"),
        depth_maps(images.__getitem__, viewmats[:1], Ks[:1], points, device="cpu"),
        depth_maps(images.__getitem__, viewmats, Ks, points[:0], device="cpu"),
    ):
        for depth_map in empty:
            assert depth_map.depth.shape == depth_map.confidence.shape == (HEIGHT, WIDTH)
            assert not depth_map.depth.any()
            assert not depth_map.confidence.any()


def test_neighbours_see_the_same_points_from_good_angles():
    y, x = torch.meshgrid(torch.linspace(-20, 20, 40), torch.linspace(-30, 30, 60), indexing="ij")
    points = torch.stack([x, y, torch.full_like(x, 10)], dim=2).flatten(0, 1)[::2].double()
    Ks = capture(count=1)[2].expand(9, 3, 3)
    sizes = torch.tensor([[WIDTH, HEIGHT]]).expand(9, 2)
    viewmats = torch.eye(4).double().repeat(9, 1, 1)
    for spacing, expected in ((1.2, [2, 3, 5, 6]), (0.3, [0, 1, 7, 8])):
        viewmats[:, 0, 3] = -spacing * torch.arange(9)
        chosen = choose_neighbours(viewmats, Ks, sizes, points)
        assert chosen[4].sort().values.tolist() == expected
        assert chosen[4, :2].sum() == 8, "the first two should lie on either side"
    viewmats[8, :3, :3] = torch.diag(torch.tensor([-1.0, 1.0, -1.0]))  # It looks away.
    chosen = choose_neighbours(viewmats, Ks, sizes, points, 10)
    assert (chosen[8] == -1).all()
    assert not (chosen == 8).any()
    assert (chosen[:, 7:] == -1).all()


@pytest.mark.parametrize("level", range(stereo.LEVELS))
def test_correlations_are_those_of_plain_loops(level: int):
    images, viewmats, Ks, points = capture("ridge", 2)
    masks = [torch.rand((HEIGHT, WIDTH), generator=seeded(v)) > 0.01 for v in range(2)]
    pyramids = [stereo._pyramid(*pair, torch.device("cpu")) for pair in zip(images, masks, strict=True)]
    view, _ = stereo._views(pyramids, viewmats, Ks, torch.tensor([[WIDTH, HEIGHT]] * 2).double(), points)
    image, other = (pyramid[level] for pyramid in pyramids)
    height, width = image.shape[1:]
    K = torch.diag(torch.tensor([0.5**level, 0.5**level, 1.0])).double() @ Ks[0]
    inverse = torch.linspace(0.97, 1.03, width) / trace("ridge", viewmats[0], K, height, width)[1]
    fast = stereo._correlation(image, other, view.to_neighbours[0], inverse[None].float())[0]
    compared = 0
    for y, x in [(int(height * v), int(width * u)) for v in (0.2, 0.5, 0.8) for u in (0, 0.3, 0.5, 0.7, 0.99)]:
        pairs = []
        for i in range(max(y - 2, 0), min(y + 3, height)):
            for j in range(max(x - 2, 0), min(x + 3, width)):
                ray = K.inverse() @ torch.tensor([j + 0.5, i + 0.5, 1.0]).double()
                world = viewmats[0].inverse() @ torch.cat([ray / inverse[i, j], torch.ones(1)])
                u, v, z = (K @ (viewmats[1] @ world)[:3]).tolist()
                u = u / z - 0.5
                v = v / z - 0.5
                left = math.floor(u)
                top = math.floor(v)
                corners = other[:, max(top, 0) : top + 2, max(left, 0) : left + 2].double()
                if image[1, i, j] and corners.shape == (2, 2, 2) and corners[1].all():
                    weights = torch.tensor([[1 - v + top], [v - top]]) * torch.tensor([[1 - u + left, u - left]])
                    pairs.append([float(image[0, i, j]), float((corners[0] * weights).sum())])
        if len(pairs) <= 0.5 * stereo.WINDOW**2:
            assert fast[y, x] == -1
            continue
        a, b = (torch.tensor(pairs).double() - torch.tensor(pairs).double().mean(dim=0)).T
        scale = (a.square().mean() + stereo.NOISE**2) * (b.square().mean() + stereo.NOISE**2)
        assert abs(float((a * b).mean() / scale.sqrt()) - float(fast[y, x])) < 1e-3
        compared += 1
    assert compared >= 6
