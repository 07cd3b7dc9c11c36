"""Find the Gaussians that lie too far off a view's axis to be drawn.

EWA splatting is linear around a Gaussian's centre. Far off the axis that is wrong: a Gaussian beside the camera, which
is not in sight, covers the image with haze. Viewers on the web leave out those 1.2 to 3 half images off the centre, and
runs of version 1.0.0 those 4 off; gsplat draws all.
"""

from __future__ import annotations

import torch
from torch import Tensor

from sadgs_ns.gsplat_compat import has_radius_per_axis


@torch.no_grad()
def cull_off_axis(radii: Tensor, means2d: Tensor, width: int, height: int, max_off_axis: float) -> Tensor:
    """Return the radii of `Projected`, but 0 where Gaussians are too far off the axis or their centre is not finite.

    `max_off_axis` > 0 is the largest distance from the image's centre, in halves of its width and height along x and y.
    """
    # Numbers, not a tensor of them, which the host would have to send to the device.
    x, y = means2d.unbind(dim=-1)
    half_width = width / 2
    half_height = height / 2
    is_near = (x - half_width).abs() < max_off_axis * half_width
    is_near &= (y - half_height).abs() < max_off_axis * half_height  # [C, N]
    if has_radius_per_axis(radii, means2d):
        is_near = is_near[..., None]
    return radii * is_near
