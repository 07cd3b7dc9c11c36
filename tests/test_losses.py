"""The photometric loss against the library's SSIM, and its gradient against finite differences."""

from __future__ import annotations

import pytest
import torch
from pytorch_msssim import ssim

from sadgs_ns.losses import mean_ssim, photometric_loss


def images(*shape: int, dtype: torch.dtype = torch.float64) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(shape, generator=generator, dtype=dtype)
    return target + 0.1 * torch.randn(shape, generator=generator, dtype=dtype), target


@pytest.mark.parametrize("size", [(11, 11), (12, 40), (37, 150), (150, 300)])
def test_ssim_and_its_gradient_equal_the_library_s(size: tuple[int, int]):
    predicted, target = images(2, 3, *size)
    predicted.requires_grad_()
    expected = ssim(predicted, target, data_range=1.0, win_size=11)
    (expected_gradient,) = torch.autograd.grad(expected, predicted)
    actual = mean_ssim(predicted, target)
    (gradient,) = torch.autograd.grad(actual, predicted)
    # The library makes its window in float32: that, and nothing else, separates the two.
    torch.testing.assert_close(actual, expected, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(gradient, expected_gradient, rtol=1e-4, atol=1e-5 * float(expected_gradient.abs().max()))


def test_ssim_gradient_by_finite_differences():
    predicted, target = images(1, 3, 13, 14)
    assert torch.autograd.gradcheck(lambda p: mean_ssim(p, target), (predicted.requires_grad_(),))


def test_float32_stays_near_float64():
    predicted, target = images(1, 3, 64, 200)
    exact = mean_ssim(predicted, target)
    assert abs(float(mean_ssim(predicted.float(), target.float()) - exact)) < 2e-6


@pytest.mark.parametrize("size", [(1, 1), (1, 30), (5, 8), (10, 10)])
def test_images_smaller_than_the_window(size: tuple[int, int]):
    predicted, target = images(1, 3, *size)
    assert -1 <= mean_ssim(predicted, target) <= 1
    assert abs(float(mean_ssim(target, target)) - 1) < 1e-12


def test_loss_is_the_stated_sum():
    predicted, target = images(2, 20, 30, 3)
    loss, mse = photometric_loss(predicted, target, ssim_lambda=0.3, l2_lambda=1.5)
    similarity = mean_ssim(predicted.permute(0, 3, 1, 2), target.permute(0, 3, 1, 2))
    l1, l2 = (predicted - target).abs().mean(), (predicted - target).square().mean()
    torch.testing.assert_close(loss, 0.7 * l1 + 0.3 * (1 - similarity) + 1.5 * l2)
    torch.testing.assert_close(mse, l2)


def test_colours_outside_the_unit_interval_get_gradients():
    predicted = torch.full((1, 16, 16, 3), 1.2, requires_grad=True)
    loss, _ = photometric_loss(predicted, torch.ones(1, 16, 16, 3))
    loss.backward()
    assert predicted.grad is not None and (predicted.grad > 0).all()
