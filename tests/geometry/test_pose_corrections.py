"""Corrections of poses: the exponential map, the motion of images in pixels, and the common motion of all cameras."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from helpers.closeness import assert_within, assert_within_share
from helpers.generators import seeded
from sadgs_ns.geometry import poses
from sadgs_ns.geometry.poses import Gauge

EPS32 = torch.finfo(torch.float32).eps
FOCAL = 400.0
SIZE = (320, 240)


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=seeded(seed), dtype=torch.float64)


def orbit(number: int = 12) -> Tensor:
    """Cameras on a circle that look at the origin, with a disturbance of each. [V, 4, 4]"""
    viewmats = torch.eye(4, dtype=torch.float64).repeat(number, 1, 1)
    angles = torch.linspace(0, 5, number, dtype=torch.float64)
    vectors = torch.stack([torch.zeros_like(angles), angles, torch.zeros_like(angles)], dim=1)
    viewmats[:, :3, :3] = poses.rotations(vectors + 0.1 * random(number, 3))
    viewmats[:, :3, 3] = torch.tensor([0.0, 0.0, 3.0]) + 0.2 * random(number, 3, seed=1)
    return viewmats


def intrinsics(number: int) -> Tensor:
    K = torch.tensor([[FOCAL, 0.0, SIZE[0] / 2], [0.0, FOCAL, SIZE[1] / 2], [0.0, 0.0, 1.0]], dtype=torch.float64)
    return K.repeat(number, 1, 1)


def motion_of(number: int) -> Tensor:
    sizes = torch.tensor([SIZE], dtype=torch.float64).expand(number, 2)
    depths = torch.tensor([[2.0, 3.0, 4.0]], dtype=torch.float64).expand(number, 3)
    return poses.image_motion(intrinsics(number), sizes, depths)


def matrix(rotation_vector: Tensor) -> Tensor:
    """Rotation by torch's general exponential of the antisymmetric matrix."""
    x, y, z = rotation_vector.tolist()
    return torch.matrix_exp(torch.tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]], dtype=torch.float64))


@pytest.mark.parametrize("length", [0.0, 1e-30, 1e-12, 1e-5, 1e-3, 0.1, 0.2236, 0.2237, 1.0, 3.0])
def test_the_exponential_map_and_its_gradient_are_exact_to_rounding_at_every_angle(length: float):
    vector = torch.nn.functional.normalize(torch.tensor([0.3, -0.7, 0.5], dtype=torch.float64), dim=0) * length
    actual = poses.rotations(vector)
    assert_within(actual, matrix(vector), 2e-15)
    upstream = random(3, 3, seed=2)

    def gradient(value: Tensor) -> Tensor:
        leaf = value.clone().requires_grad_()
        (poses.rotations(leaf) * upstream.to(value)).sum().backward()
        assert leaf.grad is not None
        return leaf.grad

    exact = vector.clone().requires_grad_()
    x, y, z = exact.unbind()
    zero = torch.zeros_like(x)
    generator = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).view(3, 3)
    (torch.matrix_exp(generator) * upstream).sum().backward()
    assert exact.grad is not None
    assert_within(gradient(vector), exact.grad, 1e-13)
    rounded = vector.float()
    actual = poses.rotations(rounded).double()
    expected = matrix(rounded.double())
    assert_within(actual, expected, 4 * EPS32)
    actual = gradient(rounded).double()
    expected = gradient(rounded.double())
    assert_within(actual, expected, 20 * EPS32)


def test_a_correction_moves_points_in_the_camera_s_frame():
    viewmats = orbit(4)
    corrections = 0.3 * random(4, 6, seed=3)
    points = random(10, 3, seed=4)
    found = poses.corrected(viewmats, corrections)
    assert torch.equal(found[:, 3], viewmats[:, 3])
    before = points @ viewmats[:, :3, :3].mT + viewmats[:, None, :3, 3]
    after = points @ found[:, :3, :3].mT + found[:, None, :3, 3]
    turned = torch.stack([matrix(row[:3]) for row in corrections])
    expected = before @ turned.mT + corrections[:, None, 3:]
    assert_within(after, expected, 1e-13)
    assert torch.equal(poses.corrected(viewmats, torch.zeros(4, 6, dtype=torch.float64)), viewmats)


def test_gradients_by_corrections_are_those_of_finite_differences():
    viewmats = orbit(3)
    corrections = torch.cat([0.2 * random(2, 6, seed=5), torch.zeros(1, 6, dtype=torch.float64)]).requires_grad_()
    assert torch.autograd.gradcheck(lambda rows: poses.corrected(viewmats, rows), corrections)


def test_image_motion_is_the_mean_square_of_how_far_pixels_move():
    corrections = 1e-6 * random(5, 6, seed=6)
    motion = motion_of(5)
    predicted = (corrections[:, None] @ motion @ corrections[..., None]).flatten().sqrt()
    steps = (torch.arange(5, dtype=torch.float64) + 0.5) / 5
    depths = torch.tensor([2.0, 3.0, 4.0], dtype=torch.float64)
    v, u, depth = torch.meshgrid(steps * SIZE[1], steps * SIZE[0], depths, indexing="ij")
    K = intrinsics(1)[0]
    pixels = torch.stack([u, v, torch.ones_like(u)], dim=-1).view(-1, 3)
    points = (pixels @ torch.linalg.inv(K).T) * depth.reshape(-1, 1)
    for row, expected in zip(corrections, predicted, strict=True):
        moved = (points @ matrix(row[:3]).T + row[3:]) @ K.T
        distance = (moved[:, :2] / moved[:, 2:] - pixels[:, :2]).square().sum(dim=1).mean().sqrt()
        assert float(distance) == pytest.approx(float(expected), rel=1e-4)
    one_pixel = poses.pixel_steps(motion)
    for column in range(6):
        row = torch.zeros(5, 6, dtype=torch.float64)
        row[:, column] = one_pixel[:, column]
        actual = (row[:, None] @ motion @ row[..., None]).flatten()
        assert_close(actual, torch.ones(5).double())


def test_depths_of_views_are_quartiles_of_the_points_in_their_images():
    viewmats = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    viewmats[2, :3, :3] = torch.diag(torch.tensor([-1.0, 1.0, -1.0]).double())  # sees nothing
    depths = torch.arange(1.0, 6.0, dtype=torch.float64)
    before = torch.stack([torch.zeros_like(depths), torch.zeros_like(depths), depths], dim=1)
    beside = torch.tensor([[50.0, 0.0, 9.0], [0.0, 0.0, 1e-9]], dtype=torch.float64)
    sizes = torch.tensor([SIZE], dtype=torch.float64).expand(3, 2)
    found = poses.view_depths(viewmats, intrinsics(3), sizes, torch.cat([before, beside]))
    expected = torch.tensor([[2.0, 3.0, 4.0]]).double().expand(3, 3)
    assert_close(found, expected)
    nothing = poses.view_depths(viewmats, intrinsics(3), sizes, before[:0])
    assert torch.equal(nothing, torch.ones_like(nothing))


def moved_together(viewmats: Tensor, turn: Tensor, shift: Tensor, scale: float) -> Tensor:
    """The corrections that turn, shift and scale all cameras about their mean centre. [V, 6]"""
    centres = -(viewmats[:, :3, :3].mT @ viewmats[:, :3, 3:])[..., 0]
    mean = centres.mean(dim=0)
    moved = mean + (1 + scale) * (centres - mean) @ matrix(turn).T + shift
    rotations = viewmats[:, :3, :3] @ matrix(turn).T
    difference = rotations @ viewmats[:, :3, :3].mT
    antisymmetric = difference - difference.mT
    sines = 0.5 * torch.stack([antisymmetric[:, 2, 1], antisymmetric[:, 0, 2], antisymmetric[:, 1, 0]], dim=1)
    length = sines.norm(dim=1, keepdim=True)
    vectors = sines * length.asin() / length
    translations = -(rotations @ moved[..., None])[..., 0] - (difference @ viewmats[:, :3, 3:])[..., 0]
    return torch.cat([vectors, translations], dim=1)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_common_motion_of_all_cameras_is_taken_out_to_rounding(dtype: torch.dtype):
    viewmats = orbit()
    gauge = Gauge.of(viewmats.to(dtype), motion_of(len(viewmats)).to(dtype))
    size = {torch.float32: 1e-5, torch.float64: 1e-8}[dtype]
    direction = random(7, seed=7)
    common = moved_together(viewmats, size * direction[:3], size * direction[3:6], size * float(direction[6]))
    actual = gauge.common_motion(common.to(dtype)).double()
    assert_within_share(actual, size * direction, 1e-4)
    table = common.to(dtype)
    gauge.take_out(table)
    # The square of the motion is below the rounding of corrections of a thousandth.
    assert float(table.abs().max()) < 20 * max(size * torch.finfo(dtype).eps, size**2)
    assert float(gauge.common_motion(table).abs().max()) < 20 * size * torch.finfo(dtype).eps


def test_what_cameras_do_not_have_in_common_is_kept():
    viewmats = orbit()
    gauge = Gauge.of(viewmats, motion_of(len(viewmats)))
    relative = 1e-3 * random(len(viewmats), 6, seed=8)
    gauge.take_out(relative)
    kept = relative.clone()
    gauge.take_out(kept)
    assert_within(kept, relative, 1e-17)
    common = moved_together(viewmats, *(1e-8 * random(2, 3, seed=9)), scale=1e-8)
    both = relative + common
    gauge.take_out(both)
    assert_within(both, relative, 1e-14)


def test_a_rotation_that_a_translation_undoes_in_the_images_is_no_common_motion():
    """Each camera turns about what it sees, each by another angle: no image moves much, and so no camera may follow."""
    viewmats = orbit()
    number = len(viewmats)
    gauge = Gauge.of(viewmats, motion_of(number))
    angles = 1e-3 * random(number, seed=10).abs()
    table = torch.zeros(number, 6, dtype=torch.float64)
    table[:, 1] = angles
    table[:, 3] = -3.0 * angles  # A point at depth 3 stays.
    before = table.clone()
    gauge.take_out(table)
    motion = motion_of(number)

    def pixels(rows: Tensor) -> float:
        return float((rows[:, None] @ motion @ rows[..., None]).mean().sqrt())

    assert pixels(table) <= pixels(before)
    assert pixels(table - before) <= pixels(before)


@pytest.mark.parametrize("number", [1, 2])
def test_few_cameras_have_a_gauge_too(number: int):
    viewmats = orbit(3)[:number]
    gauge = Gauge.of(viewmats, motion_of(number))
    table = 1e-3 * random(number, 6, seed=11)
    gauge.take_out(table)
    assert bool(table.isfinite().all())
    if number == 1:
        assert float(table.abs().max()) < 1e-9
