"""The depth from which a scene is drawn: it follows what the cameras come nearest to, whatever else is there."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from helpers.generators import seeded
from sadgs_ns.geometry import near_plane
from sadgs_ns.geometry.near_plane import NEAR_SHARE, NEAREST_POINTS, UNKNOWN_SHARE
from sadgs_ns.render.rasterization import rasterize
from sadgs_ns.render.types import Cameras, Gaussians, RenderOptions

EXTENT = 7.0


def scene_near_plane(points: Tensor, viewmats: Tensor, Ks: Tensor, sizes: Tensor, extent: float = EXTENT) -> float:
    return near_plane.scene_near_plane(points, viewmats, Ks, sizes, extent)


def row_of_cameras(number: int = 6) -> tuple[Tensor, Tensor, Tensor]:
    """Cameras in a row that look along z, 2 apart, with a field of view of 53° by 53°: viewmats, Ks and sizes."""
    viewmats = torch.eye(4).repeat(number, 1, 1)
    viewmats[:, 0, 3] = -2.0 * torch.arange(number)
    Ks = torch.tensor([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]]).repeat(number, 1, 1)
    return viewmats, Ks, torch.full((number, 2), 100)


def wall(depth: float, middle: float = 5.0, width: float = 14.0, number: int = 40) -> Tensor:
    """A grid of points on a plane across the axes of the cameras. [number², 3]"""
    x, y = torch.meshgrid(torch.linspace(-0.5, 0.5, number), torch.linspace(-0.5, 0.5, number), indexing="ij")
    return torch.stack([middle + width * x, width * y, torch.full_like(x, depth)], dim=-1).reshape(-1, 3)


def test_the_plane_is_a_share_of_the_depth_of_what_is_nearest():
    actual = scene_near_plane(wall(8.0), *row_of_cameras())
    assert actual == pytest.approx(8.0 * NEAR_SHARE)


@pytest.mark.hard_case("a scene in other units", "the near plane scales with the units")
@pytest.mark.parametrize("factor", [1e-3, 1e4])
def test_a_scene_in_other_units_has_the_same_plane_in_them(factor: float):
    viewmats, Ks, sizes = row_of_cameras()
    viewmats[:, :3, 3] *= factor
    found = scene_near_plane(factor * wall(8.0), viewmats, Ks, sizes, factor * EXTENT)
    assert found == pytest.approx(factor * 8.0 * NEAR_SHARE, rel=1e-5)


@pytest.mark.hard_case("a leaf close to one camera of many", "the near plane lies before the leaf")
def test_a_leaf_before_a_single_camera_keeps_the_plane_before_it():
    leaf = torch.tensor([4.0, 0.0, 0.3]) + 0.02 * wall(0.0, middle=0.0, width=1.0, number=3)
    found = scene_near_plane(torch.cat([wall(8.0), leaf]), *row_of_cameras())
    assert found == pytest.approx(0.3 * NEAR_SHARE)


@pytest.mark.hard_case("macro photos", "the near plane lies before the object")
def test_macro_photos_have_a_plane_before_their_object():
    """Cameras half a unit from a coin, in front of a table that is a hundred times as far."""
    coin = wall(0.5, width=0.1, number=10)
    found = scene_near_plane(torch.cat([coin + torch.tensor([-1.0, 0, 0]), wall(50.0)]), *row_of_cameras())
    assert found == pytest.approx(0.5 * NEAR_SHARE)


@pytest.mark.hard_case("up to four wrong SfM points before a camera", "do not move the near plane")
def test_a_few_wrong_points_before_a_camera_do_not_move_the_plane():
    wrong = torch.tensor([[2.0, 0.0, 1e-3]]).repeat(NEAREST_POINTS - 1, 1)
    broken = torch.tensor([[torch.nan, 0, 1], [2, 0, torch.inf]])
    points = torch.cat([wrong, broken, wall(8.0)])
    actual = scene_near_plane(points, *row_of_cameras())
    assert actual == pytest.approx(8.0 * NEAR_SHARE)


def test_points_behind_and_beside_the_cameras_do_not_count():
    behind = wall(-0.1)
    beside = wall(0.2, middle=-9.0, width=2.0)
    points = torch.cat([behind, beside, wall(8.0)])
    actual = scene_near_plane(points, *row_of_cameras())
    assert actual == pytest.approx(8.0 * NEAR_SHARE)


@pytest.mark.parametrize(
    "points",
    [torch.zeros(0, 3), wall(8.0)[:3], wall(-8.0)],
    ids=["none", "few", "behind"],
)
def test_where_no_camera_sees_enough_points_the_cameras_extent_decides(points: Tensor):
    actual = scene_near_plane(points, *row_of_cameras())
    assert actual == pytest.approx(UNKNOWN_SHARE * EXTENT)


def test_turned_cameras_measure_along_their_own_axes():
    """Cameras around a ball of points: the nearest of them lie a radius before its middle."""
    directions = torch.nn.functional.normalize(torch.randn(20, 3, generator=seeded(0)), dim=1)
    points = torch.nn.functional.normalize(torch.randn(4000, 3, generator=seeded(1)), dim=1)
    _, Ks, sizes = row_of_cameras(20)
    viewmats = looking_at_the_origin(4.0 * directions)
    actual = scene_near_plane(points, viewmats, Ks, sizes)
    assert actual == pytest.approx(3.0 * NEAR_SHARE, rel=0.01)


def looking_at_the_origin(centres: Tensor) -> Tensor:
    """World to camera of cameras that look at the origin. [C, 3] → [C, 4, 4]"""
    forward = torch.nn.functional.normalize(-centres, dim=1)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, torch.tensor([[0.3, 0.5, 0.8]])), dim=1)
    rotations = torch.stack([right, torch.linalg.cross(forward, right), forward], dim=1)  # [C, 3, 3]
    viewmats = torch.eye(4).repeat(len(centres), 1, 1)
    viewmats[:, :3, :3] = rotations
    viewmats[:, :3, 3] = -(rotations @ centres[..., None])[..., 0]
    return viewmats


@pytest.mark.hard_case(
    "a faint Gaussian just before a camera, between the training cameras",
    "haze over the image with a near plane of .01; nothing with the scene's",
)
def test_a_faint_gaussian_before_a_camera_is_haze_without_the_plane_and_nothing_with_it():
    viewmats, Ks, _ = row_of_cameras(1)
    means = torch.tensor([[0.0, 0, 8], [0, 0, 0.1]])
    scales = torch.tensor([[2.0] * 3, [0.1] * 3])
    opacities = torch.tensor([0.9, 0.3])
    colors = torch.tensor([[0.2, 0.4, 0.6], [1.0, 1.0, 1.0]])
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(2, 1)

    def draw(count: int, near_plane: float) -> Tensor:
        rows = [value[:count] for value in (means, quats, scales, opacities, colors)]
        cameras = Cameras(viewmats, Ks, 100, 100)
        return rasterize(Gaussians(*rows), cameras, RenderOptions(near_plane=near_plane))[0]

    clean = draw(1, 0.01)
    assert (draw(2, 0.01) - clean).abs().mean() > 0.1
    actual = draw(2, 4.0)
    assert_close(actual, clean)
