"""How near Gaussians may come to cameras, for their size.

EWA splatting is linear around a Gaussian's centre, which fails where it subtends a large angle. Training views may see
only the tail of a giant beside the field of view, while it covers every pixel of another view.
"""

from __future__ import annotations

import torch
from torch import Tensor

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
    deviation as a share of that distance. The host does not wait for the device.
    """
    limits = (angular_scale * camera_distances(means, positions)).clamp_min(_LEAST_LIMIT).log()  # [N]
    scales.copy_(torch.minimum(scales, limits[:, None]))


def camera_distances(
    means: Tensor,  # [N, 3]
    positions: Tensor,  # [C, 3]
) -> Tensor:
    """Return the distance of each point from the nearest camera, in world units. [N]

    One axis is added at a time: matrix products cancel far from the origin, and without them `torch.cdist` is slow.
    """
    nearest = []
    for part in means.split(max(_PAIRS // len(positions), 1)):
        squares = part.new_zeros(())
        for x, camera in zip(part.unbind(1), positions.unbind(1), strict=True):
            squares = (x[:, None] - camera).square_() + squares  # [n, C]
        nearest.append(squares.amin(dim=1).sqrt())
    return torch.cat(nearest)
