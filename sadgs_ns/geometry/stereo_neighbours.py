"""The views with which plane-sweep stereo compares each view."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

from sadgs_ns.geometry.rigid import camera_centres
from sadgs_ns.geometry.view_depths import depths_in_views

NEIGHBOURS = 4
"""Neighbours per view. Time grows with them; with fewer, occlusions leave holes."""
_TRIPLES = 2**22
"""Triples of two views and a point that are computed at a time, in arrays of 32 to 100 MB."""
_BEST_ANGLES = (5.0, 15.0)
"""Degrees between two cameras' rays, between which depth is accurate and windows look alike."""
_WIDEST_ANGLE = 35.0
"""Degrees from which on windows look too different to be compared."""
_SHARE = 0.02
"""A neighbour is usable if its weight is at least this share of the points that the view sees."""


@torch.no_grad()
def choose_neighbours(
    viewmats: Tensor,  # [V, 4, 4]
    Ks: Tensor,  # [V, 3, 3]
    sizes: Tensor,  # [V, 2]
    points: Tensor,  # [P, 3]
    count: int = NEIGHBOURS,
) -> Tensor:
    """Choose the views with which each view is compared, given float64 arguments of `depths_in_views`.

    Two views gain from every point that both see: less if the angle between their rays is too small or wide, or if one
    sees the point larger. A view counts less if one that is chosen already lies in the same direction.

    Returns:
        Indices of views, the best first, and −1 where there are fewer; on the device of the points. int64 [V, count]
    """
    centres = camera_centres(viewmats)  # [V, 3]
    depths = depths_in_views(points, viewmats, Ks, sizes)  # [V, P]
    weight = _pair_weights(centres, Ks, depths, points)
    num_seen = depths.isfinite().sum(dim=1, keepdim=True)  # [V, 1]
    weight = torch.where(weight < _SHARE * num_seen, 0.0, weight).fill_diagonal_(0)
    directions = F.normalize(centres - centres[:, None], dim=2)  # From each view to each. [V, V, 3]
    num_views = len(depths)
    chosen = torch.full((num_views, count), -1, device=depths.device)
    for i in range(min(count, num_views)):
        value, best = weight.max(dim=1)  # [V]
        chosen[:, i] = torch.where(value > 0, best, -1)
        direction = directions.gather(1, best[:, None, None].expand(-1, 1, 3))  # [V, 1, 3]
        similarity = (directions * direction).sum(dim=2).clamp_min(0)  # [V, V]
        factor = 1 - 0.5 * similarity
        weight = weight * factor
        weight.scatter_(1, best[:, None], 0)
    return chosen


def _pair_weights(
    centres: Tensor,  # of the cameras [V, 3]
    Ks: Tensor,  # [V, 3, 3]
    depths: Tensor,  # infinite outside the images [V, P]
    points: Tensor,  # [P, 3]
) -> Tensor:
    """Return for each pair of views its gain, a sum over the points that both see; each adds 1 at most. [V, V]"""
    seen = depths.isfinite()  # [V, P]
    rays = F.normalize(points - centres[:, None], dim=2)  # [V, P, 3]
    scales = Ks[:, :1, 0] / torch.where(seen, depths, 1.0)  # px per world unit. [V, P]
    views = torch.arange(len(seen), device=seen.device)
    views_at_once = max(_TRIPLES // max(seen.numel(), 1), 1)
    smallest, widest = _BEST_ANGLES
    weights = []
    for part in views.split(views_at_once):
        cosines = (rays[part, None] * rays).sum(dim=3).clamp(-1, 1)  # [v, V, P]
        angles = cosines.acos().rad2deg()
        # It rises to 1 at the smallest of the best angles, and falls from 1 after the widest of them.
        of_angle = angles / smallest
        of_angle = of_angle.clamp_max(1)
        fall = (_WIDEST_ANGLE - angles) / (_WIDEST_ANGLE - widest)
        of_angle *= fall.clamp(0, 1)
        ratios = scales[part, None] / scales
        of_scale = torch.minimum(ratios, 1 / ratios)
        both_see = seen[part, None] & seen
        gains = of_angle * of_scale * both_see
        weights.append(gains.sum(dim=2))
    return torch.cat(weights)
