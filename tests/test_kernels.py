"""The Triton kernels against the torch code beside them: on the GPU, or in Triton's interpreter without one."""

from __future__ import annotations

import pytest
import torch

from sadgs_ns import kernels, losses

photometric = pytest.importorskip("sadgs_ns.kernels.photometric", reason="Triton is not installed")

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
