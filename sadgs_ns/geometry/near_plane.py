"""The near plane of a scene: how near anything comes to the cameras.

A faint Gaussian just before a camera covers the whole image with haze. Training fades those before the training
cameras, but not those before a view between them. The photos show nothing that near, so such Gaussians are not drawn.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from sadgs_ns.geometry.initialization import plausible_points

NEAREST_POINTS = 5  # A view's fifth nearest SfM point is trusted; the four that are nearer may be errors
NEAR_SHARE = 0.5
"""The near plane, as a share of the smallest such depth of all views. At 0.25 haze was left in two of nine sets of
held-out views, and at 1 a view of leaves lost 9 dB (docs/results.md#near-plane)."""
UNKNOWN_SHARE = 0.01  # The near plane where no view sees enough SfM points, as a share of the cameras' extent
_MOST_POINTS = 2**17  # At most this many points are looked at, because each is projected into every view
_PAIRS = 2**24  # Pairs of a pose and a point that are computed at a time, in arrays of 64 MB


def scene_near_plane(
    points: Tensor,  # [P, 3]
    viewmats: Tensor,  # [C, 4, 4]
    Ks: Tensor,  # [C, 3, 3]
    sizes: Tensor,  # [C, 2]
    extent: float,
) -> float:
    """Derive the near plane of a scene, > 0, given arguments of `depths_in_views` and `initialization.camera_extent`.

    The training camera whose `NEAREST_POINTS`-th nearest SfM point has the least depth decides.
    """
    points = points[plausible_points(points)]
    nearest = math.inf
    if len(points) >= NEAREST_POINTS:
        points = points[:: -(-len(points) // _MOST_POINTS)]  # [P, 3]
        cameras = (tensor.split(max(_PAIRS // len(points), 1)) for tensor in (viewmats, Ks, sizes))
        depths = (depths_in_views(points, *some) for some in zip(*cameras, strict=True))  # each [c, P]
        nearest = min(float(some.kthvalue(NEAREST_POINTS, dim=1).values.min()) for some in depths)
    return NEAR_SHARE * nearest if nearest < math.inf else UNKNOWN_SHARE * extent


def depths_in_views(points: Tensor, viewmats: Tensor, Ks: Tensor, sizes: Tensor) -> Tensor:
    """Depths of points [P, 3] along the viewing axes of cameras (`render.types.Cameras`), infinite outside the image.

    `sizes` are the images' widths and heights in px [C, 2]. [C, P]
    """
    viewmats = viewmats.to(points)
    Ks = Ks.to(points)
    sizes = sizes.to(points)
    projected = (Ks @ viewmats[:, :3, :3]) @ points.T + Ks @ viewmats[:, :3, 3:]  # [C, 3, P]
    x, y, depths = projected.unbind(dim=1)
    inside = (x >= 0) & (x <= sizes[:, :1] * depths) & (y >= 0) & (y <= sizes[:, 1:] * depths) & (depths > 0)
    return torch.where(inside, depths, torch.inf)
