"""Positions of cameras and inverses of rigid matrices, beside the general inverse."""

import torch
from torch.testing import assert_close

from sadgs_ns.geometry.rigid import camera_centres, inverse_rigid


def _viewmats() -> torch.Tensor:
    """Return rigid matrices of random rotations and translations. float64 [5, 4, 4]"""
    generator = torch.Generator().manual_seed(0)
    rotations, _ = torch.linalg.qr(torch.randn(5, 3, 3, generator=generator, dtype=torch.float64))
    viewmats = torch.eye(4, dtype=torch.float64).repeat(5, 1, 1)
    viewmats[:, :3, :3] = rotations
    viewmats[:, :3, 3] = torch.randn(5, 3, generator=generator, dtype=torch.float64)
    return viewmats


def test_inverse_is_that_of_a_general_matrix() -> None:
    viewmats = _viewmats()
    assert_close(inverse_rigid(viewmats), viewmats.inverse(), rtol=1e-12, atol=1e-12)


def test_a_camera_lies_in_its_own_origin() -> None:
    viewmats = _viewmats()
    centres = camera_centres(viewmats)
    in_camera = viewmats[:, :3, :3] @ centres[..., None] + viewmats[:, :3, 3:]
    assert_close(in_camera, torch.zeros_like(in_camera), rtol=0, atol=1e-12)


def test_no_cameras_have_no_centres() -> None:
    assert inverse_rigid(torch.empty(0, 4, 4)).shape == (0, 4, 4)
    assert camera_centres(torch.empty(0, 4, 4)).shape == (0, 3)
