"""Reduced images, masks and intrinsics, the length of Gaussians in px, and the level that follows from it."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scenes import camera, cameras_at, random_params, splat
from torch import Tensor

from sadgs_ns.method import resolution
from sadgs_ns.method.absgs import accumulate_gradients, empty_gradients
from sadgs_ns.method.eta import projected_axes
from sadgs_ns.method.resolution import (
    LEAST_PIXELS,
    LEVELS,
    coarsest_level,
    footprint_length,
    reduce_image,
    reduce_intrinsics,
    reduce_mask,
    typical_length,
)
from sadgs_ns.render.splatter import rasterization


def mean_of_squares(image: Tensor, level: int) -> Tensor:
    """The obvious mean: one pixel after the other, in float64, with the opacities of RGBA as weights."""
    height, width = image.shape[0] // level, image.shape[1] // level
    result = torch.zeros(height, width, image.shape[-1], dtype=torch.float64)
    for row in range(height):
        for column in range(width):
            pixels = image[row * level : (row + 1) * level, column * level : (column + 1) * level].double()
            pixels = pixels.reshape(level**2, -1)
            result[row, column] = pixels.mean(dim=0)
            if pixels.shape[-1] == 4 and pixels[:, 3].sum() > 0:
                result[row, column, :3] = (pixels[:, :3] * pixels[:, 3:]).sum(dim=0) / pixels[:, 3].sum()
            elif pixels.shape[-1] == 4:
                result[row, column, :3] = 0
    return result


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("channels", [3, 4])
@pytest.mark.parametrize(("height", "width"), [(8, 12), (9, 7), (11, 6)])
def test_images_are_means_of_squares_and_the_rest_is_left_out(level: int, channels: int, height: int, width: int):
    image = torch.rand((height, width, channels), generator=torch.manual_seed(0))
    image[:4, :4, 3:] = 0  # A square is transparent as a whole.
    reduced = reduce_image(image, level)
    assert reduced.dtype == torch.float32 and reduced.shape == (height // level, width // level, channels)
    assert (reduced - mean_of_squares(image, level)).abs().max() < 1e-6


@pytest.mark.parametrize("level", LEVELS)
def test_bytes_are_rounded_and_full_images_stay_as_they_are(level: int):
    image = torch.randint(0, 256, (16, 20, 3), dtype=torch.uint8, generator=torch.manual_seed(0))
    reduced = reduce_image(image, level)
    assert reduced.dtype == torch.uint8
    # Means of 4 and 16 bytes are exact in float32, so that both round alike.
    assert torch.equal(reduced, mean_of_squares(image, level).round().byte())
    assert level > 1 or torch.equal(reduced, image)


@pytest.mark.parametrize("level", LEVELS)
def test_a_square_with_a_masked_pixel_is_masked(level: int):
    mask = torch.rand((13, 9, 1), generator=torch.manual_seed(0)) > 0.1
    reduced = reduce_mask(mask, level)
    for row in range(13 // level):
        for column in range(9 // level):
            square = mask[row * level : (row + 1) * level, column * level : (column + 1) * level]
            assert reduced[row, column] == square.all()
    assert reduced.shape == (13 // level, 9 // level, 1)


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize(("width", "height"), [(64, 48), (67, 49)])
def test_the_centre_of_a_square_is_projected_to_the_centre_of_its_pixel(level: int, width: int, height: int):
    _, Ks = camera(width, height, focal=51.0, dtype=torch.float64)
    reduced = reduce_intrinsics(Ks, level)[0]
    for column, row in ((0, 0), (5, 3), (width // level - 1, height // level - 1)):
        centre = torch.tensor([level * (column + 0.5), level * (row + 0.5), 1.0], dtype=torch.float64)
        ray = torch.linalg.inv(Ks[0]) @ centre
        np.testing.assert_allclose(reduced @ ray, [column + 0.5, row + 0.5, 1], atol=1e-12)


@pytest.mark.parametrize("level", [2, 4])
def test_a_reduced_camera_renders_the_mean_of_what_the_full_one_renders(level: int):
    params = random_params(12, dtype=torch.float64)
    params["scales"].data += math.log(3)
    viewmats, Ks = camera(130, 97, focal=120.0, dtype=torch.float64)
    full, _, _ = splat(params, viewmats, Ks, 130, 97)
    small, _, _ = splat(params, viewmats, reduce_intrinsics(Ks, level), 130 // level, 97 // level)
    # What is left is gsplat's blur of .3 px², which is wider in larger pixels, and the curvature within a pixel.
    difference = (small[0] - reduce_image(full[0].detach(), level)).abs()
    shifted = (small[0, :, 1:] - reduce_image(full[0].detach(), level)[:, :-1]).abs()
    assert difference.mean() < 0.02 and difference.mean() < 0.2 * shifted.mean()


# --- how long Gaussians are ---


def test_the_length_is_the_fourth_root_of_the_determinant():
    axes = torch.randn((50, 3, 2), dtype=torch.float64, generator=torch.manual_seed(0))
    covariance = axes.mT @ axes
    expected = torch.linalg.det(covariance).clamp_min(0) ** 0.25
    np.testing.assert_allclose(footprint_length(axes), expected, rtol=1e-6)
    sphere = torch.tensor([[[3.0, 0.0], [0.0, 3.0], [0.0, 0.0]]])
    assert footprint_length(sphere).item() == pytest.approx(3)
    assert footprint_length(torch.tensor([[[0.1, 0.3], [0.0, 0.0], [0.0, 0.0]]])) == 0, "a line has no area"


def median_by_hand(params: dict[str, torch.nn.Parameter], viewmats: Tensor, Ks: Tensor, width: int, height: int):
    """The length at which half of the opacity is passed, counted Gaussian by Gaussian in float64."""
    seen = []
    for viewmat, K in zip(viewmats.double(), Ks.double(), strict=True):
        for i in range(len(params["means"])):
            point = viewmat[:3, :3] @ params["means"][i].double() + viewmat[:3, 3]
            pixel = (K @ point)[:2] / point[2]
            if point[2] > 0.01 and 0 <= pixel[0] < width and 0 <= pixel[1] < height:
                one = (params[name][i : i + 1].detach().double() for name in ("means", "quats", "scales"))
                means, quats, scales = one
                axes = projected_axes(means, quats, scales.exp(), viewmat[None], K[None], width, height)
                covariance = axes[0].T @ axes[0]
                length = float(torch.linalg.det(covariance)) ** 0.25
                seen.append((length, float(torch.sigmoid(params["opacities"][i].detach().double()))))
    half, passed = sum(weight for _, weight in seen) / 2, 0.0
    for length, weight in sorted(seen):
        passed += weight
        if passed >= half:
            return length
    return math.nan


def test_the_typical_length_is_the_median_of_what_views_see_weighted_by_opacity():
    params = random_params(40)
    params["opacities"].data = 3 * torch.randn(40, generator=torch.manual_seed(1))
    _, Ks = camera(64, 48, focal=60.0)
    viewmats = torch.cat([torch.eye(4)[None], cameras_at(torch.tensor([[0.0, 0.0, 4.0], [1.0, 0.0, 0.0]]))])
    found = typical_length(params, viewmats, Ks.expand(3, 3, 3), [(64, 48)] * 3)  # type: ignore[arg-type]
    assert float(found) == pytest.approx(median_by_hand(params, viewmats, Ks.expand(3, 3, 3), 64, 48), rel=1e-4)


def test_gaussians_that_no_view_sees_or_that_are_not_finite_have_no_say():
    params = random_params(30)
    viewmats, Ks = camera()
    expected = typical_length(params, viewmats, Ks, [(64, 48)])  # type: ignore[arg-type]
    more = {name: torch.cat([value.detach(), value.detach()[:3]]) for name, value in params.items()}
    more["means"][30:] = torch.tensor([[0.0, 0.0, -4.0], [100.0, 0.0, 4.0], [math.nan, 0.0, 4.0]])
    assert torch.equal(typical_length(more, viewmats, Ks, [(64, 48)]), expected)  # type: ignore[arg-type]
    behind = {name: value[30:31] for name, value in more.items()}
    assert typical_length(behind, viewmats, Ks, [(64, 48)]).isnan()  # type: ignore[arg-type]


def test_a_length_in_px_follows_the_intrinsics():
    params, (viewmats, Ks) = random_params(30), camera()
    full = typical_length(params, viewmats, Ks, [(64, 48)])  # type: ignore[arg-type]
    half = typical_length(params, viewmats, reduce_intrinsics(Ks, 2), [(32, 24)])  # type: ignore[arg-type]
    assert float(half) == pytest.approx(float(full) / 2, rel=1e-4)


# --- the level ---


@pytest.mark.parametrize(
    ("length", "pixels", "strength", "level"),
    [
        (4.0, 16 * LEAST_PIXELS, 1.0, 4),
        (3.9, 16 * LEAST_PIXELS, 1.0, 2),
        (2.0, 16 * LEAST_PIXELS, 1.0, 2),
        (1.9, 16 * LEAST_PIXELS, 1.0, 1),
        (100.0, 16 * LEAST_PIXELS - 1, 1.0, 2),
        (100.0, 4 * LEAST_PIXELS - 1, 1.0, 1),
        (2.0, 16 * LEAST_PIXELS, 2.0, 4),
        (2.0, 16 * LEAST_PIXELS, 0.5, 1),
        (math.nan, 16 * LEAST_PIXELS, 1.0, 1),
        (math.inf, 16 * LEAST_PIXELS, 1.0, 4),
    ],
)
def test_a_level_is_rendered_while_gaussians_are_longer_than_its_pixels(
    length: float, pixels: int, strength: float, level: int
):
    assert coarsest_level(length, pixels, strength) == level


def test_the_levels_go_from_coarse_to_full():
    assert list(LEVELS) == sorted(LEVELS, reverse=True) and LEVELS[-1] == 1
    assert 0 < resolution.FULL_SHARE < 1


# --- what densification reads of a reduced step ---


@pytest.mark.parametrize("level", [2, 4])
def test_screen_gradients_of_long_gaussians_mean_the_same_at_every_level(level: int):
    """Both are per half image, of a loss that is a mean over pixels, so that thresholds need not know the level."""
    width, height = 256, 192
    params = random_params(8)
    params["scales"].data = torch.full((8, 3), math.log(0.15))
    viewmats, Ks = camera(width, height, focal=240.0)
    target, _, _ = splat(random_params(8, seed=1), viewmats, Ks, width, height)
    found = {}
    for factor in (1, level):
        size = width // factor, height // factor
        render, _, info = rasterization(
            params["means"], params["quats"], params["scales"].exp(), torch.sigmoid(params["opacities"]),
            params["features_dc"], viewmats, reduce_intrinsics(Ks, factor), *size, packed=False, absgrad=True,
        )  # fmt: skip
        info["means2d"].retain_grad()
        (render[0] - reduce_image(target[0].detach(), factor)).abs().mean().backward()
        found[factor] = empty_gradients(8, torch.device("cpu"))
        accumulate_gradients(found[factor], info, 1)
    for name in ("grad2d", "absgrad2d"):
        one, other = found[1][name], found[level][name]
        assert one.min() > 0
        assert (one - other).abs().max() < 0.1 * one.max(), name
        assert (one / other).log().abs().median() < math.log(1.1), name
