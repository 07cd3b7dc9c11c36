"""Cleaning: what views see of Gaussians, and which ones are taken away."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from helpers.small_scenes import camera, random_params
from sadgs_ns.geometry.cleaning import Cleaning, Visibility, choose_remaining, measure_visibility

WIDTH = 64
HEIGHT = 48
FOCAL = 60.0


def view(x: float = 0.0) -> tuple[Tensor, Tensor, int, int]:
    """A camera that looks along z from (x, 0, 0)."""
    viewmats, Ks = camera(WIDTH, HEIGHT, FOCAL)
    viewmats[0, 0, 3] = -x
    return viewmats[0], Ks[0], WIDTH, HEIGHT


def balls(*of: tuple[tuple[float, float, float], float, float]) -> dict[str, Tensor]:
    """Round Gaussians, each given by its centre, its standard deviation and its opacity."""
    means, sigmas, opacities = zip(*of, strict=True)
    return {
        "means": torch.tensor(means).float(),
        "scales": torch.tensor(sigmas).log()[:, None].repeat(1, 3),
        "quats": torch.eye(1, 4).repeat(len(of), 1),
        "opacities": torch.logit(torch.tensor(opacities))[:, None],
    }


def test_a_view_sees_opacity_times_area():
    """A round Gaussian of σ px and opacity o makes up 2 π o σ² px; what is under 1/255 of opacity is not drawn."""
    seen = measure_visibility(balls(((0, 0, 4), 0.2, 0.5)), [view()])
    sigma = FOCAL * 0.2 / 4
    expected = 2 * math.pi * (sigma**2 + 0.3) * (0.5 - 1 / 255)  # 0.3 px² is the rasterizer's blur.
    assert float(seen.pixels) == pytest.approx(expected, rel=0.02)
    assert seen.views.tolist() == [1]
    assert seen.total == 1


def test_what_is_hidden_or_outside_the_image_is_not_seen():
    wall = [((0, 0, 3.0 + 0.01 * i), 2.0, 0.99) for i in range(4)]
    params = balls(*wall, ((0, 0, 6), 0.1, 0.9), ((30, 0, 6), 0.1, 0.9), ((0, 0, -4), 0.1, 0.9))
    seen = measure_visibility(params, [view(), view(0.1)])
    assert seen.views.tolist()[4:] == [0, 0, 0]
    assert seen.pixels[4:].amax() < 1 / 255
    assert seen.views.tolist()[0] == 2
    assert seen.pixels[0] > 0.5 * WIDTH * HEIGHT


def test_the_views_are_counted_and_the_most_pixels_kept():
    params = balls(((0, 0, 4), 0.2, 0.5), ((3, 0, 4), 0.2, 0.5))
    near = view()
    near[0][2, 3] = -1.0  # It stands at z = 1.
    seen = measure_visibility(params, [view(), near, view(3.0)])
    assert seen.views.tolist() == [2, 1]
    assert seen.pixels[0] > 1.5 * seen.pixels[1]


def test_looking_changes_nothing_and_needs_no_gradients():
    params = random_params(50)
    before = {name: value.detach().clone() for name, value in params.items()}
    with torch.no_grad():
        seen = measure_visibility(params, [view()])
    assert not seen.pixels.requires_grad
    for value in params.values():
        assert value.grad is None
    for name in before:
        assert torch.equal(before[name], params[name])
    assert int(seen.views.sum()) > 25


def test_what_is_not_finite_is_not_seen_and_hides_nothing():
    params = balls(*[((0.0, 0.0, 4.0), 0.2, 0.5)] * 4)
    expected = measure_visibility(balls(((0, 0, 4), 0.2, 0.5)), [view()]).pixels
    params["means"][0, 0] = math.nan
    params["scales"][1, 1] = math.inf
    params["opacities"][2, 0] = math.nan
    seen = measure_visibility(params, [view()])
    assert seen.views.tolist() == [0, 0, 0, 1]
    actual = seen.pixels[3:]
    assert_close(actual, expected)


def test_each_option_takes_what_it_says_and_how_many_is_counted():
    params = balls(((0, 0, 0), 0.1, 0.5), ((9, 0, 0), 0.1, 0.5), ((0, 0, 0), 3.0, 0.5), ((9, 0, 0), 3.0, 0.5))
    seen = Visibility(torch.tensor([1, 2, 3, 4]), torch.tensor([0.4, 3.0, 0.2, 7.0]), 5)
    for cleaning, stays, num_removed in (
        (Cleaning(), [1, 1, 1, 1], {}),
        (Cleaning(crop=(-1, -1, -1, 1, 1, 1)), [1, 0, 1, 0], {"crop": 2}),
        (Cleaning(max_extent=1.0), [1, 1, 0, 0], {"max_extent": 2}),
        (Cleaning(min_views=3), [0, 0, 1, 1], {"min_views": 2}),
        (Cleaning(dust=0.5), [0, 1, 0, 1], {"dust": 2}),
        (Cleaning(max_extent=1.0, dust=0.5), [0, 1, 0, 0], {"max_extent": 2, "dust": 1}),
    ):
        remaining = choose_remaining(params, cleaning, seen)
        assert remaining.stays.int().tolist() == stays
        actual = list(remaining.num_removed.items())
        assert actual == list(num_removed.items())
        assert remaining.num_views == (5 if cleaning.needs_views else 0)
