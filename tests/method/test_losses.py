"""The photometric loss."""

from __future__ import annotations

import math

import torch
from pytorch_msssim import ssim
from torch.testing import assert_close

from helpers.generators import seeded
from sadgs_ns.method.losses import photometric_loss


def images(*shape: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = seeded(0)
    target = torch.rand(shape, generator=generator, dtype=torch.float64)
    return target + 0.1 * torch.randn(shape, generator=generator, dtype=torch.float64), target


def test_loss_is_the_stated_sum():
    predicted, target = images(2, 20, 30, 3)
    loss, psnr = photometric_loss(predicted, target, ssim_lambda=0.3, l2_lambda=1.5)
    similarity = ssim(predicted.permute(0, 3, 1, 2), target.permute(0, 3, 1, 2), data_range=1.0)
    l1 = (predicted - target).abs().mean()
    l2 = (predicted - target).square().mean()
    expected = 0.7 * l1 + 0.3 * (1 - similarity) + 1.5 * l2
    assert_close(loss, expected)
    assert_close(psnr, 10 * torch.log10(1 / l2))


def test_equal_images_cost_nothing():
    _, target = images(1, 16, 16, 3)
    loss, psnr = photometric_loss(target, target)
    assert abs(float(loss)) < 1e-6
    assert psnr == math.inf


def test_gradient_by_finite_differences():
    predicted, target = images(1, 12, 13, 3)
    assert torch.autograd.gradcheck(lambda p: photometric_loss(p, target)[0], (predicted.requires_grad_(),))


def test_colours_outside_the_unit_interval_get_gradients():
    predicted = torch.full((1, 16, 16, 3), 1.2, requires_grad=True)
    loss, _ = photometric_loss(predicted, torch.ones(1, 16, 16, 3))
    loss.backward()
    assert predicted.grad is not None
    assert (predicted.grad > 0).all()
