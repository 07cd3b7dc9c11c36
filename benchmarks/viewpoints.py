"""Positions near the photos', where a viewer of the exported file may stand, and what it shows there.

A run draws Gaussians from its near plane on. A file has none, so that it may show haze where the run shows nothing.
Held-out views tell this of a few positions only.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import torch
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from sadgs_ns.gsplat_compat import NEAR_PLANE

POSITIONS = 200
"""Positions at which a run is compared with its file."""
POSITIONS_ON_CPU = 8
"""The same where drawing takes a second."""
REACH = 0.1
"""Largest distance of a position from a path between two cameras, as a share of the cameras' extent."""
NEIGHBOURS = 3
"""From each camera, paths lead to so many that are nearest to it."""
VISIBLE = 0.1
"""A pixel differs if any of its channels does so by more than this share of the full range."""


def between_cameras(
    camera_to_worlds: Tensor,  # [C, 3, 4]
    extent: float,
    count: int = POSITIONS,
    seed: int = 0,
) -> Iterator[tuple[int, Tensor]]:
    """Draw positions around and between cameras that look as one of the two does.

    Args:
        camera_to_worlds: Poses of C ≥ 1 cameras. [C, 3, 4]
        extent: The cameras' extent in world units, beyond which two have no path between them.
        count: Number of positions.
        seed: Of the random numbers.

    Yields:
        The index of a camera, and its pose at another position. [3, 4]
    """
    generator = torch.Generator().manual_seed(seed)
    poses = camera_to_worlds.cpu()
    centres = poses[:, :, 3]  # [C, 3]
    distances = torch.cdist(centres, centres)
    distances.fill_diagonal_(torch.inf)
    neighbours = min(NEIGHBOURS, len(poses) - 1)
    for _ in range(count):
        camera = int(torch.randint(len(poses), (1,), generator=generator))
        position = centres[camera]
        if neighbours > 0:
            nearest = distances[camera].topk(neighbours, largest=False)
            chosen = int(torch.randint(neighbours, (1,), generator=generator))
            along = torch.rand(1, generator=generator)
            if nearest.values[chosen] <= extent:
                position = torch.lerp(position, centres[nearest.indices[chosen]], along)
        pose = poses[camera].clone()
        pose[:, 3] = position + REACH * extent * _in_ball(generator)
        yield camera, pose


def _in_ball(generator: torch.Generator) -> Tensor:
    """Draw a point of the ball of radius 1, evenly. [3]"""
    direction = torch.randn(3, generator=generator)
    radius = torch.rand(1, generator=generator) ** (1 / 3)
    return radius * direction / direction.norm()


@torch.no_grad()
def pixels_that_differ(model: Any, cameras: Cameras) -> dict[str, float] | None:
    """Compare a run with its file at positions near the training cameras, without photos.

    Args:
        model: A model of this package in eval mode; of others there is nothing to compare.
        cameras: The training cameras.

    Returns:
        `mean` and `worst`, the share of pixels that differ by more than `VISIBLE`, over the positions; None for other
        models.
    """
    if not hasattr(model, "plan"):
        return None
    extent = float(model.strategy_state["scene_scale"])
    of_run = model.color_options()
    of_file = replace(of_run, near_plane=NEAR_PLANE, max_off_axis=0.0)
    count = POSITIONS
    if model.device.type == "cpu":
        count = POSITIONS_ON_CPU
    shares = []
    for index, pose in between_cameras(cameras.camera_to_worlds, extent, count):
        camera = cameras[index : index + 1].to(model.device)
        camera.camera_to_worlds = pose[None].to(model.device)
        pinhole = model.pinhole(camera)
        pictures = []
        for options in (of_run, of_file):
            colors, alphas, _ = model.render(pinhole, options)
            picture = model.before_background(colors, alphas, model.background)
            pictures.append(picture.clamp(0, 1))
        in_run, in_file = pictures
        differs = (in_run - in_file).abs().amax(dim=-1) > VISIBLE
        shares.append(differs.float().mean())
    all_shares = torch.stack(shares)
    return {"mean": float(all_shares.mean()), "worst": float(all_shares.max())}
