"""The light of points is read where photos show it, and gains of light are affine maps of sRGB's values."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from torch.testing import assert_close

from benchmarks.exposures import linear_light, srgb_values
from helpers.closeness import assert_within
from sadgs_ns.geometry.point_colors import EXPONENT, OFFSET, apply_gains, observe_points, srgb_gains

SIZE = 9
K = torch.tensor([[9.0, 0.0, 4.5], [0.0, 9.0, 4.5], [0.0, 0.0, 1.0]])
FACING = torch.eye(4)


def point_at(x: float, y: float, depth: float = 1.0) -> torch.Tensor:
    """The point that is projected to a place in px. [1, 3]"""
    return torch.tensor([[(x - 4.5) / 9, (y - 4.5) / 9, 1.0]]) * depth


def picture() -> torch.Tensor:
    """Values of 8 bits that differ from pixel to pixel. [9, 9, 3]"""
    return (40 + 2 * torch.arange(SIZE * SIZE)[:, None] + torch.arange(3)).reshape(SIZE, SIZE, 3).to(torch.uint8)


def seen(image: torch.Tensor, points: torch.Tensor, mask: torch.Tensor | None = None) -> list[int]:
    indices, stops = observe_points(image, mask, FACING, K, points)
    assert len(stops) == len(indices)
    assert stops.isfinite().all()
    return indices.tolist()


def test_the_mean_light_of_9_pixels_is_read_where_the_point_lies():
    image = picture()
    indices, stops = observe_points(image, None, FACING, K, point_at(6.2, 2.9))
    values = image[1:4, 5:8].double() / 255
    light = (((values + OFFSET) / (1 + OFFSET)) ** EXPONENT).mean(dim=(0, 1))
    assert indices.tolist() == [0]
    expected = light.log2()[None]
    assert_close(stops, expected)
    _, same = observe_points(image / 255, None, FACING, K, point_at(6.2, 2.9))
    assert_within(same, stops, 1e-6)


def test_points_behind_the_camera_at_the_border_or_outside_are_left_out():
    places = [point_at(4.5, 4.5), point_at(4.5, 4.5, -1.0), point_at(0.5, 4.5), point_at(8.5, 4.5), point_at(20, 4)]
    places.append(torch.full((1, 3), torch.nan))
    actual = seen(picture(), torch.cat(places))
    assert actual == [0]


@pytest.mark.hard_case("clipped, dark, masked or transparent pixels around a point", "do not tell exposure")
def test_a_pixel_that_is_clipped_dark_masked_or_transparent_leaves_the_point_out():
    points = torch.cat([point_at(2.5, 2.5), point_at(6.5, 6.5)])
    for value in (255, 3):
        image = picture()
        image[3, 3, 1] = value
        assert seen(image, points) == [1]
    mask = torch.ones((SIZE, SIZE), dtype=torch.bool)
    mask[5, 5] = False
    assert seen(picture(), points, mask) == [0]
    opaque = torch.full((SIZE, SIZE, 1), 255, dtype=torch.uint8)
    opaque[5, 5] = 254
    actual = seen(torch.cat([picture(), opaque], dim=2), points)
    assert actual == [0]


def test_points_behind_others_are_left_out():
    points = torch.cat(
        [point_at(4.5, 4.5, 2.0), point_at(4.51, 4.51, 2.05), point_at(4.5, 4.5, 4.0), point_at(2.5, 6.5, 4.0)]
    )
    indices, _ = observe_points(picture(), None, FACING, K, points)
    assert indices.tolist() == [0, 1, 3]


def test_gains_of_light_are_affine_maps_of_srgbs_values_but_the_darkest():
    values = np.linspace(0.1, 0.7, 30)
    for stops in (-1.0, -0.4, 0.3, 0.8):
        exact = srgb_values(linear_light(values) * 2**stops)
        image = torch.from_numpy(np.stack([values] * 3, axis=-1))
        mapped = apply_gains(image, srgb_gains(torch.full((3,), stops, dtype=torch.float64)))
        actual = mapped[:, 0].numpy()
        assert_allclose(actual, exact, atol=0.004)
    back = apply_gains(mapped, 1 / srgb_gains(torch.full((3,), stops, dtype=torch.float64)))
    assert_close(back, image)


def test_transparent_colours_change_as_much_as_they_cover():
    gains = srgb_gains(torch.tensor([1.0, 0.0, -1.0]))
    color = torch.tensor([[0.6, 0.4, 0.2]])
    alpha = torch.tensor([[0.25]])
    actual = apply_gains(alpha * color, gains, alpha)
    expected = alpha * apply_gains(color, gains)
    assert_close(actual, expected)
    assert not apply_gains(torch.zeros((1, 3)), gains, torch.zeros((1, 1))).any()
