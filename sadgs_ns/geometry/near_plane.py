"""The near plane of a scene: how near anything comes to the cameras.

A faint Gaussian just before a camera covers the whole image with haze. Training fades those before the training
cameras, but not those before a view between them. The photos show nothing that near: `camera_paths` takes its reach
from this depth. The paper's presets draw nothing nearer, as all runs of version 1.0.0 did.
"""

from __future__ import annotations

import math

from torch import Tensor

from sadgs_ns.geometry.extents import plausible_points
from sadgs_ns.geometry.view_depths import depths_in_views

NEAREST_POINTS = 5
"""A view's fifth nearest SfM point is trusted; the four that are nearer may be errors."""
NEAR_SHARE = 0.5
"""The near plane, as a share of the smallest such depth of all views. At 0.25 haze was left in two of nine sets of
held-out views, and at 1 a view of leaves lost 9 dB (docs/results.md#near-plane)."""
UNKNOWN_SHARE = 0.01
"""The near plane where no view sees enough SfM points, as a share of the cameras' extent."""
_MOST_POINTS = 2**17
"""At most this many points are looked at, because each is projected into every view."""
_PAIRS = 2**24
"""Pairs of a pose and a point that are computed at a time, in arrays of 64 MB."""


def scene_near_plane(
    points: Tensor,  # [P, 3]
    viewmats: Tensor,  # [C, 4, 4]
    Ks: Tensor,  # [C, 3, 3]
    sizes: Tensor,  # [C, 2]
    extent: float,
) -> float:
    """Derive the near plane of a scene in world units, > 0.

    It is a share of the least depth at which a training camera has its `NEAREST_POINTS`-th nearest SfM point. If no
    camera sees so many points, it is a share of the cameras' extent.

    Args:
        points: The scene's SfM points. [P, 3]
        viewmats, Ks, sizes: The training cameras, as `depths_in_views` takes them.
        extent: The cameras' extent (`extents.camera_extent`).
    """
    points = points[plausible_points(points)]
    nearest = math.inf
    if len(points) >= NEAREST_POINTS:
        nearest = _nearest_depth(points, viewmats, Ks, sizes)
    if nearest < math.inf:
        return NEAR_SHARE * nearest
    return UNKNOWN_SHARE * extent


def _nearest_depth(points: Tensor, viewmats: Tensor, Ks: Tensor, sizes: Tensor) -> float:
    """Return the least depth of the views' `NEAREST_POINTS`-th nearest points; infinite if no view sees so many."""
    step = math.ceil(len(points) / _MOST_POINTS)
    points = points[::step]
    views_at_once = _PAIRS // len(points)
    views_at_once = max(views_at_once, 1)
    cameras = (tensor.split(views_at_once) for tensor in (viewmats, Ks, sizes))
    nearest = math.inf
    for part in zip(*cameras, strict=True):
        depths = depths_in_views(points, *part)  # [c, P]
        trusted = depths.kthvalue(NEAREST_POINTS, dim=1).values  # [c]
        of_part = float(trusted.min())
        nearest = min(nearest, of_part)
    return nearest
