"""How deep points lie in views."""

from __future__ import annotations

import torch
from torch import Tensor


def depths_in_views(
    points: Tensor,  # [P, 3]
    viewmats: Tensor,  # [C, 4, 4] world to camera
    Ks: Tensor,  # [C, 3, 3] px
    sizes: Tensor,  # [C, 2] widths and heights of the images in px
) -> Tensor:
    """Depths of points along the viewing axes of cameras, in world units, infinite outside the image. [C, P]

    They have the type of the points, and lie on their device.
    """
    viewmats = viewmats.to(points)
    Ks = Ks.to(points)
    sizes = sizes.to(points)
    rotations = viewmats[:, :3, :3]
    translations = viewmats[:, :3, 3:]
    to_pixels = Ks @ rotations
    shifts = Ks @ translations
    projected = to_pixels @ points.T + shifts  # [C, 3, P]
    x, y, depths = projected.unbind(dim=1)  # x and y are px times depth.
    widths = sizes[:, :1]
    heights = sizes[:, 1:]
    inside = depths > 0
    inside &= x >= 0
    inside &= x <= widths * depths
    inside &= y >= 0
    inside &= y <= heights * depths
    return torch.where(inside, depths, torch.inf)
