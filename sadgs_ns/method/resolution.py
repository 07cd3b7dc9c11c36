"""The resolution that grows with training: smaller images and their cameras, and the rule that says how small.

A level is the factor by which the sides of an image are divided. It is rendered while the Gaussians are longer than its
pixels: what they cannot resolve yet, the smaller image need not show.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from sadgs_ns.method.eta import projected_axes
from sadgs_ns.method.split import Params

LEVELS = (4, 2, 1)
"""From the coarsest to the full image. At 8, an image of 3 megapixels would have 47,000 pixels."""
LEAST_PIXELS = 300_000
"""Pixels that the views of a step keep together. Below that the work for each Gaussian, and launching it, should
decide how long a step takes, so that smaller images would cost quality and save nothing. It was not measured."""
FULL_SHARE = 0.4
"""Share of the run, at its end, whose images are full, whatever the Gaussians' lengths."""
GRADIENTS_SHARE = 0.25
"""Share of the iterations between two AbsGS steps, at their end, in which images are full.

AbsGS reads only full images, since the gradients of reduced ones miss detail. The steps that are full anyway would show
it half of 20 views and a twelfth of 500, and many Gaussians in none of them. With this share it reads half as many
visits as there are views where these are 500, and more where they are fewer. Steps in a row draw views in rounds, and
so about equally often, and at the end Gaussians are nearly those that the AbsGS step changes."""
_NEAREST = 0.01
"""Depth in world units from which Gaussians are drawn."""


def reduce_image(image: Tensor, level: int) -> Tensor:
    """Average an image over squares of pixels.

    Rows and columns that fill no square, at the bottom and on the right, are left out, so that `reduce_intrinsics` maps
    the centres of pixels exactly. Colours of RGBA images are averaged with their opacities as weights.

    Args:
        image: uint8, or floats in [0, 1]. [H, W, 3 or 4]
        level: Side of a square in px, at most H and W.

    Returns:
        In the image's type; bytes are rounded. [H // level, W // level, 3 or 4]
    """
    squares = _squares(image, level).float()  # [h, level, w, level, C]
    if image.shape[-1] == 4:
        colors, alphas = squares[..., :3], squares[..., 3:]
        weights = alphas.sum(dim=(1, 3))  # [h, w, 1]
        mean_color = (colors * alphas).sum(dim=(1, 3)) / torch.where(weights > 0, weights, 1.0)
        reduced = torch.cat([mean_color, weights / level**2], dim=-1)
    else:
        reduced = squares.mean(dim=(1, 3))
    return (reduced if image.is_floating_point() else reduced.round()).to(image.dtype)


def reduce_mask(mask: Tensor, level: int) -> Tensor:
    """Return which squares of `reduce_image` hold no masked pixel, whose colour would be part of their mean.

    Args:
        mask: True where a pixel counts. bool [H, W, 1]
        level: As in `reduce_image`.

    Returns:
        bool [H // level, W // level, 1]
    """
    return _squares(mask, level).all(dim=3).all(dim=1)


def reduce_intrinsics(Ks: Tensor, level: int) -> Tensor:
    """Return the intrinsics of reduced images: pixel centres lie at half-integers, so that all entries are divided.

    Args:
        Ks: Intrinsics in px. [..., 3, 3]
        level: As in `reduce_image`.
    """
    reduced = Ks.clone()
    reduced[..., :2, :] /= level
    return reduced


def footprint_length(axes: Tensor) -> Tensor:
    """Return the geometric mean of the two standard deviations of projected Gaussians: ⁴√(det Σ2D), without blur.

    Σ2D is the sum of v_k v_kᵀ, whose determinant is the sum of (v_j × v_k)² over pairs of axes (Cauchy–Binet): nothing
    cancels, however flat the Gaussian is.

    Args:
        axes: v_k of `eta.projected_axes` in px. [M, 3, 2]

    Returns:
        px. [M]
    """
    x, y = axes.unbind(-1)  # [M, 3] each
    others = [1, 2, 0]
    return (x * y[:, others] - y * x[:, others]).square().sum(dim=-1).sqrt().sqrt()


@torch.no_grad()
def typical_length(params: Params, viewmats: Tensor, Ks: Tensor, sizes: Sequence[tuple[int, int]]) -> Tensor:
    """Return how long Gaussians are in full images: the median of `footprint_length`, weighted by opacity.

    Every Gaussian counts in each view in whose image its centre lies.

    Args:
        params: `means` [N, 3], `quats` [N, 4], log `scales` [N, 3] and logit `opacities` [N] or [N, 1].
        viewmats: World to camera. [C, 4, 4]
        Ks: Intrinsics in px. [C, 3, 3]
        sizes: Width and height in px. [C]

    Returns:
        px; NaN where no view sees a Gaussian. []
    """
    means, quats, scales = params["means"], params["quats"], params["scales"].exp()
    opacities = torch.sigmoid(params["opacities"].flatten()).double()  # [N]
    n = len(means)
    lengths, weights = [], []
    for viewmat, K, (width, height) in zip(viewmats, Ks, sizes, strict=True):
        x, y, z = (means @ viewmat[:3, :3].T + viewmat[:3, 3]).unbind(-1)  # [N] each
        column, row = K[0, 0] * x / z + K[0, 2], K[1, 1] * y / z + K[1, 2]
        inside = (z > _NEAREST) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        axes = projected_axes(means, quats, scales, viewmat.expand(n, 4, 4), K.expand(n, 3, 3), width, height)
        length = footprint_length(axes)
        inside &= length.isfinite()
        lengths.append(torch.where(inside, length, 0.0))
        weights.append(torch.where(inside, opacities, 0.0))
    ordered, order = torch.cat(lengths).sort()
    passed = torch.cat(weights)[order].cumsum(0)  # Sums of float64 agree with every order of summation.
    middle = (passed < 0.5 * passed[-1]).sum().clamp_max(len(ordered) - 1)
    return torch.where(passed[-1] > 0, ordered[middle], torch.nan)


def coarsest_level(length: float, pixels: int, strength: float = 1.0) -> int:
    """Return the coarsest level whose pixels are not longer than the Gaussians.

    Args:
        length: Of the Gaussians in full images, px; with NaN the level is 1.
        pixels: Number of pixels of a step's full images, of which reduced ones keep at least `LEAST_PIXELS`.
        strength: Factor on the length: the larger, the longer images stay small.
    """
    fits = (level for level in LEVELS if strength * length >= level and pixels >= level**2 * LEAST_PIXELS)
    return next(fits, 1)


def _squares(image: Tensor, level: int) -> Tensor:
    """Return [H // level, level, W // level, level, C] of [H, W, C]."""
    height, width = image.shape[0] // level, image.shape[1] // level
    return image[: height * level, : width * level].reshape(height, level, width, level, -1)
