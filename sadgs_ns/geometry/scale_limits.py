"""How large Gaussians may be for their distance from the cameras.

EWA splatting is linear around a Gaussian's centre, which fails where it subtends a large angle. Training views may see
only the tail of a giant beside the field of view, while it covers every pixel of another view.
"""

from __future__ import annotations

import torch
from torch import Tensor

MANY_CAMERAS = 1024  # From this many on, groups of cameras that are far from a Gaussian are ruled out first
_GROUP = 64  # Cameras of a group; those that follow each other in the order of names are mostly neighbours
_PAIRS = 2**22  # Distances from Gaussians to cameras that are computed at a time, in three arrays of 16 MB
_LEAST_LIMIT = 1e-7  # World units. A Gaussian around a camera's centre keeps this size, so that its logarithm is finite


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
    reach = scales.amax(dim=1).exp() / angular_scale
    limits = (angular_scale * camera_distances(means, positions, reach)).clamp_min(_LEAST_LIMIT).log()  # [N]
    scales.copy_(torch.minimum(scales, limits[:, None]))


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
    in_groups = torch.arange(0, len(positions), _GROUP)[:, None] + torch.arange(_GROUP)  # [C / _GROUP, _GROUP]
    groups = positions[in_groups.clamp_max(len(positions) - 1).to(positions.device)]
    distances = torch.full_like(reach, torch.inf)
    near = (_distances(means, groups.amin(dim=1), groups.amax(dim=1)) < 1.001 * reach).nonzero()[:, 0]
    distances[near] = _distances(means[near], positions)
    return distances


def _distances(means: Tensor, low: Tensor, high: Tensor | None = None) -> Tensor:
    """Distances of points [N, 3] from the nearest of boxes between corners [B, 3], or of places. [N]

    One axis is added at a time: matrix products cancel far from the origin, and without them `torch.cdist` is slow.
    """
    nearest = []
    for part in means.split(max(_PAIRS // len(low), 1)):
        squares = part.new_zeros(())
        for k, x in enumerate(part.T[..., None]):  # [n, 1]
            away = x - low[:, k] if high is None else torch.maximum(low[:, k] - x, x - high[:, k]).clamp_min_(0)
            squares = away.square_() + squares  # [n, B]
        nearest.append(squares.amin(dim=1).sqrt())
    return torch.cat(nearest)
