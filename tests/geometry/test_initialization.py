"""Initial Gaussians."""

from __future__ import annotations

import math

import pytest
import torch
from torch.testing import assert_close

from helpers.generators import seeded
from sadgs_ns.geometry.initialization import (
    FACE_GRID,
    bounding_box_points,
    face_grid,
    most_starting_points,
    neighbour_scales,
    starting_points,
)


def test_points_lie_on_the_six_faces():
    points = torch.tensor([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0], [0.5, 0.5, 0.5]])
    faces, spacing = bounding_box_points(points, grid=4)
    assert faces.shape == (6 * 16, 3)
    high = torch.tensor([1.0, 2.0, 3.0])
    on_face = (faces == 0) | (faces == high)
    assert (on_face.sum(1) == 1).all()
    assert on_face.sum(0).tolist() == [32, 32, 32]
    assert (faces >= 0).all()
    assert (faces <= high).all()
    assert spacing == pytest.approx(2.0 / 4)


def test_scales_are_the_mean_distance_to_three_neighbours():
    points = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [0, 2.0, 0], [0, 0, 3.0], [50.0, 50.0, 50.0]])
    assert float(neighbour_scales(points)[0]) == pytest.approx(2.0)


def test_scales_of_a_cloud_are_those_of_all_distances():
    points = torch.rand((500, 3), generator=seeded(0))
    points[100:110] = points[200]  # duplicates are at distance 0
    distances = torch.cdist(points.double(), points.double(), compute_mode="donot_use_mm_for_euclid_dist")
    expected = distances.sort(dim=1).values[:, 1:4].mean(dim=1).float().clamp_min(1e-6)
    assert_close(neighbour_scales(points), expected, rtol=1e-5, atol=2e-6)


@pytest.mark.parametrize("points", [[[0.0, 0, 0]], [[0.0, 0, 0]] * 5, [[0.0, 0, 0], [1.0, 0, 0]]])
def test_few_or_equal_points_have_finite_log_scales(points: list[list[float]]):
    scales = neighbour_scales(torch.tensor(points))
    assert scales.log().isfinite().all()


def test_points_come_first_and_the_faces_faint_grey_and_a_cell_large_after_them():
    points, colors = torch.rand((2, 20, 3), generator=seeded(0))
    alone = starting_points(points, colors, faces=False)
    assert alone[0] is points
    assert alone[1] is colors
    assert (alone[3] == 0.1).all()
    assert_close(alone[2], neighbour_scales(points))
    faces, spacing = bounding_box_points(points)
    for value, before, added in zip(
        starting_points(points, colors, faces=True), alone, (faces, 0.5, spacing, 0.05), strict=True
    ):
        assert torch.equal(value[:20], before)
        assert len(value) == 20 + len(faces)
        expected = torch.as_tensor(added).expand_as(value[20:])
        assert_close(value[20:], expected)


def test_images_of_few_pixels_bound_the_start_and_usual_ones_do_not():
    lund_small = 29 * 320 * 240
    usual = 5 * 1600 * 1200
    assert most_starting_points(lund_small, 0.02) == 44_544
    assert face_grid(lund_small, 0.02) == 8
    assert face_grid(24 * 124 * 93, 0.02) == 3
    assert face_grid(usual, 0.02) == face_grid(10**9, 0.02) == FACE_GRID
    assert most_starting_points(10 * 48 * 36, 0.02) == 1000
    assert face_grid(10 * 48 * 36, 0.02) == 2, "the least"
    assert most_starting_points(1, 0.0) == math.inf
    assert face_grid(1, 0.0) == FACE_GRID, "no limit"


def test_coarser_faces_have_larger_points():
    points = torch.rand((20, 3), generator=seeded(0))
    colors = torch.zeros_like(points)
    fine = starting_points(points, colors, faces=True)
    coarse = starting_points(points, colors, faces=True, grid=4)
    assert len(fine[0]) == 20 + 6 * 16**2
    assert len(coarse[0]) == 20 + 6 * 4**2
    actual = coarse[2][-1]
    expected = 4 * fine[2][-1]
    assert_close(actual, expected)
