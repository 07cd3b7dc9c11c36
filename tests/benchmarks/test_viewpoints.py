"""Positions near the photos', and what a run and its file show there."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from torch import Tensor

from benchmarks import viewpoints
from sadgs_ns.gsplat_compat import NEAR_PLANE
from sadgs_ns.render.types import RenderOptions

POSES = torch.eye(3, 4).repeat(3, 1, 1)
POSES[:, 0, 3] = torch.tensor([0.0, 1.0, 9.0])


class ModelWithHaze:
    """Draws a white pixel in four where the near plane is that of files."""

    plan = None
    device = torch.device("cpu")
    background = torch.zeros(3)
    strategy_state = {"scene_scale": 2.0}  # noqa: RUF012

    def color_options(self) -> RenderOptions:
        return RenderOptions(near_plane=0.5, max_off_axis=4.0)

    def pinhole(self, camera: Cameras) -> Any:
        return SimpleNamespace(centre=camera.camera_to_worlds[0, :, 3])

    def render(self, camera: Any, options: RenderOptions) -> tuple[Tensor, Tensor, dict[str, Any]]:
        picture = torch.zeros(1, 2, 2, 3)
        if options.near_plane == NEAR_PLANE and options.max_off_axis == 0:
            picture[:, 0, 0] = 1
        return picture, torch.ones(1, 2, 2, 1), {}

    def before_background(self, colors: Tensor, alphas: Tensor, background: Tensor) -> Tensor:
        return colors


def test_positions_lie_around_paths_to_neighbours_that_are_not_too_far():
    positions = list(viewpoints.between_cameras(POSES, extent=2.0, count=200))
    assert len(positions) == 200
    alone = [pose[:, 3] for index, pose in positions if index == 2]
    assert max(float((place - POSES[2, :, 3]).norm()) for place in alone) <= 0.2
    along = torch.stack([pose[:, 3] for index, pose in positions if index < 2])
    assert along[:, 0].min() >= -0.2
    assert along[:, 0].max() <= 1.2
    assert along[:, 0].std() > 0.2
    for _, pose in positions:
        assert torch.equal(pose[:, :3], torch.eye(3))


def test_a_single_camera_has_positions_around_it():
    for index, pose in viewpoints.between_cameras(POSES[:1], extent=1.0, count=20):
        assert index == 0
        assert pose[:, 3].norm() <= 0.1


def test_pixels_that_only_the_file_shows_are_counted():
    cameras = Cameras(POSES, 1.0, 1.0, 1.0, 1.0, 2, 2, camera_type=CameraType.PERSPECTIVE)
    differing = viewpoints.pixels_that_differ(ModelWithHaze(), cameras)
    assert differing == {"mean": pytest.approx(0.25), "worst": pytest.approx(0.25)}
    assert viewpoints.pixels_that_differ(SimpleNamespace(), cameras) is None
