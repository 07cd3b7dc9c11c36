"""How near Gaussians may come to cameras."""

from __future__ import annotations

import math

import pytest
import torch
from torch.testing import assert_close

from helpers.closeness import assert_within
from helpers.generators import seeded
from helpers.gsplat_like import splatted
from sadgs_ns.geometry import scale_limits
from sadgs_ns.geometry.scale_limits import camera_distances, limit_scales


def test_points_are_clear_of_cameras_from_their_radius_on():
    means = torch.tensor([[0.0, 0, 0], [1, 0, 0], [5, 0, 0]])
    positions = torch.tensor([[0.0, 0, 2], [9, 0, 0]])
    radii = torch.tensor([2.0, 2.5, 3.0])
    actual = (camera_distances(means, positions, radii) >= radii).tolist()
    assert actual == [True, False, True]


@pytest.mark.hard_case("cameras and points far from the origin", "distances to cameras are exact")
@pytest.mark.parametrize("offset", [0.0, 1_000.0, 100_000.0])
def test_distances_to_cameras_are_exact_far_from_the_origin(offset: float):
    generator = seeded(0)
    means = torch.rand((5_000, 3), generator=generator) + offset
    positions = torch.rand((40, 3), generator=generator) + offset
    distances = (means.double()[:, None] - positions.double()).norm(dim=-1).amin(dim=1)  # [5000]
    radii = distances.float() * torch.where(torch.arange(5_000) % 2 == 0, 0.99, 1.01)
    assert torch.equal(camera_distances(means, positions, radii) >= radii, distances >= radii)


@pytest.mark.parametrize("offset", [0.0, 1_000.0])
def test_only_axes_that_are_too_long_for_the_distance_are_shortened(offset: float, monkeypatch: pytest.MonkeyPatch):
    generator = seeded(0)
    means = 10 * torch.rand((500, 3), generator=generator) + offset
    positions = 10 * torch.rand((7, 3), generator=generator) + offset
    scales = 3 * torch.randn((500, 3), generator=generator)
    distances = (means.double()[:, None] - positions.double()).norm(dim=-1).amin(dim=1)  # [500]
    expected = torch.minimum(scales.double(), (0.5 * distances).log()[:, None])
    assert 100 < int((expected < scales).sum()) < 1_000
    for pairs in (2**22, 700, 1):  # as many Gaussians at a time as there are, then 100, then one
        monkeypatch.setattr(scale_limits, "_PAIRS", pairs)
        limited = torch.nn.Parameter(scales.clone())
        limit_scales(limited, means, positions, 0.5)
        actual = limited.detach().double()
        assert_within(actual, expected, 1e-5)
        assert torch.equal(limited.detach()[expected == scales], scales[expected == scales])


@pytest.mark.hard_case("thousands of cameras", "only Gaussians near a group of them are compared with each camera")
@pytest.mark.parametrize("offset", [0.0, 1_000.0])
@pytest.mark.parametrize("number", [10, 43])
def test_many_cameras_limit_the_same_axes_to_the_same_length(
    number: int, offset: float, monkeypatch: pytest.MonkeyPatch
):
    generator = seeded(number)
    positions = torch.rand((number, 3), generator=generator).cumsum(dim=0) + offset
    means = positions[torch.arange(600) % number] + 5 * torch.randn((600, 3), generator=generator)
    scales = 2 * torch.randn((600, 3), generator=generator) - 1
    scales[0] = torch.inf
    scales[1] = torch.nan
    each = scales.clone()
    many = scales.clone()
    limit_scales(each, means, positions, 0.5)
    distances = camera_distances(means, positions, scales.amax(dim=1).exp())
    monkeypatch.setattr(scale_limits, "MANY_CAMERAS", 10)
    monkeypatch.setattr(scale_limits, "_GROUP", 4)
    limit_scales(many, means, positions, 0.5)
    assert_close(many, each, rtol=0, atol=0, equal_nan=True)
    radii = torch.rand(600, generator=generator) * 8
    found = camera_distances(means, positions, radii)
    assert torch.equal(found >= radii, distances >= radii)
    assert 100 < int(found.isfinite().sum()) < 500
    assert torch.equal(found[found.isfinite()], distances[found.isfinite()])


def test_a_gaussian_around_a_camera_keeps_a_finite_size():
    scales = torch.zeros((1, 3))
    limit_scales(scales, torch.ones((1, 3)), torch.ones((1, 3)), 0.5)
    assert scales.isfinite().all()
    assert (scales < -10).all()


@pytest.mark.hard_case(
    "a Gaussian many times longer than its distance from the cameras",
    "its axes are shortened (`max_angular_scale`), because its image, a linear approximation, can cover a view "
    "beside which it lies",
)
def test_a_giant_beside_the_view_covers_all_of_it_until_it_is_limited():
    # As on a capture of 30 photos: the camera looks along z, and the giant lies 30 units to its side, nearly in the
    # plane of its lens, with an axis that is ten times as long. Training views saw a little of its tail.
    means = torch.tensor([[30.0, 0.0, 0.85]])
    quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]])
    scales = torch.tensor([[324.0, 26.0, 1.6]]).log()
    K = torch.tensor([[[40.0, 0.0, 20.0], [0.0, 40.0, 15.0], [0.0, 0.0, 1.0]]])

    def opacity() -> torch.Tensor:
        _, alphas, _ = splatted(
            means, quats, scales.exp(), torch.tensor([0.97]), torch.ones((1, 3)), torch.eye(4)[None], K, 40, 30
        )
        return alphas

    assert opacity().min() > 0.5
    limit_scales(scales, means, torch.zeros((1, 3)), 0.3)
    # The camera is now 3.33 standard deviations away, and an edge of its image 3.27; gsplat 1.4 cuts off at 3.
    assert opacity().max() < 0.97 * math.exp(-(3.26**2) / 2)
