"""The photometric loss."""

from __future__ import annotations

import math

import pytest
import torch
from pytorch_msssim import ssim
from torch.testing import assert_close

from helpers.generators import seeded
from sadgs_ns.geometry.point_colors import BRIGHTEST, OFFSET, srgb_gains
from sadgs_ns.method.losses import excuse_clipped, photometric_loss, photometric_part
from sadgs_ns.training.step.train_step import CLIPPED_FROM


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


@pytest.mark.parametrize("in_bytes", [True, False])
def test_only_renderings_brighter_than_a_clipped_photo_are_excused(in_bytes: bool):
    photo = torch.tensor([255, 255, 248, 248, 247, 247, 0], dtype=torch.uint8)
    values = photo / 255
    changes = torch.tensor([0.5, -0.5, 0.01, -0.01, 0.5, -0.5, 0.5])
    counts = [False, True, False, True, True, True, True]
    for index, counted in enumerate(counts):
        target = photo[index].expand(1, 12, 13, 3)
        if not in_bytes:
            target = values[index].expand(1, 12, 13, 3)
        render = (values[index] + changes[index]).expand(1, 12, 13, 3).clone().requires_grad_()
        loss, psnr = photometric_loss(render, target, clipped_from=CLIPPED_FROM)
        loss.backward()
        assert render.grad is not None
        assert (float(psnr) < math.inf) == counted
        assert (float(loss.detach()) > 1e-6) == counted
        assert render.grad.any() == counted


def test_parts_of_a_view_excuse_what_the_whole_view_does():
    predicted, target = images(1, 31, 14, 3)
    whole, _ = photometric_loss(predicted, target, clipped_from=0.7)
    plain, _ = photometric_loss(predicted, target)
    parts = []
    for first, last in ((0, 16), (16, 31)):
        top = max(first - 5, 0)
        seen = slice(top, min(last + 5, 31))
        part, _ = photometric_part(
            predicted[:, seen], target[:, seen], rows=(first, last), top=top, height=31, clipped_from=0.7
        )
        parts.append(part)
    assert_close(sum(parts), whole)
    assert whole < plain - 0.01


@pytest.mark.hard_case(
    "sky that long exposures clip, with gains of exposure",
    "short exposures alone tell its colour; before, the long ones darkened it",
)
def test_photos_of_all_exposures_agree_on_a_sky_that_some_of_them_clip():
    sky = 0.8
    gains = srgb_gains(torch.tensor([-1.0, 0.0, 1.0]))
    offsets = OFFSET * (gains - 1)
    photos = (gains * sky + offsets).clamp(max=1).view(3, 1, 1, 1).expand(3, 4, 5, 3)
    assert photos[2].amin() > BRIGHTEST
    assert photos[1].amax() < BRIGHTEST
    slopes = []
    for error in (-0.02, 0.0, 0.02):
        color = torch.full((3, 4, 5, 3), sky + error).requires_grad_()
        at_exposures = color * gains.view(3, 1, 1, 1) + offsets.view(3, 1, 1, 1)
        rendered = excuse_clipped(at_exposures, photos, CLIPPED_FROM)
        (rendered - photos).square().sum().backward()
        assert color.grad is not None
        slopes.append(float(color.grad.sum()))
    darker, right, brighter = slopes
    assert darker < 0
    assert abs(right) < 1e-4
    assert brighter > 0
