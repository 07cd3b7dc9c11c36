"""The depth from which a scene is drawn: it follows what the cameras come nearest to, whatever else is there."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from sadgs_ns.method import near_plane
from sadgs_ns.method.near_plane import NEAR_SHARE, NEAREST_POINTS, UNKNOWN_SHARE, EmptySpace
from sadgs_ns.render.rasterization import rasterize

EXTENT = 7.0


def scene_near_plane(points: Tensor, viewmats: Tensor, Ks: Tensor, sizes: Tensor, extent: float = EXTENT) -> float:
    return near_plane.scene_near_plane(near_plane.nearest_depths(points, viewmats, Ks, sizes), extent)


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
    assert scene_near_plane(wall(8.0), *row_of_cameras()) == pytest.approx(8.0 * NEAR_SHARE)


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
    assert scene_near_plane(points, *row_of_cameras()) == pytest.approx(8.0 * NEAR_SHARE)


def test_points_behind_and_beside_the_cameras_do_not_count():
    behind, beside = wall(-0.1), wall(0.2, middle=-9.0, width=2.0)
    points = torch.cat([behind, beside, wall(8.0)])
    assert scene_near_plane(points, *row_of_cameras()) == pytest.approx(8.0 * NEAR_SHARE)


@pytest.mark.parametrize(
    "points",
    [torch.zeros(0, 3), wall(8.0)[:3], wall(-8.0)],
    ids=["none", "few", "behind"],
)
def test_where_no_camera_sees_enough_points_the_cameras_extent_decides(points: Tensor):
    assert scene_near_plane(points, *row_of_cameras()) == pytest.approx(UNKNOWN_SHARE * EXTENT)


def test_turned_cameras_measure_along_their_own_axes():
    """Cameras around a ball of points: the nearest of them lie a radius before its middle."""
    directions = torch.nn.functional.normalize(torch.randn(20, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    points = torch.nn.functional.normalize(torch.randn(4000, 3, generator=torch.Generator().manual_seed(1)), dim=1)
    _, Ks, sizes = row_of_cameras(20)
    viewmats = looking_at_the_origin(4.0 * directions)
    assert scene_near_plane(points, viewmats, Ks, sizes) == pytest.approx(3.0 * NEAR_SHARE, rel=0.01)


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
    scales, opacities = torch.tensor([[2.0] * 3, [0.1] * 3]), torch.tensor([0.9, 0.3])
    colors = torch.tensor([[0.2, 0.4, 0.6], [1.0, 1.0, 1.0]])
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(2, 1)

    def draw(count: int, near_plane: float) -> Tensor:
        rows = [value[:count] for value in (means, quats, scales, opacities, colors)]
        return rasterize(rows[0], rows[1], rows[2], rows[3], rows[4], viewmats, Ks, 100, 100, near_plane=near_plane)[0]

    clean = draw(1, 0.01)
    assert (draw(2, 0.01) - clean).abs().mean() > 0.1
    torch.testing.assert_close(draw(2, 4.0), clean)


def holds(space: EmptySpace, means: Tensor) -> Tensor:
    """Which Gaussians are haze before its poses if they are large. bool [N]"""
    return space.haze(means, torch.full_like(means, 1e3))


def empty_space(points: Tensor, viewmats: Tensor, Ks: Tensor, sizes: Tensor) -> EmptySpace:
    return EmptySpace.of(points, viewmats, Ks, sizes, scene_near_plane(points, viewmats, Ks, sizes))


def test_poses_lie_on_the_path_and_look_where_their_neighbours_look():
    centres = torch.tensor([[4.0, 0, 0], [0, 4, 0], [-4, 0, 0], [0, -4, 0]])
    viewmats = torch.cat([looking_at_the_origin(centres), looking_at_the_origin(1.01 * centres[:1])])
    poses, ends, paths = near_plane.poses_of_path(viewmats, spacing=1.5)
    # No two of the four look in similar directions; the first and the fifth are nearer than the spacing.
    assert torch.equal(poses, viewmats) and ends.tolist() == [0, 1, 2, 3, 4] and (paths == -1).all()
    angles = torch.deg2rad(torch.arange(0, 181, 30).float())
    arc = looking_at_the_origin(4 * torch.stack([angles.cos(), angles.sin(), 0 * angles], dim=1))
    poses, ends, paths = near_plane.poses_of_path(arc, spacing=1.1)
    added = poses[7:]
    rotations = added[:, :3, :3]
    torch.testing.assert_close(rotations @ rotations.mT, torch.eye(3).expand_as(rotations), atol=1e-5, rtol=0)
    positions = -(rotations.mT @ added[:, :3, 3:])[..., 0]
    assert len(added) > 0 and (positions.norm(dim=1) < 4).all() and (positions.norm(dim=1) > 3.4).all()
    towards = torch.nn.functional.cosine_similarity(rotations[:, 2], -positions)
    assert (towards > 0.97).all(), "a pose between two that look at the origin should look there, too"
    assert (ends[7:] < 7).all() and (paths[7:] >= 0).all()


def test_gaussians_before_the_cameras_and_between_them_are_in_the_empty_space_and_surfaces_are_not():
    cameras, points = row_of_cameras(), wall(8.0)  # 2 apart; the plane is at 4, and poses are 1 apart
    space = empty_space(points, *cameras)
    assert not holds(space, points).any()
    x = torch.linspace(0, 10, 41)
    before = torch.stack([x, 0 * x, torch.full_like(x, 1.1)], dim=1)
    assert holds(space, before).all()
    assert not holds(space, before - torch.tensor([0.0, 0, 2])).any(), "behind the cameras nothing is known"
    assert not holds(space, before + torch.tensor([0.0, 30, 0])).any(), "nor beside them"
    assert not holds(space, before + torch.tensor([0.0, 0, 4.0])).any(), "nor beyond the plane"


@pytest.mark.hard_case(
    "a wall that begins at an image's border",
    "is not in the empty space before the cameras, whose large Gaussians files leave out",
)
def test_a_wall_that_begins_at_the_image_s_border_is_not_in_the_empty_space():
    """A corridor along z: the nearest that a camera sees of its walls is where they enter its image."""
    y, z = torch.meshgrid(torch.linspace(-0.3, 0.3, 15), torch.linspace(0, 20, 400), indexing="ij")
    side = torch.stack([torch.full_like(y, 1.0), y, z], dim=-1).reshape(-1, 3)
    walls = torch.cat([side, side * torch.tensor([-1.0, 1, 1])])
    viewmats = torch.eye(4).repeat(8, 1, 1)
    viewmats[:, 2, 3] = -torch.arange(8)
    _, Ks, sizes = row_of_cameras(8)
    space = empty_space(walls, viewmats, Ks, sizes)
    assert 0.9 < space.near < 1.2
    assert not holds(space, walls).any()
    middle = torch.tensor([[0.0, 0.0, 3.2], [0.1, 0.1, 5.6]])
    assert holds(space, middle).all()


@pytest.mark.hard_case(
    "a wall between two rooms with cameras on both sides", "is not in the empty space before the cameras"
)
def test_a_wall_between_two_rooms_is_not_in_the_empty_space():
    """Cameras on both sides of a wall look the same way: the path between them leads through the wall."""
    points = torch.cat([wall(3.0, middle=0.0), wall(14.0, middle=0.0)])
    viewmats = torch.eye(4).repeat(2, 1, 1)
    viewmats[1, 2, 3] = -6.0
    _, Ks, sizes = row_of_cameras(2)
    space = empty_space(points, viewmats, Ks, sizes)
    assert len(space.viewmats) == 2, "the path through the wall should be left out"
    assert not holds(space, points).any()
    assert holds(space, torch.tensor([[0.0, 0.0, 0.5], [0.0, 0.0, 6.5]])).all()


@pytest.mark.parametrize("number", [0, 1])
def test_without_points_or_with_one_camera_there_is_a_space_all_the_same(number: int):
    viewmats, Ks, sizes = row_of_cameras(1)
    space = empty_space(wall(8.0) if number else torch.zeros(0, 3), viewmats, Ks, sizes)
    assert space.near == pytest.approx(4.0 if number else UNKNOWN_SHARE * EXTENT) and len(space.viewmats) == 1


def test_gaussians_that_look_small_from_the_cameras_are_no_haze():
    space = empty_space(wall(8.0), *row_of_cameras())
    before = torch.tensor([[4.0, 0.1, 1.5]]).repeat(4, 1)
    scales = torch.tensor([[0.01, 0.4, 0.01], [0.1, 0.1, 0.1], [0.4, 0.4, 0.4], [torch.nan] * 3])
    assert space.haze(before, scales).tolist() == [True, False, True, False]
