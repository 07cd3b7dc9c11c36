"""Initial Gaussians."""

from __future__ import annotations

import pytest
import torch

from sadgs_ns.initialization import bounding_box_points, camera_extent, neighbour_scales


def test_points_lie_on_the_six_faces():
    points = torch.tensor([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0], [0.5, 0.5, 0.5]])
    faces, spacing = bounding_box_points(points, grid=4)
    assert faces.shape == (6 * 16, 3)
    high = torch.tensor([1.0, 2.0, 3.0])
    on_face = (faces == 0) | (faces == high)
    assert (on_face.sum(1) == 1).all() and on_face.sum(0).tolist() == [32, 32, 32]
    assert (faces >= 0).all() and (faces <= high).all()
    assert spacing == pytest.approx(2.0 / 4)


def test_scales_are_the_mean_distance_to_three_neighbours():
    points = torch.tensor([[0.0, 0, 0], [1.0, 0, 0], [0, 2.0, 0], [0, 0, 3.0], [50.0, 50.0, 50.0]])
    assert float(neighbour_scales(points)[0]) == pytest.approx(2.0)


def test_scales_of_a_cloud_are_those_of_all_distances():
    points = torch.rand((500, 3), generator=torch.Generator().manual_seed(0))
    points[100:110] = points[200]  # duplicates are at distance 0
    distances = torch.cdist(points.double(), points.double(), compute_mode="donot_use_mm_for_euclid_dist")
    expected = distances.sort(dim=1).values[:, 1:4].mean(dim=1).float().clamp_min(1e-6)
    torch.testing.assert_close(neighbour_scales(points), expected, rtol=1e-5, atol=2e-6)


@pytest.mark.parametrize("points", [[[0.0, 0, 0]], [[0.0, 0, 0]] * 5, [[0.0, 0, 0], [1.0, 0, 0]]])
def test_few_or_equal_points_have_finite_log_scales(points: list[list[float]]):
    scales = neighbour_scales(torch.tensor(points))
    assert scales.log().isfinite().all()


def test_camera_extent_is_that_of_3dgs():
    positions = torch.tensor([[0.0, 0, 0], [2.0, 0, 0], [1.0, 0, 0]])
    assert camera_extent(positions) == pytest.approx(1.1)
    assert camera_extent(positions[:1]) == 1.0
