"""Errors of views, and each Gaussian's share in them."""

from __future__ import annotations

import pytest
import torch
from pytorch_msssim import ssim
from scenes import camera, random_params

from sadgs_ns.rasterization import rasterize
from sadgs_ns.residuals import dissimilarity, error_shares

WIDTH, HEIGHT = 40, 30


def images() -> tuple[torch.Tensor, torch.Tensor]:
    """[2, H, W, 3], rendered and true."""
    generator = torch.Generator().manual_seed(0)
    true = torch.rand((2, HEIGHT, WIDTH, 3), generator=generator, dtype=torch.float64)
    return true + 0.2 * torch.randn(true.shape, generator=generator, dtype=torch.float64), true


def test_the_errors_mean_is_that_of_ssim():
    rendered, true = images()
    errors = dissimilarity(rendered, true)
    assert errors.shape == (2, HEIGHT, WIDTH)
    inside = errors[:, 5:-5, 5:-5]
    similarity = ssim(rendered.permute(0, 3, 1, 2), true.permute(0, 3, 1, 2), data_range=1.0)
    torch.testing.assert_close(inside.mean(), 1 - similarity)
    assert errors.count_nonzero() == inside.count_nonzero(), "none where the window leaves the image"
    assert dissimilarity(true, true).max() < 1e-9


def test_an_error_lies_where_it_is():
    _, true = images()
    rendered = true.clone()
    rendered[1, 10:14, 20:24] = 1 - rendered[1, 10:14, 20:24]
    errors = dissimilarity(rendered, true)
    assert errors[0].max() < 1e-9 and errors[1, 12, 22] > 0.5
    assert errors[1, 20:].max() < 1e-9 and errors[1, :, 30:].max() < 1e-9


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_shares_are_the_errors_times_the_weights_of_blending(mode):
    """Against renderings in which one Gaussian after the other is white and all others are black."""
    params = random_params(12)
    viewmats, Ks = (matrix.repeat(2, 1, 1) for matrix in camera(WIDTH, HEIGHT))
    viewmats[1, 0, 3] = 0.4
    errors = torch.rand((2, HEIGHT, WIDTH), generator=torch.Generator().manual_seed(1))
    info = {"viewmats": viewmats, "Ks": Ks, "width": WIDTH, "height": HEIGHT}
    shares = error_shares(params, errors, info, rasterize_mode=mode)
    assert shares.shape == (2, 12) and not shares.requires_grad
    assert all(parameter.grad is None for parameter in params.values())
    gaussians = params["means"], params["quats"], params["scales"].exp(), params["opacities"].sigmoid()
    for i in range(12):
        white = torch.zeros(12, 3).index_fill(0, torch.tensor([i]), 1.0)
        weights, _, _ = rasterize(*gaussians, white, viewmats, Ks, WIDTH, HEIGHT, rasterize_mode=mode)
        torch.testing.assert_close(shares[:, i], (weights[..., 0] * errors).sum((1, 2)), rtol=1e-4, atol=1e-4)
    assert shares.max() > 1


def test_all_shares_of_an_error_of_one_are_what_is_opaque():
    params = random_params(30)
    viewmats, Ks = camera(WIDTH, HEIGHT)
    params["opacities"].data = params["opacities"].data[:, None]  # as nerfstudio keeps them
    info = {"viewmats": viewmats, "Ks": Ks, "width": WIDTH, "height": HEIGHT}
    shares = error_shares(params, torch.ones(1, HEIGHT, WIDTH), info)
    gaussians = params["means"], params["quats"], params["scales"].exp(), params["opacities"].flatten().sigmoid()
    _, alphas, _ = rasterize(*gaussians, params["features_dc"], viewmats, Ks, WIDTH, HEIGHT)
    torch.testing.assert_close(shares.sum(), alphas.sum())
