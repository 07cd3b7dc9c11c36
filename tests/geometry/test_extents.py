"""Which points and cameras count, and the extent of cameras."""

from __future__ import annotations

import pytest
import torch

from helpers.generators import seeded
from sadgs_ns.geometry.extents import camera_extent, plausible_points


def test_camera_extent_is_that_of_3dgs():
    positions = torch.tensor([[0.0, 0, 0], [2.0, 0, 0], [1.0, 0, 0]])
    assert camera_extent(positions) == pytest.approx(1.1)
    assert camera_extent(positions[:1]) == 1.0


@pytest.mark.hard_case("one wild camera", "does not count for the extent")
def test_one_wild_camera_does_not_decide_the_extent():
    positions = torch.rand((20, 3), generator=seeded(0))
    expected = camera_extent(positions)
    for far in (1e2, 1e6, 1e30, torch.inf, torch.nan):
        actual = camera_extent(torch.cat([positions, torch.full((1, 3), far)]))
        assert actual == expected


@pytest.mark.hard_case("one wild SfM point", "is left out and counted; all others stay")
@pytest.mark.parametrize("number", [4, 60, 2_000])
@pytest.mark.parametrize("far", [[1e5, 0, 0], [1e30, -1e30, 1e30], [torch.inf, 0, 0], [0, torch.nan, 0]])
def test_a_wild_point_is_not_plausible_and_all_others_are(number: int, far: list[float]):
    points = torch.rand((number, 3), generator=seeded(0))
    points[2] = torch.tensor(far)
    assert (~plausible_points(points)).nonzero().tolist() == [[2]]


@pytest.mark.hard_case("a sound cloud with a far background", "all points stay")
def test_a_sound_cloud_with_a_far_background_is_plausible():
    generator = seeded(0)
    near = torch.randn((1_000, 3), generator=generator)
    background = torch.randn((50, 3), generator=generator)
    assert plausible_points(torch.cat([near, 50 * background])).all()
    assert plausible_points(torch.zeros((9, 3))).all()
    assert plausible_points(torch.tensor([[0.0, 0, 0]] * 9 + [[5.0, 0, 0]])).all()  # most coincide
    assert len(plausible_points(torch.zeros((0, 3)))) == 0
