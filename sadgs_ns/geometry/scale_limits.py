"""How large Gaussians may be for their distance from the cameras.

EWA splatting is linear around a Gaussian's centre, which fails where it subtends a large angle. Training views may see
only the tail of a giant beside the field of view, while it covers every pixel of another view.
"""

from __future__ import annotations

import torch
from torch import Tensor

MANY_CAMERAS = 1024
"""From this many on, groups of cameras that are far from a Gaussian are ruled out first."""
_GROUP = 64
"""Cameras of a group; those that follow each other in the order of names are mostly neighbours."""
_PAIRS = 2**22
"""Distances from Gaussians to cameras that are computed at a time, in three arrays of 16 MB."""
_LEAST_LIMIT = 1e-7
"""A Gaussian around a camera's centre keeps this size in world units, so that its logarithm is finite."""


@torch.no_grad()
def limit_scales(
    scales: Tensor,  # [N, 3]
    means: Tensor,  # [N, 3]
    positions: Tensor,  # [C, 3]
    angular_scale: float,
) -> None:
    """Shorten, in place, the axes that are too long for the distance from the nearest of C > 0 cameras.

    `scales` are the parameters, logarithms of the standard deviations, and `angular_scale` > 0 is the largest standard
    deviation as a share of that distance. The host does not wait for the device, unless there are many cameras.
    """
    reach = scales.amax(dim=1).exp() / angular_scale  # No camera farther away than this limits a Gaussian. [N]
    distances = camera_distances(means, positions, reach)
    limits = angular_scale * distances  # [N]
    limits = limits.clamp_min(_LEAST_LIMIT)
    log_limits = limits.log()
    limited = torch.minimum(scales, log_limits[:, None])
    scales.copy_(limited)


def camera_distances(
    means: Tensor,  # [N, 3]
    positions: Tensor,  # [C, 3]
    reach: Tensor,  # [N]
) -> Tensor:
    """Return the distance of each point from the nearest camera, in world units. [N]

    With many cameras it is infinity for points that are farther away than their reach from the boxes around all groups.
    """
    if len(positions) < MANY_CAMERAS:
        return _distances(means, positions)
    firsts = torch.arange(0, len(positions), _GROUP)
    in_groups = firsts[:, None] + torch.arange(_GROUP)  # [C / _GROUP, _GROUP]
    in_groups = in_groups.clamp_max(len(positions) - 1)
    groups = positions[in_groups.to(positions.device)]
    from_boxes = _distances(means, groups.amin(dim=1), groups.amax(dim=1))
    is_near = from_boxes < 1.001 * reach
    near = is_near.nonzero()[:, 0]
    distances = torch.full_like(reach, torch.inf)
    distances[near] = _distances(means[near], positions)
    return distances


def _distances(means: Tensor, low: Tensor, high: Tensor | None = None) -> Tensor:
    """Distances of points [N, 3] from the nearest of boxes between corners [B, 3], or of places. [N]

    One axis is added at a time: matrix products cancel far from the origin, and without them `torch.cdist` is slow.
    """
    points_at_once = _PAIRS // len(low)
    points_at_once = max(points_at_once, 1)
    nearest = []
    for part in means.split(points_at_once):
        squares = part.new_zeros(())
        for k, x in enumerate(part.T[..., None]):  # [n, 1]
            if high is None:
                away = x - low[:, k]
            else:
                away = torch.maximum(low[:, k] - x, x - high[:, k]).clamp_min_(0)
            squares = away.square_() + squares  # [n, B]
        nearest.append(squares.amin(dim=1).sqrt())
    return torch.cat(nearest)
