"""How far held-out views are from the training views.

A view sees what lies before it and is projected into its image; occlusion is not tested.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from sadgs_ns.render.rasterization import viewmats_from_camera_to_world

MAX_POINTS = 5000
"""Largest number of points that are taken."""
SHARED_POINTS = 10
"""Points that two views must share to have an angle."""


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

    def see(self, points: Tensor) -> Tensor:  # points: [P, 3]
        """Return which view sees which of the points [P, 3]. bool [C, P]"""
        rotations = self.viewmats[:, :3, :3]
        shifts = self.viewmats[:, None, :3, 3]
        in_camera = points @ rotations.mT + shifts  # [C, P, 3]
        depths = in_camera[..., 2]
        pixels = (in_camera @ self.Ks.mT)[..., :2] / in_camera[..., 2:]
        in_image = (pixels >= 0) & (pixels <= self.sizes[:, None])  # [C, P, 2]
        return (depths > 0) & in_image.all(dim=-1)

    def directions(self, points: Tensor) -> Tensor:  # points: [P, 3]
        """Return unit vectors from points [P, 3] to the cameras. [C, P, 3]"""
        centres = -self.viewmats[:, :3, :3].mT @ self.viewmats[:, :3, 3:]  # [C, 3, 1]
        return torch.nn.functional.normalize(centres.mT - points, dim=-1)


def thinned(points: Tensor) -> Tensor:  # points: [P, 3]
    """Return at most MAX_POINTS of the finite points [P, 3], evenly spaced in their order. [Q, 3]"""
    points = points[points.isfinite().all(dim=-1)]
    count = min(len(points), MAX_POINTS)
    if count == 0:
        return points
    rows = torch.arange(count, device=points.device) * len(points) // count
    return points[rows]


def nearest_angles(held_out: Views, training: Views, points: Tensor) -> Tensor:  # points: [P, 3]
    """Return the angles between E held-out views and the nearest of the training views.

    The angle between two views is the median, over the points [P, 3] in world space that both see, of the angle at the
    point between the directions to their cameras. Views that share fewer than SHARED_POINTS points have none.

    Returns:
        Smallest angles in degrees, in [0, 180]; NaN where a held-out view has none. [E]
    """
    angles = points.new_full((len(held_out.sizes),), torch.nan)
    points = thinned(points)
    to_held_out = held_out.directions(points)  # [E, Q, 3]
    to_training = training.directions(points)  # [T, Q, 3]
    seen_in_training = training.see(points)  # [T, Q]
    for i, seen in enumerate(held_out.see(points)):
        shared = seen_in_training & seen  # [T, Q]
        near = shared.sum(dim=-1) >= SHARED_POINTS  # [T]
        if near.any():
            # The arc sine of half the chord is exact near 0, where the arc cosine of a float32 is not.
            half_chords = (to_training[near] - to_held_out[i]).norm(dim=-1) / 2
            between = 2 * half_chords.clamp(max=1).asin().rad2deg()
            medians = between.masked_fill(~shared[near], torch.nan).nanmedian(dim=-1).values
            angles[i] = medians.min()
    return angles
