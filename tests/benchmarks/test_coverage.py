"""Angles between held-out and training views, of geometry with known answers."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from benchmarks.coverage import MAX_POINTS, Views, nearest_angles, thinned
from helpers.closeness import assert_within
from helpers.small_scenes import camera

DEPTH = 4.0
"""Distance of the points that all cameras look at."""


def looking(*poses: tuple[float, float]) -> Views:
    """Cameras that are turned around the point (0, 0, DEPTH) by an angle about y in degrees, then moved aside."""
    viewmats, K = camera()
    viewmats = viewmats.repeat(len(poses), 1, 1)
    for viewmat, (degrees, aside) in zip(viewmats, poses, strict=True):
        angle = torch.tensor(degrees).deg2rad()
        centre = torch.tensor([0.0, 0.0, DEPTH])
        viewmat[0, 0] = viewmat[2, 2] = angle.cos()
        viewmat[0, 2] = angle.sin()
        viewmat[2, 0] = -angle.sin()
        viewmat[:3, 3] = centre - viewmat[:3, :3] @ centre - torch.tensor([aside, 0.0, 0.0])
    return Views(viewmats, K.expand(len(poses), 3, 3), torch.tensor([[64, 48]]).expand(len(poses), 2))


HERE = looking((0.0, 0.0))


def square(depth: float = DEPTH, reach: float = 0.05) -> Tensor:
    """25 points before the camera at the origin. [25, 3]"""
    steps = torch.linspace(-reach, reach, 5)
    return torch.nn.functional.pad(torch.cartesian_prod(steps, steps), (0, 1), value=depth)


def test_the_angle_is_that_to_the_nearest_training_view_that_shares_points():
    # The training view of 2 degrees looks elsewhere.
    training = looking((20.0, 0.0), (-7.0, 0.0), (90.0, 0.0), (2.0, 50.0))
    angles = nearest_angles(looking((0.0, 0.0), (30.0, 0.0)), training, square())
    expected = torch.tensor([7.0, 10.0])
    assert_within(angles, expected, 0.05)
    assert nearest_angles(HERE, HERE, square()).item() == 0
    actual = nearest_angles(HERE, looking((180.0, 0.0)), square()).item()
    expected = pytest.approx(180, abs=2)
    assert actual == expected


def test_views_that_share_too_few_points_have_no_angle():
    few = square()[:9]
    behind = square(-DEPTH)
    for points in (few, behind, torch.cat([few, behind]), square(reach=100), torch.empty(0, 3)):
        assert nearest_angles(HERE, looking((5.0, 0.0)), points).isnan().all()


def test_finite_points_are_thinned_evenly():
    points = torch.arange(3.0 * (4 * MAX_POINTS + 1)).view(-1, 3)
    points[1] = torch.inf
    finite = points[points.isfinite().all(dim=-1)]
    assert torch.equal(thinned(points[:9]), finite[:8])
    assert torch.equal(thinned(points), finite[::4])
