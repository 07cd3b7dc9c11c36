"""Sizes that the kernels cannot address are refused, and those that they can are addressed in 64 bits."""

from __future__ import annotations

import pytest
import torch
from torch.testing import assert_close

from helpers.refusals import refusal
from sadgs_ns.kernels import limits
from sadgs_ns.render.types import Cameras, Gaussians, RenderOptions

harmonics = pytest.importorskip("sadgs_ns.kernels.harmonics", reason="Triton is not installed")
losses = pytest.importorskip("sadgs_ns.kernels.losses", reason="Triton is not installed")
backend_triton = pytest.importorskip("sadgs_ns.render.backend_triton", reason="Triton is not installed")
tiles = pytest.importorskip("sadgs_ns.kernels.tiles", reason="Triton is not installed")

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")


@pytest.mark.hard_case(
    "the most Gaussians × views, pixels, rows, views and tile pairs that the kernels address, and one more",
    "run; refused in one sentence",
)
def test_the_largest_sizes_pass_and_one_more_is_refused():
    limits.check_gaussians(1, limits.MAX_ROWS)
    limits.check_pixels(1, 1, limits.MAX_ROWS)
    limits.check_batch(1, 3, 1, limits.MAX_ROWS)
    limits.check_pairs(limits.MAX_PAIRS)
    for check, sizes in (
        (limits.check_gaussians, (1, limits.MAX_ROWS + 1)),
        (limits.check_gaussians, (limits.MAX_BLOCKS + 1, 1)),
        (limits.check_pixels, (1, 1, limits.MAX_ROWS + 1)),
        (limits.check_pixels, (1, limits.MAX_HEIGHT + 1, 1)),
        (limits.check_batch, (1, 3, 1, limits.MAX_ROWS + 1)),
        (limits.check_batch, (limits.MAX_BLOCKS // 3 + 1, 3, 1, 1)),
        (limits.check_pairs, (limits.MAX_PAIRS + 1,)),
    ):
        with refusal(r"^[^.]+ are [\d,]+, and the Triton kernels can address [\d,]+: [^.]+\.$"):
            check(*sizes)


def render(num_views: int, num_gaussians: int, side: int) -> None:
    means = torch.empty((num_gaussians, 3), device="meta")
    viewmats = torch.empty((num_views, 4, 4), device="meta")
    gaussians = Gaussians(means, means, means, means, means)
    cameras = Cameras(viewmats, viewmats, side, side)
    backend_triton.project(gaussians, cameras, RenderOptions())


@pytest.mark.hard_case("more Gaussians, pixels or tile pairs than the kernels address", "refused before anything runs")
def test_too_many_gaussians_pixels_or_tile_pairs_are_refused_before_anything_runs():
    with refusal(r"4 × 200,000,000, are 800,000,000, and .*: take fewer views at once, or"):
        render(4, 200_000_000, 10)
    with refusal(r"1 × 30,000 × 30,000, are 900,000,000"):
        render(1, 10, 30_000)
    image = torch.empty((1, 30_000, 30_000, 3), device="meta")
    with refusal("take fewer views at once, or smaller images"):
        losses.photometric_loss(image, image, (1.0,), ssim_lambda=0.2, l2_lambda=2.0)
    empty = torch.empty(0)
    counts = tiles.PairCounts(torch.tensor([2**31 - 1, 1]), None)
    pending = tiles.PendingTiles([], empty, empty, counts, 8, (2, 1, 1))
    with refusal(r"pairs of a Gaussian and a tile .* are 2,147,483,648"):
        pending.lists()


@pytest.mark.hard_case("coefficients beyond 2³¹ numbers (47.7 million Gaussians)", "are found, forward and backward")
def test_coefficients_beyond_32_bits_are_found_forward_and_backward():
    """Three Gaussians whose rows of coefficients lie as far apart as those of 48 million: 2 · 2^30 overflows 32 bits.

    Nothing but these rows is touched, so that the memory between them is never made; bytes need the least of it.
    """
    stride = 2**30
    n = 3
    means = torch.tensor([[0.0, 0.0, 1.0]]).repeat(n, 1).to(DEVICE)
    viewmats = torch.eye(4, device=DEVICE)[None]
    rest, v_rest = (torch.empty(2 * stride + 45, dtype=torch.uint8, device=DEVICE) for _ in range(2))
    for g in range(n):
        rest[g * stride : g * stride + 45] = 0
        rest[g * stride + 3 : g * stride + 6] = torch.tensor([g, 2, 3])  # of the harmonic 0.4886 z
    first = torch.zeros((n, 3), device=DEVICE)
    radii = torch.ones((1, n), dtype=torch.int32, device=DEVICE)
    colors = torch.empty((1, n, 3), device=DEVICE)
    harmonics._forward[1,](means, viewmats, first, rest, radii, colors, n, 1, 3, stride, 1, 32)
    expected = 0.5 + 0.48860251190292 * torch.tensor([[[0.0, 2, 3], [1, 2, 3], [2, 2, 3]]])
    assert_close(colors.cpu(), expected)
    v_colors = torch.tensor([[[10.0, 20, 30], [40, 50, 60], [70, 80, 90]]], device=DEVICE)
    v_means = torch.empty_like(means)
    v_first = torch.empty_like(first)
    harmonics._backward[1,](
        means, viewmats, rest, radii, colors, v_colors, v_means, v_first, v_rest, v_means,
        n, 1, 3, stride, 3, False, 1, 32,
    )  # fmt: skip
    for g in range(n):
        expected = (0.48860251190292 * v_colors[0, g]).byte()
        assert torch.equal(v_rest[g * stride + 3 : g * stride + 6], expected)
