"""How far held-out views are from the training views, and how much of them no training view covers.

A view sees what lies before it and is projected into its image. Occlusion is not tested: the true shares are larger.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from sadgs_ns.render.rasterization import viewmats_from_camera_to_world

MAX_POINTS, SHARED_POINTS, COLUMNS, ROWS = 5000, 10, 32, 24
"""Points that are taken, points that two views must share to have an angle, and pixels of a held-out view's grid."""


class Views(NamedTuple):
    """C pinhole cameras: world-to-camera transforms (rigid, OpenCV axes), intrinsics in px, width and height in px."""

    viewmats: Tensor  # [C, 4, 4]
    Ks: Tensor  # [C, 3, 3]
    sizes: Tensor  # [C, 2]

    @staticmethod
    def of(cameras: Any) -> Views:
        """Take the views of nerfstudio's Cameras [C], whose images are undistorted."""
        viewmats = viewmats_from_camera_to_world(cameras.camera_to_worlds)
        Ks = cameras.get_intrinsics_matrices().to(viewmats)  # nerfstudio makes them on the host.
        return Views(viewmats, Ks, torch.cat([cameras.width, cameras.height], dim=-1))

    def project(self, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:  # points: [P, 3]
        """Return pixels [C, P, 2] and depths [C, P] of points [P, 3], and which view sees which point [C, P]."""
        in_camera = points @ self.viewmats[:, :3, :3].mT + self.viewmats[:, None, :3, 3]  # [C, P, 3]
        depths, pixels = in_camera[..., 2], (in_camera @ self.Ks.mT)[..., :2] / in_camera[..., 2:]
        return pixels, depths, (depths > 0) & ((pixels >= 0) & (pixels <= self.sizes[:, None])).all(dim=-1)

    def directions(self, points: Tensor) -> Tensor:  # points: [P, 3]
        """Return unit vectors from points [P, 3] to the cameras. [C, P, 3]"""
        centres = -self.viewmats[:, :3, :3].mT @ self.viewmats[:, :3, 3:]  # [C, 3, 1]
        return torch.nn.functional.normalize(centres.mT - points, dim=-1)


def thinned(points: Tensor) -> Tensor:  # points: [P, 3]
    """Return at most MAX_POINTS of the finite points [P, 3], evenly spaced in their order. [Q, 3]"""
    points = points[points.isfinite().all(dim=-1)]
    count = min(len(points), MAX_POINTS)
    return points[torch.arange(count, device=points.device) * len(points) // max(count, 1)]


def nearest_angles(held_out: Views, training: Views, points: Tensor) -> Tensor:  # points: [P, 3]
    """Return the angles between E held-out views and the nearest of the training views.

    The angle between two views is the median, over the points [P, 3] in world space that both see, of the angle at the
    point between the directions to their cameras. Views that share fewer than SHARED_POINTS points have none.

    Returns:
        Smallest angles in degrees, in [0, 180]; NaN where a held-out view has none. [E]
    """
    points, angles = thinned(points), points.new_full((len(held_out.sizes),), torch.nan)
    to_held_out, to_training = held_out.directions(points), training.directions(points)  # [E, Q, 3], [T, Q, 3]
    seen_in_training = training.project(points)[2]  # [T, Q]
    for i, seen in enumerate(held_out.project(points)[2]):
        near = (shared := seen_in_training & seen).sum(dim=-1) >= SHARED_POINTS  # [T]
        if near.any():
            # The arc sine of half the chord is exact near 0, where the arc cosine of a float32 is not.
            between = 2 * ((to_training[near] - to_held_out[i]).norm(dim=-1) / 2).clamp(max=1).asin().rad2deg()
            angles[i] = between.masked_fill(~shared[near], torch.nan).nanmedian(dim=-1).values.min()
    return angles


def uncovered_shares(held_out: Views, training: Views, points: Tensor) -> Tensor:  # points: [P, 3]
    """Return which share of the pixels of each of E held-out views lies in the frustum of no training view.

    Each pixel takes the depth of the point, of those of the points [P, 3] that the view sees, whose projection is
    nearest. The pixel is covered if some training view sees the place at this depth.

    Returns:
        Shares in [0, 1]; NaN where the held-out view sees no point. [E]
    """
    points, shares = thinned(points), points.new_full((len(held_out.sizes),), torch.nan)
    grid = torch.cartesian_prod(*((torch.arange(n, device=points.device) + 0.5) / n for n in (COLUMNS, ROWS)))
    for i, (pixels, depths, seen) in enumerate(zip(*held_out.project(points), strict=True)):
        if seen.any():
            at, viewmat = grid * held_out.sizes[i], held_out.viewmats[i]  # [G, 2] px
            nearest = torch.cdist(at, pixels[seen]).argmin(dim=-1)
            rays = torch.nn.functional.pad(at, (0, 1), value=1.0) @ held_out.Ks[i].inverse().mT  # [G, 3], of depth 1
            places = (rays * depths[seen][nearest, None] - viewmat[:3, 3]) @ viewmat[:3, :3]
            shares[i] = 1 - training.project(places)[2].any(dim=0).float().mean()
    return shares
