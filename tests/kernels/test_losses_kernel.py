"""The kernels of the loss against torch in float64, and their partial sums."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import pytest
import torch

from sadgs_ns import kernels
from sadgs_ns.method import losses

photometric = pytest.importorskip("sadgs_ns.kernels.losses", reason="Triton is not installed")

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
fused_photometric_loss = partial(photometric.photometric_loss, window=losses.WINDOW)


@pytest.mark.hard_case("pixels where both images agree", "L1 has a kink there; its gradient is 0, as torch's")
@pytest.mark.parametrize("shape", [(2, 21, 47, 3), (1, 11, 11, 3), (1, 20, 60, 3), (1, 40, 13, 3)], ids=str)
def test_loss_and_gradient_equal_the_float64_reference(shape):
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(shape, generator=generator)
    noise = 0.1 * torch.randn(shape, generator=generator)
    noise[:, : shape[1] // 2] = 0  # where both images agree, L1 has a kink: its gradient there is 0
    results = []
    for function, dtype in ((fused_photometric_loss, torch.float32), (losses.photometric_loss, torch.float64)):
        y = target.to(DEVICE, dtype)
        x = (target + noise).to(DEVICE, dtype).requires_grad_()
        parts = torch.linspace(-0.1, 0.3, 7).to(DEVICE, dtype).requires_grad_()
        loss, psnr = function(x, y, ssim_lambda=0.3, l2_lambda=1.5, parts=parts)
        (3 * loss).backward()
        assert x.grad is not None
        assert parts.grad is not None
        assert parts.grad.tolist() == [3.0] * 7
        results.append((loss.detach().double(), psnr.double(), x.grad.double()))
    fast, reference = results
    assert not torch.equal(reference[2], torch.zeros_like(reference[2]))
    torch.testing.assert_close(fast[0], reference[0], atol=2e-6, rtol=0)
    torch.testing.assert_close(fast[1], reference[1], atol=1e-5, rtol=0)
    torch.testing.assert_close(fast[2], reference[2], atol=5e-5 * float(reference[2].abs().max()), rtol=0)


@pytest.mark.parametrize("in_bytes", [True, False])
def test_what_clipped_pixels_excuse_equals_the_float64_reference(in_bytes: bool):
    generator = torch.Generator().manual_seed(1)
    shape = (2, 29, 47, 3)
    bytes_of_target = torch.randint(200, 256, shape, generator=generator, dtype=torch.uint8)
    noise = 0.1 * torch.randn(shape, generator=generator)
    values = bytes_of_target / 255
    is_excused = (values > 0.95) & (noise > 0)
    assert 0.05 < is_excused.float().mean() < 0.3
    results = []
    for function, dtype in ((fused_photometric_loss, torch.float32), (losses.photometric_loss, torch.float64)):
        y = values.to(DEVICE, dtype)
        if in_bytes and function is fused_photometric_loss:
            y = bytes_of_target.to(DEVICE)
        x = (values + noise).to(DEVICE, dtype).requires_grad_()
        loss, psnr = function(x, y, ssim_lambda=0.3, l2_lambda=1.5, clipped_from=0.95)
        loss.backward()
        assert x.grad is not None
        assert torch.equal(x.grad == 0, is_excused.to(DEVICE))
        results.append((loss.detach().double(), psnr.double(), x.grad.double()))
    fast, reference = results
    torch.testing.assert_close(fast[0], reference[0], atol=2e-6, rtol=0)
    torch.testing.assert_close(fast[1], reference[1], atol=1e-5, rtol=0)
    torch.testing.assert_close(fast[2], reference[2], atol=5e-5 * float(reference[2].abs().max()), rtol=0)


def test_the_loss_does_not_depend_on_how_many_rows_a_program_handles(monkeypatch):
    generator = torch.Generator().manual_seed(0)
    target = torch.rand((1, 35, 12, 3), generator=generator).to(DEVICE)
    results = []
    for programs in (1, 1000):  # One of 35 rows, and three of at most 16
        monkeypatch.setattr(photometric, "_PROGRAMS", programs)
        x = (0.9 * target).requires_grad_()
        loss, psnr = fused_photometric_loss(x, target, ssim_lambda=0.3, l2_lambda=1.5)
        loss.backward()
        results.append([loss.detach(), psnr, x.grad])
    for of_one, of_three in zip(*results, strict=True):
        torch.testing.assert_close(of_one, of_three, atol=1e-6 * float(of_three.abs().max()), rtol=0)


@pytest.mark.parametrize("size", [(1, 11, 33), (4, 532, 2397), (1, 1060, 4800), (2, 3000, 12000)], ids=str)
def test_programs_of_the_loss_cover_the_images_and_run_at_the_same_time(size):
    views, height, row = size
    (columns, strips, of_views), rows = photometric._strips(*size)
    assert columns * photometric._COLUMNS >= row
    assert strips * rows >= height
    assert of_views == views
    assert columns * strips * views <= photometric._PROGRAMS


def test_the_loss_reads_bytes_as_the_floats_that_they_stand_for():
    generator = torch.Generator().manual_seed(0)
    images = torch.randint(0, 256, (2, 21, 47, 3), generator=generator, dtype=torch.uint8).to(DEVICE)
    predicted = torch.rand((2, 21, 47, 3), generator=generator).to(DEVICE)
    results = []
    for target in (images, images * torch.tensor(1 / 255)):
        x = predicted.clone().requires_grad_()
        loss, psnr = fused_photometric_loss(x, target, ssim_lambda=0.3, l2_lambda=1.5)
        loss.backward()
        results.append([loss.detach(), psnr, x.grad])
    # On a GPU the product with 1/255 is fused with the sum that follows it, and not rounded in between.
    rounding = 1e-6 if DEVICE.type == "cuda" else 0.0
    for of_bytes, of_floats in zip(*results, strict=True):
        torch.testing.assert_close(of_bytes, of_floats, atol=rounding * float(of_floats.abs().max()), rtol=0)
    with kernels.triton_switched(False):
        slow = losses.photometric_loss(predicted, images, ssim_lambda=0.3, l2_lambda=1.5)
    actual = results[0][:2]
    torch.testing.assert_close(actual, list(slow), atol=1e-5, rtol=1e-5)


def test_flat_images_have_a_finite_gradient():
    x = torch.zeros((1, 16, 16, 3), device=DEVICE, requires_grad=True)
    loss, _ = fused_photometric_loss(x, torch.zeros_like(x), ssim_lambda=0.2, l2_lambda=2.0)
    loss.backward()
    assert x.grad is not None
    assert abs(float(loss)) < 1e-6
    assert torch.isfinite(x.grad).all()


@pytest.mark.parametrize("function", [fused_photometric_loss, losses.photometric_loss])
def test_psnr_carries_no_gradient(function):
    x = torch.rand((1, 12, 12, 3), generator=torch.Generator().manual_seed(0)).to(DEVICE).requires_grad_()
    _, psnr = function(x, torch.zeros_like(x), ssim_lambda=0.2, l2_lambda=2.0)
    assert psnr > 0
    assert not psnr.requires_grad


@pytest.mark.parametrize("value", [0.0, 1e-9, 1e15, math.inf, math.nan])
def test_psnr_of_extreme_errors_is_torchs(value):
    x = torch.zeros((1, 12, 12, 3), device=DEVICE)
    x[0, 3, 4, 1] = value
    with np.errstate(all="ignore"):  # Triton's interpreter computes with numpy
        _, actual = fused_photometric_loss(x, torch.zeros_like(x), ssim_lambda=0.2, l2_lambda=2.0)
    with kernels.triton_switched(False):
        _, expected = losses.photometric_loss(x, torch.zeros_like(x))
    torch.testing.assert_close(actual, expected, rtol=1e-6, atol=0, equal_nan=True)


def test_partial_sums_are_added_as_accurately_as_torch_adds_them():
    """Their numbers are no multiple of what is added at once, and several times as many."""
    generator = torch.Generator().manual_seed(0)
    sums = torch.rand((3, 12150), generator=generator)  # SSIM, and absolute and squared differences
    parts = torch.rand(5000, generator=generator) / 5e6
    loss = torch.zeros((), device=DEVICE)
    psnr = torch.zeros((), device=DEVICE)
    n = 12150 * 1024
    weights = 0.8 / n, 0.2 / n, 2.0 / n
    photometric._finish[1,](
        sums.to(DEVICE), parts.to(DEVICE), loss, psnr,
        n, 12150, 5000, 0.2, *weights, photometric._LANES,
    )  # fmt: skip
    of_ssim, l1, l2, more = (float(values.double().sum()) for values in (*sums, parts))
    expected = weights[0] * l1 + 0.2 - weights[1] * of_ssim + weights[2] * l2 + more
    assert float(loss) == pytest.approx(expected, abs=3e-8)
    assert float(psnr) == pytest.approx(-10 * math.log10(l2 / n), rel=1e-6)
