"""How deep points lie in views."""

from __future__ import annotations

import torch
from torch import Tensor


def depths_in_views(points: Tensor, viewmats: Tensor, Ks: Tensor, sizes: Tensor) -> Tensor:
    """Depths of points [P, 3] along the viewing axes of cameras (`render.types.Cameras`), infinite outside the image.

    `sizes` are the images' widths and heights in px [C, 2]. [C, P]
    """
    viewmats, Ks, sizes = viewmats.to(points), Ks.to(points), sizes.to(points)
    projected = (Ks @ viewmats[:, :3, :3]) @ points.T + Ks @ viewmats[:, :3, 3:]  # [C, 3, P]
    x, y, depths = projected.unbind(dim=1)
    inside = (x >= 0) & (x <= sizes[:, :1] * depths) & (y >= 0) & (y <= sizes[:, 1:] * depths) & (depths > 0)
    return torch.where(inside, depths, torch.inf)
