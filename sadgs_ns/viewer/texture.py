"""Pictures of S̄: the texture's period at each pixel, and S̄⁻¹ as ellipses over an image (paper, figure 1)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from sadgs_ns.method.eta import WAVELENGTH_EPSILON, wavelength
from sadgs_ns.method.structure_tensor import FREQUENCY_CONSTANT, NUM_LEVELS, SCALE_STEP
from sadgs_ns.viewer.color_scales import PERIOD, Picture

ELLIPSES_ACROSS = 28
"""Number of ellipses along an image's shorter side."""


def texture_period(structure_tensor: Tensor, frequency_constant: float = FREQUENCY_CONSTANT) -> Tensor:
    """Return the period of the finest texture in px at each pixel, 2π c Λ_min, or NaN without texture. [..., 3] → [...]

    The structure tensor (xx, xy, yy) in 1/px² measures ω = c / σ, and a sine of period P responds most at σ = P / 2π.
    """
    period = wavelength(structure_tensor)
    return torch.where(period < 0.999 / WAVELENGTH_EPSILON, 2 * torch.pi * frequency_constant * period, torch.nan)


@dataclass(frozen=True)
class Ellipses:
    """S̄⁻¹ at E pixels; the ellipses are short across a texture's stripes and long along them."""

    centers: Tensor  # [E, 2] px
    axes: Tensor
    """Wavelengths along the short and the long axis, px, at most `longest`. [E, 2]"""
    angles: Tensor
    """Direction of the short axis, from x towards y, rad. [E]"""
    periods: Tensor
    """Periods of the texture in px. [E]"""
    longest: float
    """Wavelength of the coarsest level, which limits axes: along stripes they would be infinite."""
    spacing: float
    """Distance between neighbouring centres in px."""


def structure_ellipses(
    structure_tensor: Tensor, frequency_constant: float = FREQUENCY_CONSTANT, spacing: float | None = None
) -> Ellipses:
    """Return S̄⁻¹ at the textured pixels of a regular grid.

    S̄ is (xx, xy, yy) in 1/px² [H, W, 3], and c in 1/px. The grid's spacing is in px and ≥ 1; None puts
    `ELLIPSES_ACROSS` along the shorter side.
    """
    height, width = structure_tensor.shape[:2]
    spacing = max(min(height, width) / ELLIPSES_ACROSS, 1.0) if spacing is None else spacing
    y, x = torch.meshgrid(
        torch.arange(spacing / 2, height, spacing), torch.arange(spacing / 2, width, spacing), indexing="ij"
    )
    points = torch.stack([x.flatten(), y.flatten()], -1)  # [E, 2]
    at = structure_tensor[points[:, 1].long(), points[:, 0].long()].double().cpu().nan_to_num(0.0)  # [E, 3]
    xx, xy, yy = at.unbind(-1)
    values, vectors = torch.linalg.eigh(torch.stack([xx, xy, xy, yy], -1).view(-1, 2, 2))  # ascending
    longest = SCALE_STEP ** (NUM_LEVELS - 1) / frequency_constant
    lengths = 1.0 / (values.clamp_min(0).sqrt() + WAVELENGTH_EPSILON)
    textured = lengths[:, 1] < 2 * longest
    short = vectors[textured, :, 1]  # The larger eigenvalue is the higher frequency.
    return Ellipses(
        centers=points[textured],
        axes=lengths[textured].flip(-1).clamp_max(longest),
        angles=torch.atan2(short[:, 1], short[:, 0]),
        periods=texture_period(at[textured], frequency_constant),
        longest=longest,
        spacing=spacing,
    )


def draw_ellipses(
    image: Picture,
    structure_tensor: Tensor,
    frequency_constant: float = FREQUENCY_CONSTANT,
    size: tuple[int, int] | None = None,
) -> Picture:
    """Draw S̄⁻¹ as ellipses over a dark grey copy of an image. Both are [H, W, 3].

    A circle as wide as the grid's spacing has the coarsest wavelength on both axes. `size` is the height and width of
    the drawing in px; None keeps the image's.
    """
    ellipses = structure_ellipses(structure_tensor, frequency_constant)
    height, width = image.shape[:2] if size is None else size
    enlarge_x, enlarge_y = width / image.shape[1], height / image.shape[0]
    picture = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA if enlarge_x < 1 else cv2.INTER_LINEAR)
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    picture = np.repeat((0.5 * grey).astype(np.uint8)[..., None], 3, axis=-1)
    if len(ellipses.centers) == 0:
        return picture
    colors = PERIOD(ellipses.periods[None])[0]
    # They are drawn relative to the grid's spacing, so that none vanish or overlap.
    radius = 0.5 * ellipses.spacing * min(enlarge_x, enlarge_y) / ellipses.longest
    fixed = 16  # OpenCV takes numbers with 4 bits after the point.
    thickness = max(round(min(height, width) / 350), 1)
    for center, axes, angle, color in zip(
        ellipses.centers.tolist(), ellipses.axes.tolist(), ellipses.angles.tolist(), colors.tolist(), strict=True
    ):
        # OpenCV numbers pixels by their centres, we by their edges.
        at = (round((center[0] * enlarge_x - 0.5) * fixed), round((center[1] * enlarge_y - 0.5) * fixed))
        half = (max(round(axes[0] * radius * fixed), 1), max(round(axes[1] * radius * fixed), 1))
        cv2.ellipse(picture, at, half, math.degrees(angle), 0, 360, color, thickness, cv2.LINE_AA, shift=4)
    return picture
