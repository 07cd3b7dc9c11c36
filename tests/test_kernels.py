"""The Triton kernels against the torch code beside them: on the GPU, or in Triton's interpreter without one."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from sadgs_ns import kernels, losses
from sadgs_ns.bench.rasterizers import random_scene

photometric = pytest.importorskip("sadgs_ns.kernels.photometric", reason="Triton is not installed")
tiles = pytest.importorskip("sadgs_ns.kernels.tiles", reason="Triton is not installed")

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")


@pytest.mark.parametrize("shape", [(2, 37, 51, 3), (1, 11, 11, 3), (1, 20, 90, 3)], ids=str)
def test_loss_and_gradient_equal_the_float64_reference(shape):
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(shape, generator=generator)
    noise = 0.1 * torch.randn(shape, generator=generator)
    noise[:, : shape[1] // 2] = 0  # where both images agree, L1 has a kink: its gradient there is 0
    results = []
    for function, dtype in ((photometric.photometric_loss, torch.float32), (losses.photometric_loss, torch.float64)):
        y = target.to(DEVICE, dtype)
        x = (target + noise).to(DEVICE, dtype).requires_grad_()
        loss, mse = function(x, y, ssim_lambda=0.3, l2_lambda=1.5)
        (3 * loss).backward()
        assert x.grad is not None
        results.append((loss.detach().double(), mse.detach().double(), x.grad.double()))
    fast, reference = results
    assert not torch.equal(reference[2], torch.zeros_like(reference[2]))
    torch.testing.assert_close(fast[0], reference[0], atol=2e-6, rtol=0)
    torch.testing.assert_close(fast[1], reference[1], atol=1e-7, rtol=1e-6)
    torch.testing.assert_close(fast[2], reference[2], atol=5e-5 * float(reference[2].abs().max()), rtol=0)


def test_flat_images_have_a_finite_gradient():
    x = torch.zeros((1, 16, 16, 3), device=DEVICE, requires_grad=True)
    loss, _ = photometric.photometric_loss(x, torch.zeros_like(x), ssim_lambda=0.2, l2_lambda=2.0)
    loss.backward()
    assert x.grad is not None and abs(float(loss)) < 1e-6 and torch.isfinite(x.grad).all()


def test_mean_squared_error_carries_no_gradient():
    x = torch.rand((1, 12, 12, 3), device=DEVICE, requires_grad=True)
    _, mse = photometric.photometric_loss(x, torch.zeros_like(x), ssim_lambda=0.2, l2_lambda=2.0)
    assert not mse.requires_grad


def test_kernels_are_for_cuda_only():
    assert not kernels.available(torch.device("cpu"))


def projected_gaussians(num_views: int, n: int, width: int, height: int) -> dict[str, Tensor]:
    """Ellipses of all sizes, some long and thin, some faint, some culled, some off the image."""
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
    width, height, n = 75, 50, 120
    gaussians = projected_gaussians(2, n, width, height)
    radii = gaussians["radii"][..., None].expand(-1, -1, 2).float()  # [C, N, 2]
    if radius_per_axis:  # as gsplat 1.5
        gaussians["radii"] = gaussians["radii"][..., None] * torch.tensor([1, 2], dtype=torch.int32)
        radii = gaussians["radii"].float()
    on_device = {name: value.to(DEVICE) for name, value in gaussians.items()}
    starts, ids = tiles.intersect_tiles(**on_device, width=width, height=height, tile_size=tile_size)
    rows, columns = math.ceil(height / tile_size), math.ceil(width / tile_size)
    assert starts.shape == (2, rows, columns)
    lists = ids.cpu().tensor_split(starts.cpu().flatten().tolist()[1:])
    n_listed = n_needed = n_square = 0
    for number, listed in enumerate(lists):
        view, row, column = number // (rows * columns), number // columns % rows, number % columns
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
        n_listed, n_needed, n_square = n_listed + len(listed), n_needed + len(needed), n_square + int(in_square.sum())
    assert n_needed > 500
    assert n_listed < 1.02 * n_needed < 0.7 * n_square


def test_no_gaussian_in_sight_makes_empty_lists():
    gaussians = projected_gaussians(1, 5, 32, 32)
    gaussians["radii"] = torch.zeros_like(gaussians["radii"])
    on_device = {name: value.to(DEVICE) for name, value in gaussians.items()}
    starts, ids = tiles.intersect_tiles(**on_device, width=32, height=32, tile_size=16)
    assert len(ids) == 0 and (starts == 0).all()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="gsplat's kernels need CUDA")
@pytest.mark.parametrize("render_mode", ["RGB", "RGB+ED"])
def test_rasterization_equals_gsplats_own(render_mode):
    from gsplat import rasterization as gsplats

    from sadgs_ns.kernels import rasterization as ours

    scene = {name: value.float().cuda() for name, value in random_scene(3000, 128, seed=0).items()}
    del scene["weights"]
    shared = {"width": 128, "height": 128, "sh_degree": 3, "render_mode": render_mode, "packed": False}
    shared |= {"near_plane": 0.01, "far_plane": 1e10, "rasterize_mode": "antialiased", "absgrad": False}
    expected, expected_alphas, _ = gsplats(**scene, **shared, tile_size=ours.TILE_SIZE)
    renders, alphas, _ = ours.rasterization(**scene, **shared, backgrounds=None)
    assert torch.equal(alphas, expected_alphas)
    torch.testing.assert_close(renders, expected, atol=1e-5, rtol=1e-5)
