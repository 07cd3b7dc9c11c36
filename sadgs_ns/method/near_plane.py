"""How near anything is to the cameras: the near plane of a scene.

A faint Gaussian just before a camera covers the whole image with haze. Training cameras fade those before themselves,
but not those before a view between them. Nothing real can be there: the photos show nothing that near. So Gaussians
nearer than the near plane are not drawn.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from sadgs_ns.method.initialization import plausible_points

NEAREST_POINTS = 5
"""A view's nearest SfM points up to this one may be errors; the depth of this one is taken for true."""
NEAR_SHARE = 0.5
"""The near plane, as a share of the smallest such depth of all views. At 0.25 haze was left in two of nine sets of
held-out views, and at 1 a view of leaves lost 9 dB (docs/results.md#near-plane)."""
UNKNOWN_SHARE = 0.01
"""The near plane where no view sees enough SfM points, as a share of the cameras' extent."""
_MOST_POINTS = 2**17
"""Of more points, so many are looked at, since a point in each of thousands of views takes time."""
_PAIRS = 2**24
"""Pairs of a pose and a point that are computed at a time, in arrays of 64 MB."""


def nearest_depths(
    points: Tensor,  # [P, 3]
    viewmats: Tensor,  # [C, 4, 4]
    Ks: Tensor,  # [C, 3, 3]
    sizes: Tensor,  # [C, 2]
) -> Tensor:
    """Measure the depth of the nearest SfM points before each view, of which a few may be wrong.

    Args:
        points: SfM points in world units. [P, 3]
        viewmats: World to camera, OpenCV axes. [C, 4, 4]
        Ks: Intrinsics in px. [C, 3, 3]
        sizes: Width and height of the images in px. [C, 2]

    Returns:
        Depth of the `NEAREST_POINTS`-th point along the viewing axis, in world units, > 0; infinite in views that see
        fewer. [C]
    """
    points = points[plausible_points(points)]
    points = points[:: -(-len(points) // _MOST_POINTS) or 1]  # [P, 3]
    nearest = [points.new_full((0,), torch.inf)]
    step = max(_PAIRS // max(len(points), 1), 1)
    for part in (slice(start, start + step) for start in range(0, len(viewmats), step)):
        depths = _depths_in_frusta(points, viewmats[part], Ks[part], sizes[part])  # [c, P]
        if len(points) < NEAREST_POINTS:
            nearest.append(points.new_full((len(depths),), torch.inf))
        else:
            nearest.append(depths.kthvalue(NEAREST_POINTS, dim=1).values)
    return torch.cat(nearest)


def scene_near_plane(depths: Tensor, extent: float) -> float:
    """Derive the near plane of a scene from what its training cameras come nearest to.

    It follows the camera that comes nearest to anything: an object close to a single camera is drawn, too.

    Args:
        depths: What `nearest_depths` returned for the training cameras. [C]
        extent: Of the cameras in world units, as `initialization.camera_extent` defines it.

    Returns:
        Depth along the viewing axis in world units, > 0.
    """
    nearest = float(depths.min())
    return NEAR_SHARE * nearest if nearest < math.inf else UNKNOWN_SHARE * extent


def _depths_in_frusta(
    points: Tensor,  # [P, 3]
    viewmats: Tensor,  # [C, 4, 4]
    Ks: Tensor,  # [C, 3, 3]
    sizes: Tensor,  # [C, 2]
) -> Tensor:
    """Depths of points in views, infinite outside the image. [C, P]"""
    viewmats, Ks, sizes = viewmats.to(points), Ks.to(points), sizes.to(points)
    projected = (Ks @ viewmats[:, :3, :3]) @ points.T + Ks @ viewmats[:, :3, 3:]  # [C, 3, P]
    x, y, depths = projected.unbind(dim=1)
    inside = (x >= 0) & (x <= sizes[:, :1] * depths) & (y >= 0) & (y <= sizes[:, 1:] * depths) & (depths > 0)
    return torch.where(inside, depths, torch.inf)
