"""Corrections of camera poses, their effect in pixels, and the motion that all cameras have in common.

A correction is a row (ω, τ): a rotation vector in radians and a translation in world units, both in the camera's axes.
It moves a point from x to exp(ω) x + τ in the camera's frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from sadgs_ns.geometry.rigid import camera_centres

ZERO_DEPTH_SHARE = 1e-3
"""Depths of less than this share of the median do not count: no lens is sharp there, and pixels move without bound."""
_SERIES_BELOW = 0.05
"""Squared angle below which series replace sin θ / θ and (1 − cos θ) / θ²; their next terms are below float64's ε."""
_GRID = 5  # Rows and columns of the pixels at which an image's motion is measured


def rotations(
    vectors: Tensor,  # [..., 3]
) -> Tensor:
    """Return the rotations of rotation vectors in radians, by Rodrigues's formula. [..., 3, 3]

    Values and gradients are accurate to rounding, at 0 as well: no branch divides by the angle there.
    """
    squared = vectors.square().sum(dim=-1)
    is_small = squared < _SERIES_BELOW
    series_of = torch.where(is_small, squared, 0.0)
    sine = 1 - series_of / 6 * (
        1 - series_of / 20 * (1 - series_of / 42 * (1 - series_of / 72 * (1 - series_of / 110)))
    )
    versine = 0.5 * _versine_series(series_of)
    larger = torch.where(is_small, 1.0, squared)
    angle = larger.sqrt()
    sine = torch.where(is_small, sine, angle.sin() / angle)
    versine = torch.where(is_small, versine, (1 - angle.cos()) / larger)
    x, y, z = vectors.unbind(dim=-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))
    outer = vectors[..., :, None] * vectors[..., None, :]
    identity = torch.eye(3, dtype=vectors.dtype, device=vectors.device)
    # exp = I + s [ω]× + v (ω ωᵀ − |ω|² I)
    squares = outer - squared[..., None, None] * identity
    return identity + sine[..., None, None] * cross + versine[..., None, None] * squares


def _versine_series(squared: Tensor) -> Tensor:
    """Return 2 (1 − cos θ) / θ² of small squared angles θ²."""
    tail = 1 - squared / 90 * (1 - squared / 132)
    return 1 - squared / 12 * (1 - squared / 30 * (1 - squared / 56 * tail))


def corrected(
    viewmats: Tensor,  # [C, 4, 4]
    corrections: Tensor,  # [C, 6]
) -> Tensor:
    """Return world-to-camera matrices after corrections in the cameras' frames, differentiably. [C, 4, 4]"""
    turned = (rotations(corrections[:, :3])[..., None] * viewmats[:, None, :3]).sum(dim=-2)  # [C, 3, 4]
    shift = torch.nn.functional.pad(corrections[:, 3:, None], (3, 0))  # [C, 3, 4]
    return torch.cat([turned + shift, viewmats[:, 3:]], dim=1)


def image_motion(
    Ks: Tensor,  # Intrinsics in px. [V, 3, 3]
    sizes: Tensor,  # Width and height in px. [V, 2]
    depths: Tensor,  # Depths at which points of the views lie, > 0. [V, D]
) -> Tensor:
    """Return how corrections move the images: mean squared motion in px² is cᵀ M c for a small correction c. [V, 6, 6]

    The mean is over a grid of pixels at each of the depths.
    """
    steps = (torch.arange(_GRID, dtype=Ks.dtype, device=Ks.device) + 0.5) / _GRID
    x = (steps * sizes[:, :1] - Ks[:, 0, 2:]) / Ks[:, 0, :1]  # [V, G]
    y = (steps * sizes[:, 1:] - Ks[:, 1, 2:]) / Ks[:, 1, 1:2]
    num_depths = depths.shape[1]
    x = x[:, None, :, None].expand(-1, _GRID, -1, num_depths).flatten(1)  # [V, P]
    y = y[:, :, None, None].expand(-1, -1, _GRID, num_depths).flatten(1)
    inverse = 1 / depths[:, None, :].expand(-1, _GRID * _GRID, -1).flatten(1)
    zero = torch.zeros_like(x)
    # Derivatives of u / f and v / f by ω and by τ.
    by_u = torch.stack([-x * y, 1 + x * x, -y, inverse, zero, -x * inverse], dim=-1)  # [V, P, 6]
    by_v = torch.stack([-1 - y * y, x * y, x, zero, inverse, -y * inverse], dim=-1)
    by_u = Ks[:, 0, :1, None] * by_u
    by_v = Ks[:, 1, 1:2, None] * by_v
    return (by_u.mT @ by_u + by_v.mT @ by_v) / x.shape[1]


def pixel_steps(
    motion: Tensor,  # What `image_motion` returned. [V, 6, 6]
) -> Tensor:
    """Return how far each number of a correction goes to move its view's image by 1 px (root mean square). [V, 6]"""
    return motion.diagonal(dim1=1, dim2=2).clamp_min(1e-30).rsqrt()


def view_depths(
    viewmats: Tensor,  # [V, 4, 4]
    Ks: Tensor,  # [V, 3, 3]
    sizes: Tensor,  # Width and height in px. [V, 2]
    points: Tensor,  # Points of the scene. [P, 3]
) -> Tensor:
    """Return the quartiles of the depths at which each view has points. [V, 3]

    A view without points has the medians of the other views; if there are no others, the depth is 1.
    """
    quartiles = points.new_tensor([0.25, 0.5, 0.75])
    rows = []
    for viewmat, K, size in zip(viewmats, Ks, sizes, strict=True):
        inside = points @ viewmat[:3, :3].T + viewmat[:3, 3]  # [P, 3]
        depth = inside[:, 2]
        pixels = (inside @ K.T)[:, :2] / depth[:, None]
        visible = depth[(depth > 0) & ((pixels > 0) & (pixels < size)).all(dim=1)]
        if len(visible) > 0:
            visible = visible[visible > ZERO_DEPTH_SHARE * visible.median()]
            rows.append(torch.quantile(visible, quartiles))
        else:
            rows.append(torch.full_like(quartiles, torch.nan))
    depths = torch.stack(rows)
    typical = depths.nanmedian(dim=0).values.nan_to_num(1.0)
    return torch.where(depths.isnan(), typical, depths)


@dataclass(frozen=True)
class Gauge:
    """The motions that all cameras can have in common, of which photos say nothing if the scene moves with them.

    They are three rotations, three translations and a change of scale. The motion that a table of corrections has in
    common is the one that explains most of how the images moved: the least squares of pixels over all views. That is
    linear in the corrections, because these are small. So one product finds it, and one takes it out.
    """

    motions: Tensor  # Corrections of each view by each common motion. [V, 6, 7]
    fit: Tensor  # Weights of the corrections in each common motion. [7, V, 6]

    @staticmethod
    def of(
        viewmats: Tensor,  # Initial poses. [V, 4, 4]
        motion: Tensor,  # What `image_motion` returned. [V, 6, 6]
    ) -> Gauge:
        """Make the gauge of cameras; it is computed in float64, and has the type and device of the poses."""
        exact = viewmats.double().cpu()
        metric = motion.double().cpu()
        motions = _common_motions(exact)
        weighted = motions.mT @ metric  # [V, 7, 6]
        normal = (weighted @ motions).sum(dim=0)  # [7, 7]
        # Scale each motion to one pixel, so that the rank does not depend on the scene's units.
        unit = normal.diagonal().clamp_min(1e-30).rsqrt()
        inverse = unit[:, None] * torch.linalg.pinv(unit[:, None] * normal * unit, rtol=1e-9, hermitian=True) * unit
        fit = (inverse @ weighted).movedim(0, 1)  # [7, V, 6]
        return Gauge(motions.to(viewmats), fit.contiguous().to(viewmats))

    def common_motion(
        self,
        corrections: Tensor,  # Of all views. [V, 6]
    ) -> Tensor:
        """Return the motion that the corrections have in common: rotation, translation and scale. [7]"""
        return (self.fit * corrections).sum(dim=(1, 2))

    def take_out(
        self,
        corrections: Tensor,  # Of all views. [V, 6]
    ) -> None:
        """Take the common motion out of the corrections, in place and without waiting for the device."""
        corrections -= (self.motions * self.common_motion(corrections)).sum(dim=2)


def _common_motions(
    viewmats: Tensor,  # [V, 4, 4]
) -> Tensor:
    """Return the corrections that move all cameras alike. [V, 6, 7]

    The world motion is x → x + ρ × (x − m) + d + λ (x − m) with the mean m of the cameras' centres: ρ, d and λ.
    """
    rotation = viewmats[:, :3, :3]
    centres = camera_centres(viewmats)  # [V, 3]
    arms = centres - centres.mean(dim=0)
    x, y, z = arms.unbind(dim=-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(-1, (3, 3))  # [arms]×
    # The camera turns by ρ and its centre moves by ρ × arm + d + λ arm; a correction is the opposite, in its axes.
    turning = torch.cat([-rotation, rotation @ cross], dim=1)  # [V, 6, 3]
    moving = torch.cat([torch.zeros_like(rotation), -rotation], dim=1)
    scaling = torch.cat([torch.zeros_like(arms), -(rotation @ arms[..., None])[..., 0]], dim=1)
    return torch.cat([turning, moving, scaling[..., None]], dim=2)
