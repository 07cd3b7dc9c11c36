"""Maps of the Gaussians' η, children and chosen shares, and pictures of S̄: its period, and S̄⁻¹ as ellipses.

`params` are means [N, 3], quats [N, 4], log scales [N, 3] and logit opacities [N] or [N, 1], by name. `camera` is a
single one, and maps have its height and width. They are NaN where hardly anything with a value is drawn.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor

from sadgs_ns.method.eta import WAVELENGTH_EPSILON, wavelength
from sadgs_ns.method.split import num_children
from sadgs_ns.method.structure_tensor import FREQUENCY_CONSTANT, NUM_LEVELS, SCALE_STEP
from sadgs_ns.render.blending import blend
from sadgs_ns.render.types import DEFAULTS, Cameras, RenderOptions
from sadgs_ns.viewer.color_scales import PERIOD, Picture

ELLIPSES_ACROSS = 28  # Number of ellipses along an image's shorter side
MIN_COVER = 0.05  # Share of a pixel that Gaussians with a value must make up; otherwise the pixel counts as empty


def mean_map(
    params: Mapping[str, Tensor], values: Tensor, camera: Cameras, drawing: RenderOptions = DEFAULTS
) -> Tensor:
    """Return the mean of the values [N], where NaN is none, of what is drawn at each pixel. [H, W]"""
    weights = (~values.isnan()).to(values)
    layers = torch.stack([values.nan_to_num(0.0), weights], dim=-1)
    total, cover = blend(params, layers, camera, drawing)[0].unbind(-1)
    return torch.where(cover > MIN_COVER, total / cover, torch.nan)


def eta_map(
    params: Mapping[str, Tensor], statistics: Mapping[str, Tensor], camera: Cameras, drawing: RenderOptions = DEFAULTS
) -> Tensor:
    """Return the geometric mean of the largest η of the Gaussians observed (`eta_max`, `n_total`). [H, W]"""
    largest = statistics["eta_max"].amax(dim=1)
    known = (statistics["n_total"] > 0) & (largest > 0)
    return mean_map(params, torch.where(known, largest, torch.nan).log(), camera, drawing).exp()


def children_map(
    params: Mapping[str, Tensor], counts: Tensor, camera: Cameras, drawing: RenderOptions = DEFAULTS
) -> Tensor:
    """Return the geometric mean of the Gaussians' numbers of children, ≥ 1 along each axis [N, 3]. [H, W]"""
    return mean_map(params, num_children(counts).float().log(), camera, drawing).exp()


def random_colors(number: int, generator: torch.Generator) -> Tensor:
    """Return N bright colours in [0, 1] that tell neighbouring Gaussians apart, on the CPU. [N, 3]"""
    from matplotlib.colors import hsv_to_rgb  # Training does not need it.

    hue, saturation, value = torch.rand((3, number), generator=generator)
    hsv = torch.stack([hue, 0.35 + 0.65 * saturation, 0.5 + 0.5 * value], -1)
    return torch.from_numpy(hsv_to_rgb(hsv.numpy())).float()


def recolor(colors: Tensor, origins: Tensor, generator: torch.Generator) -> Tensor:
    """Return colours [M, 3] after a densification step: children get new ones, other Gaussians keep theirs.

    `origins`, int64 [M], are the indices before the step of each Gaussian, or of its parent.
    """
    is_child = torch.bincount(origins, minlength=len(colors))[origins] > 1  # [M]
    return torch.where(is_child[:, None], random_colors(len(origins), generator).to(colors), colors[origins])


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
    axes: Tensor  # Wavelengths along the short and the long axis, px, at most `longest`. [E, 2]
    angles: Tensor  # Direction of the short axis, from x towards y, rad. [E]
    periods: Tensor  # Periods of the texture in px. [E]
    longest: float  # Wavelength of the coarsest level, which limits axes: along stripes they would be infinite
    spacing: float  # Distance between neighbouring centres in px


def structure_ellipses(structure_tensor: Tensor, frequency_constant: float = FREQUENCY_CONSTANT) -> Ellipses:
    """Return S̄⁻¹ at the textured pixels of a regular grid. S̄ is (xx, xy, yy) in 1/px² [H, W, 3], and c in 1/px."""
    height, width = structure_tensor.shape[:2]
    spacing = max(min(height, width) / ELLIPSES_ACROSS, 1.0)
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


def draw_ellipses(image: Picture, structure_tensor: Tensor, constant: float, size: tuple[int, int]) -> Picture:
    """Draw S̄⁻¹ [H, W, 3] as ellipses over a dark grey copy of its image, of this height and width in px.

    A circle as wide as the grid's spacing has the coarsest wavelength on both axes. `constant` is c in 1/px.
    """
    ellipses = structure_ellipses(structure_tensor, constant)
    height, width = size
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
