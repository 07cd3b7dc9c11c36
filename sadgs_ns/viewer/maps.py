"""Maps of the Gaussians' η, children and chosen shares, and pictures of S̄: its period, and S̄⁻¹ as ellipses.

Functions that draw N Gaussians take their raw parameters by name, `params`, as `render.blending.blend` does: means
[N, 3], quats [N, 4], log scales [N, 3] and logit opacities [N] or [N, 1]. `camera` is a single one, and maps have its
height and width. A map is NaN where hardly anything with a value is drawn.
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
SUBPIXELS = 16  # OpenCV takes whole numbers of 1/16 px, so that a drawing need not snap to pixels
SUBPIXEL_BITS = 4  # log2(SUBPIXELS)


def mean_map(
    params: Mapping[str, Tensor], values: Tensor, camera: Cameras, drawing: RenderOptions = DEFAULTS
) -> Tensor:
    """Return the mean of the values [N] of the Gaussians that are drawn at each pixel; NaN is no value. [H, W]"""
    has_value = (~values.isnan()).to(values)  # [N]
    layers = torch.stack([values.nan_to_num(0.0), has_value], dim=-1)  # [N, 2]
    blended, _ = blend(params, layers, camera, drawing)  # [H, W, 2]
    total, cover = blended.unbind(-1)
    return torch.where(cover > MIN_COVER, total / cover, torch.nan)


def eta_map(
    params: Mapping[str, Tensor], statistics: Mapping[str, Tensor], camera: Cameras, drawing: RenderOptions = DEFAULTS
) -> Tensor:
    """Return the geometric mean of the largest η of the Gaussians that were observed. [H, W]

    `statistics` are those of `method.statistics`; of them, `eta_max` [N, 3] and `n_total` [N] are read.
    """
    largest = statistics["eta_max"].amax(dim=1)  # [N]
    is_known = (statistics["n_total"] > 0) & (largest > 0)
    log_eta = torch.where(is_known, largest, torch.nan).log()
    return mean_map(params, log_eta, camera, drawing).exp()


def children_map(
    params: Mapping[str, Tensor], counts: Tensor, camera: Cameras, drawing: RenderOptions = DEFAULTS
) -> Tensor:
    """Return the geometric mean of the Gaussians' numbers of children, ≥ 1 along each axis [N, 3]. [H, W]"""
    log_children = num_children(counts).float().log()
    return mean_map(params, log_children, camera, drawing).exp()


def random_colors(number: int, generator: torch.Generator) -> Tensor:
    """Return N bright colours in [0, 1] that tell neighbouring Gaussians apart, on the CPU. [N, 3]"""
    from matplotlib.colors import hsv_to_rgb  # Training does not need it.

    hue, saturation, value = torch.rand((3, number), generator=generator)
    hsv = torch.stack([hue, 0.35 + 0.65 * saturation, 0.5 + 0.5 * value], -1)
    return torch.from_numpy(hsv_to_rgb(hsv.numpy())).float()


def recolor(colors: Tensor, origins: Tensor, generator: torch.Generator) -> Tensor:
    """Return colours [M, 3] after a densification step: children get new ones, other Gaussians keep theirs.

    Args:
        colors: Colours before the step. [N, 3]
        origins: Index before the step of each Gaussian, or of its parent. int64 [M]
        generator: Draws the new colours.
    """
    family_sizes = torch.bincount(origins, minlength=len(colors))  # [N]
    is_child = family_sizes[origins] > 1  # [M]
    new_colors = random_colors(len(origins), generator).to(colors)
    return torch.where(is_child[:, None], new_colors, colors[origins])


def texture_period(structure_tensor: Tensor, frequency_constant: float = FREQUENCY_CONSTANT) -> Tensor:
    """Return the period of the finest texture in px at each pixel, 2π c Λ_min, or NaN without texture. [..., 3] → [...]

    The structure tensor (xx, xy, yy) in 1/px² measures ω = c / σ, and a sine of period P responds most at σ = P / 2π.
    """
    shortest = wavelength(structure_tensor)
    has_texture = shortest < 0.999 / WAVELENGTH_EPSILON  # Without texture it is 1 / ε, up to rounding.
    period = 2 * torch.pi * frequency_constant * shortest
    return torch.where(has_texture, period, torch.nan)


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
    """Return S̄⁻¹ at the textured pixels of a regular grid. S̄ is (xx, xy, yy) in 1/px². [H, W, 3]"""
    height, width = structure_tensor.shape[:2]
    spacing = max(min(height, width) / ELLIPSES_ACROSS, 1.0)
    rows = torch.arange(spacing / 2, height, spacing)
    columns = torch.arange(spacing / 2, width, spacing)
    y, x = torch.meshgrid(rows, columns, indexing="ij")
    points = torch.stack([x.flatten(), y.flatten()], -1)  # [G, 2]
    at_points = structure_tensor[points[:, 1].long(), points[:, 0].long()]  # [G, 3]
    at_points = at_points.double().cpu().nan_to_num(0.0)
    xx, xy, yy = at_points.unbind(-1)
    matrices = torch.stack([xx, xy, xy, yy], -1).view(-1, 2, 2)
    values, vectors = torch.linalg.eigh(matrices)  # ascending
    frequencies = values.clamp_min(0).sqrt()  # [G, 2]
    wavelengths = 1.0 / (frequencies + WAVELENGTH_EPSILON)  # descending
    longest = SCALE_STEP ** (NUM_LEVELS - 1) / frequency_constant
    is_textured = wavelengths[:, 1] < 2 * longest
    short_axes = vectors[is_textured, :, 1]  # The larger eigenvalue is the higher frequency. [E, 2]
    return Ellipses(
        centers=points[is_textured],
        axes=wavelengths[is_textured].flip(-1).clamp_max(longest),
        angles=torch.atan2(short_axes[:, 1], short_axes[:, 0]),
        periods=texture_period(at_points[is_textured], frequency_constant),
        longest=longest,
        spacing=spacing,
    )


def draw_ellipses(image: Picture, structure_tensor: Tensor, constant: float, size: tuple[int, int]) -> Picture:
    """Draw S̄⁻¹ as ellipses over a dark grey copy of its image.

    A circle as wide as the grid's spacing has the coarsest wavelength on both axes.

    Args:
        image: The picture of which S̄ was computed. [H, W, 3]
        structure_tensor: S̄ as (xx, xy, yy) in 1/px². [H, W, 3]
        constant: The constant c of ω_l = c / σ_l.
        size: Height and width in px of the result.
    """
    ellipses = structure_ellipses(structure_tensor, constant)
    height, width = size
    enlarge_x = width / image.shape[1]
    enlarge_y = height / image.shape[0]
    picture = _dark_grey(image, size)
    if len(ellipses.centers) == 0:
        return picture
    colors = PERIOD(ellipses.periods[None])[0]  # [E, 3]
    # Axes are drawn relative to the grid's spacing, so that no ellipse vanishes and none overlap.
    half_spacing = 0.5 * ellipses.spacing * min(enlarge_x, enlarge_y)
    px_per_wavelength = half_spacing / ellipses.longest
    thickness = max(round(min(height, width) / 350), 1)
    for (x, y), axes, angle, color in zip(
        ellipses.centers.tolist(), ellipses.axes.tolist(), ellipses.angles.tolist(), colors.tolist(), strict=True
    ):
        # OpenCV counts from the centre of the first pixel, and we from its edge.
        center = (_in_subpixels(x * enlarge_x - 0.5), _in_subpixels(y * enlarge_y - 0.5))
        half_short = max(_in_subpixels(axes[0] * px_per_wavelength), 1)
        half_long = max(_in_subpixels(axes[1] * px_per_wavelength), 1)
        degrees = math.degrees(angle)
        cv2.ellipse(
            picture, center, (half_short, half_long), degrees, 0, 360, color, thickness, cv2.LINE_AA, SUBPIXEL_BITS
        )
    return picture


def _in_subpixels(length: float) -> int:
    return round(length * SUBPIXELS)


def _dark_grey(image: Picture, size: tuple[int, int]) -> Picture:
    """Return a grey copy of a picture, half as bright, of this height and width in px."""
    height, width = size
    interpolation = cv2.INTER_LINEAR
    if width < image.shape[1]:
        interpolation = cv2.INTER_AREA
    resized = cv2.resize(image, (width, height), interpolation=interpolation)
    grey = 0.5 * cv2.cvtColor(resized, cv2.COLOR_RGB2GRAY)
    return np.repeat(grey.astype(np.uint8)[..., None], 3, axis=-1)
