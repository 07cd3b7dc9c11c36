"""How near anything is to the cameras: the near plane of a scene, and the space before its cameras that is empty.

A faint Gaussian just before a camera covers the whole image with haze. Training cameras fade those before themselves,
but not those before a view between them. Nothing real can be there: the photos show nothing that near. So Gaussians
nearer than the near plane are not drawn. Exported files have no near plane, so that they leave out what lies before the
cameras and the paths between them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

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
NEIGHBOURS = 4
"""Each camera's path leads to so many of the others, the nearest that look in a similar direction."""
SIMILAR_DEGREES = 60.0
"""Largest angle between the viewing axes of two cameras with a path between them."""
STEP = 0.25
"""Distance between the poses of a path, as a share of the near plane, so that the cones before them leave few gaps."""
HAZE_ANGLE = 0.1
"""Standard deviation, as a share of its depth, from which a Gaussian before a pose is haze
(docs/results.md#exported-files)."""
_MOST_STEPS = 32
"""Poses on the path between two cameras, at most."""
_MOST_POSES = 4096
"""Of more poses, so many are taken, evenly spaced."""
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


def poses_of_path(viewmats: Tensor, spacing: float) -> tuple[Tensor, Tensor, Tensor]:
    """Put poses on the straight paths between neighbouring cameras, where the views between them would be taken.

    Args:
        viewmats: World to camera. [C, 4, 4]
        spacing: Largest distance in world units between poses of a path, as long as `_MOST_STEPS` suffice.

    Returns:
        World to camera, the cameras' own first [P, 4, 4]; the camera at one end of each pose's path; and the number of
        the path, −1 for the cameras. int64 [P] both
    """
    number, rotations = len(viewmats), viewmats[:, :3, :3].double().cpu()
    centres = -(rotations.mT @ viewmats[:, :3, 3:].double().cpu())[..., 0]  # [C, 3]
    distances = torch.cdist(centres, centres)
    unlike = rotations[:, 2] @ rotations[:, 2].T < math.cos(math.radians(SIMILAR_DEGREES))
    distances = distances.masked_fill(unlike, torch.inf).fill_diagonal_(torch.inf)
    poses, ends, paths = [viewmats], [torch.arange(number)], [torch.full((number,), -1)]
    if number > 1:
        others = distances.topk(min(NEIGHBOURS, number - 1), largest=False).indices  # [C, k]
        pairs = torch.stack([torch.arange(number)[:, None].expand_as(others), others], dim=-1).view(-1, 2)
        start, end = pairs.sort(dim=1).values.unique(dim=0).unbind(dim=1)  # [E], each path once
        lengths = distances[start, end]
        steps = torch.where(lengths.isfinite(), (lengths / spacing).ceil() - 1, 0).clamp_max(_MOST_STEPS).long()  # [E]
        edge = torch.arange(len(start)).repeat_interleave(steps)  # [Q]
        place = torch.arange(len(edge)) - (steps.cumsum(0) - steps)[edge]
        share = ((place + 1) / (steps[edge] + 1))[:, None]  # [Q, 1] inside (0, 1)
        start, end = start[edge], end[edge]
        centre = centres[start] + share * (centres[end] - centres[start])
        blended = rotations[start] + share[..., None] * (rotations[end] - rotations[start])
        left, _, right = torch.linalg.svd(blended)
        between = torch.eye(4, dtype=torch.float64).repeat(len(edge), 1, 1)
        between[:, :3, :3] = left @ right  # the rotation that is nearest to the blend
        between[:, :3, 3] = -(between[:, :3, :3] @ centre[..., None])[..., 0]
        chosen = torch.arange(len(edge))[:: -(-len(edge) // max(_MOST_POSES - number, 1)) or 1]
        poses.append(between[chosen].to(viewmats))
        ends.append(start[chosen])
        paths.append(edge[chosen])
    return torch.cat(poses), torch.cat(ends).to(viewmats.device), torch.cat(paths).to(viewmats.device)


@dataclass(frozen=True)
class EmptySpace:
    """The space just before P poses: those of the cameras, and of the views between them."""

    viewmats: Tensor
    """World to camera. [P, 4, 4]"""
    Ks: Tensor
    """Intrinsics in px. [P, 3, 3]"""
    sizes: Tensor
    """Width and height of the images in px. [P, 2]"""
    near: float
    """Depth in world units up to which the space before the poses is empty."""

    @staticmethod
    def of(
        points: Tensor,  # [P, 3]
        viewmats: Tensor,  # [C, 4, 4]
        Ks: Tensor,  # [C, 3, 3]
        sizes: Tensor,  # [C, 2]
        near_plane: float,
    ) -> EmptySpace:
        """Find the space before the training cameras and the paths between them.

        A path is left out if a pose on it comes nearer to SfM points than the cameras do: it may lead through a wall.

        Args:
            points, viewmats, Ks, sizes: As for `nearest_depths`.
            near_plane: Depth in world units up to which the space before the cameras is empty, > 0.
        """
        poses, ends, paths = poses_of_path(viewmats, STEP * near_plane)
        Ks, sizes = Ks.to(poses)[ends], sizes.to(poses)[ends]
        added = slice(len(viewmats), None)
        depths = nearest_depths(points, poses[added], Ks[added], sizes[added])
        blocked = paths[added][(NEAR_SHARE * depths < near_plane).to(paths.device)]
        clear = (paths < 0) | ~torch.isin(paths, blocked)
        return EmptySpace(poses[clear], Ks[clear], sizes[clear], near_plane)

    @torch.no_grad()
    def haze(self, means: Tensor, scales: Tensor) -> Tensor:
        """Tell which Gaussians lie in it and would look large from there.

        Args:
            means: Centres in world units. [N, 3]
            scales: Standard deviations in world units. [N, 3]

        Returns:
            bool [N], False where a centre is not finite.
        """
        reach = (scales.amax(dim=1) / HAZE_ANGLE).clamp_max(self.near)  # [N] Depth up to which a Gaussian is haze.
        inside = torch.zeros(len(means), dtype=torch.bool, device=means.device)
        poses, Ks, sizes = (value.to(means) for value in (self.viewmats, self.Ks, self.sizes))
        step = max(_PAIRS // max(len(means), 1), 1)
        for here in (slice(start, start + step) for start in range(0, len(poses), step)):
            depths = _depths_in_frusta(means, poses[here], Ks[here], sizes[here])  # [p, N]
            inside |= (depths < reach).any(dim=0)
        return inside


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
