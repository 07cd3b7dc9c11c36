"""Initial Gaussians."""

from __future__ import annotations

import pytest
import torch

from sadgs_ns.geometry.initialization import bounding_box_points, neighbour_scales, starting_points


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


def test_points_come_first_and_the_faces_faint_grey_and_a_cell_large_after_them():
    points, colors = torch.rand((2, 20, 3), generator=torch.Generator().manual_seed(0))
    alone = starting_points(points, colors, faces=False)
    assert alone[0] is points and alone[1] is colors and (alone[3] == 0.1).all()
    torch.testing.assert_close(alone[2], neighbour_scales(points))
    faces, spacing = bounding_box_points(points)
    for value, before, added in zip(
        starting_points(points, colors, faces=True), alone, (faces, 0.5, spacing, 0.05), strict=True
    ):
        assert torch.equal(value[:20], before) and len(value) == 20 + len(faces)
        torch.testing.assert_close(value[20:], torch.as_tensor(added).expand_as(value[20:]))
