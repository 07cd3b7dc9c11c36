"""The light that points have in photos, where they are projected.

sRGB's values c are taken for ((c + .055) / 1.055)^2.4 of linear light, as they are but in the darkest tones. Then a
gain g of linear light changes them to k (c + .055) − .055 with k = g^(1/2.4), an affine map.
"""

from __future__ import annotations

import torch
from torch import Tensor

OFFSET = 0.055
EXPONENT = 2.4
"""Of the map from sRGB's values to linear light."""
DARKEST = 12 / 255
BRIGHTEST = 247 / 255
"""Values of sRGB outside of which a photo is too dark or clipped, so that it does not tell its exposure."""
_AROUND = (-1, 0, 1)  # Pixels around a point's that are averaged, so that its noise and finest detail do not count


def srgb_gains(
    stops: Tensor,  # log₂ of gains of linear light [..., 3]
) -> Tensor:
    """Return the factors k by which gains of linear light change sRGB's values, as at the top of this module."""
    return torch.exp2(stops / EXPONENT)


def apply_gains(
    image: Tensor,  # in [0, 1] [..., 3]
    gains: Tensor,  # k [3]
    alpha: Tensor | float = 1.0,  # by which the image is multiplied already [..., 1]
) -> Tensor:
    """Return an image as it would be with another gain: k c + .055 (k − 1) α. It may leave [0, 1]. [..., 3]"""
    return image * gains + OFFSET * (gains - 1) * alpha


HIDDEN_CELLS = 40
"""Cells to the width of a photo; points behind the nearest one in their cell count as hidden."""
HIDDEN_DEPTH = 1.05
"""Depth, relative to that of the nearest one, from which they do."""


@torch.no_grad()
def observe_points(
    image: Tensor,  # uint8, or floats in [0, 1] [H, W, 3 or 4]
    mask: Tensor | None,  # valid pixels, bool [H, W]
    viewmat: Tensor,  # world to camera [4, 4]
    K: Tensor,  # px; the centre of the first pixel is (0.5, 0.5) [3, 3]
    points: Tensor,  # world units [Q, 3]
) -> tuple[Tensor, Tensor]:
    """Find the light of points in a photo, the mean of 3 × 3 pixels.

    Points behind the camera or other points, at the border or outside are left out, and so are those with a pixel that
    is dark, clipped, masked or transparent.

    Returns:
        Indices of M points, int64 [M], and log₂ of their linear light, float64 [M, 3].
    """
    height, width = image.shape[:2]
    in_camera = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    depth = in_camera[:, 2]
    pixels = in_camera[:, :2] / depth[:, None] * K.diagonal()[:2] + K[:2, 2]
    inside = (depth > 0) & (pixels >= 1).all(dim=1)
    inside &= (pixels[:, 0] < width - 1) & (pixels[:, 1] < height - 1)
    indices = inside.nonzero()[:, 0]
    indices = indices[_in_front(pixels[indices], depth[indices], width)]
    columns, rows = pixels[indices].long().unbind(1)
    around = torch.tensor(_AROUND, device=image.device)
    rows = (rows[:, None] + around)[:, :, None]  # [M, 3, 1]
    columns = (columns[:, None] + around)[:, None, :]  # [M, 1, 3]
    values = image[rows, columns].double()  # [M, 3, 3, 3 or 4]
    if image.dtype == torch.uint8:
        values /= 255
    colors = values[..., :3]
    usable = ((colors > DARKEST) & (colors < BRIGHTEST)).flatten(1).all(dim=1)
    if image.shape[2] == 4:
        usable &= (values[..., 3] == 1).flatten(1).all(dim=1)
    if mask is not None:
        usable &= mask[rows, columns].flatten(1).all(dim=1)
    light = ((colors[usable] + OFFSET) / (1 + OFFSET)) ** EXPONENT
    return indices[usable], light.mean(dim=(1, 2)).log2()


def _in_front(
    pixels: Tensor,  # places inside a photo [M, 2]
    depth: Tensor,  # [M]
    width: int,  # of the photo in px
) -> Tensor:
    """Tell which points lie about as near as the nearest one in their cell of the photo. bool [M]"""
    columns, rows = (pixels * (HIDDEN_CELLS / width)).long().unbind(1)
    cells = rows * HIDDEN_CELLS + columns
    number = int(cells.max()) + 1 if len(cells) else 0
    nearest = depth.new_full((number,), torch.inf).scatter_reduce(0, cells, depth, "amin")
    return depth <= HIDDEN_DEPTH * nearest[cells]
