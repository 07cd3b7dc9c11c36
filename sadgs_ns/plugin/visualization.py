"""Pictures of what the method sees: local wavelength, S̄ as ellipses, η, splits. Tensors in, RGB or figures out.

Knows nothing of nerfstudio. Colour maps are those of matplotlib that colour-blind readers can tell apart; its
figures and fonts, which take a fifth of a second to import, are imported where they are drawn: training needs none.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Literal

import cv2
import matplotlib
import numpy as np
import torch
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, LogNorm, Normalize, hsv_to_rgb
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from sadgs_ns.atomic import atomic_path
from sadgs_ns.method.eta import WAVELENGTH_EPSILON, wavelength
from sadgs_ns.method.split import num_children
from sadgs_ns.method.structure_tensor import FREQUENCY_CONSTANT, NUM_LEVELS, SCALE_STEP
from sadgs_ns.render.rasterization import rasterize

Picture = NDArray[np.uint8]
"""RGB. [H, W, 3]"""

MIN_COVER = 0.05
"""Share of a pixel that Gaussians with a value must make up, lest it count as empty."""
ELLIPSES_ACROSS = 28
"""Ellipses along an image's shorter side."""
NOTHING = "black"
"""Colour of pixels without a value: no scale has it. Grey is in the middle of cividis, and, to the colour-blind, of
viridis."""


@dataclass(frozen=True)
class Scale:
    """Which colour a value has, and how a legend says so."""

    label: str
    colors: str
    """Name of a colour map of matplotlib."""
    low: float
    high: float
    ticks: tuple[float, ...]
    log: bool = True
    unit: str = ""

    @property
    def norm(self) -> Normalize:
        """Value → [0, 1]; values beyond the ends have the colours of the ends."""
        return (LogNorm if self.log else Normalize)(self.low, self.high, clip=True)

    @property
    def colormap(self) -> Colormap:
        """[0, 1] → colour."""
        return matplotlib.colormaps[self.colors].with_extremes(bad=NOTHING)

    def __call__(self, values: Tensor) -> Picture:
        """Colour a map; NaN is black. [H, W] → [H, W, 3]"""
        shown = self.norm(np.ma.masked_invalid(values.detach().float().cpu().numpy()))
        return self.colormap(shown, bytes=True)[..., :3]  # type: ignore[return-value]


PERIOD = Scale("period of the texture", "viridis", 3, 60, (3, 5, 10, 20, 40), unit="px")
ETA = Scale("largest η", "PuOr_r", 1 / 30, 30, (0.03, 0.1, 0.3, 1, 3, 10, 30))
"""Centred at 1: violet Gaussians are finer than the texture, orange ones violate."""
CHILDREN = Scale("children, 16 or more at the end", "cividis", 1, 16, (1, 2, 4, 8, 16))
LOW = Scale("share of consistently low Gaussians", "cividis", 0, 1, (0, 0.25, 0.5, 0.75, 1), log=False)


def to_picture(image: Tensor) -> Picture:
    """[H, W, 3] in [0, 1] → RGB."""
    return (255 * image.detach().float().clamp(0, 1)).round().byte().cpu().numpy()


def texture_period(structure_tensor: Tensor, frequency_constant: float = FREQUENCY_CONSTANT) -> Tensor:
    """Period of the finest texture at each pixel: 2π c Λ_min.

    The structure tensor measures ω = c / σ, and a sine of period P answers most at σ = P / 2π.

    Args:
        structure_tensor: S̄ as (xx, xy, yy) in 1/px². [..., 3]
        frequency_constant: c that S̄ was computed with, in 1/px.

    Returns:
        px; NaN where S̄ is 0, so that there is no texture, and where it is NaN, at masked pixels. [...]
    """
    period = wavelength(structure_tensor)
    return torch.where(period < 0.999 / WAVELENGTH_EPSILON, 2 * torch.pi * frequency_constant * period, torch.nan)


@dataclass(frozen=True)
class Ellipses:
    """S̄⁻¹ at some pixels (paper, figure 1): short across a texture's stripes, long along them."""

    centers: Tensor
    """px. [E, 2]"""
    axes: Tensor
    """Wavelengths along the short and the long axis, px, at most `longest`. [E, 2]"""
    angles: Tensor
    """Direction of the short axis, from x towards y, rad. [E]"""
    periods: Tensor
    """px. [E]"""
    longest: float
    """Wavelength of the coarsest level, at which axes are cut: stripes have an infinite one along them."""
    spacing: float
    """Between the centres, px."""


def structure_ellipses(
    structure_tensor: Tensor, frequency_constant: float = FREQUENCY_CONSTANT, spacing: float | None = None
) -> Ellipses:
    """S̄⁻¹ on a regular grid of pixels, without those that have no texture or are masked.

    Args:
        structure_tensor: S̄ as (xx, xy, yy) in 1/px². [H, W, 3]
        frequency_constant: c that S̄ was computed with, in 1/px.
        spacing: Of the grid in px, ≥ 1; None puts `ELLIPSES_ACROSS` along the shorter side.
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
    short = vectors[textured, :, 1]  # of the larger eigenvalue
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
    """S̄⁻¹ as ellipses over an image, which is made dark grey. A circle as wide as the grid is the coarsest wavelength.

    Args:
        image: [H, W, 3]
        structure_tensor: S̄ of the image. [H, W, 3]
        frequency_constant: c that S̄ was computed with, in 1/px.
        size: Height and width of the picture in px; None keeps those of the image.
    """
    ellipses = structure_ellipses(structure_tensor, frequency_constant)
    height, width = image.shape[:2] if size is None else size
    enlarge_x, enlarge_y = width / image.shape[1], height / image.shape[0]
    picture = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA if enlarge_x < 1 else cv2.INTER_LINEAR)
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)  # colour is the ellipses'
    picture = np.repeat((0.5 * grey).astype(np.uint8)[..., None], 3, axis=-1)
    if len(ellipses.centers) == 0:
        return picture
    colors = PERIOD(ellipses.periods[None])[0]
    # The grid's own size, not the wavelengths', decides how large they are drawn: none vanish or overlap.
    radius = 0.5 * ellipses.spacing * min(enlarge_x, enlarge_y) / ellipses.longest
    fixed = 16  # OpenCV's fixed point: 4 bits
    thickness = max(round(min(height, width) / 350), 1)
    for center, axes, angle, color in zip(
        ellipses.centers.tolist(), ellipses.axes.tolist(), ellipses.angles.tolist(), colors.tolist(), strict=True
    ):
        # OpenCV's pixel centres are integers.
        at = (round((center[0] * enlarge_x - 0.5) * fixed), round((center[1] * enlarge_y - 0.5) * fixed))
        half = (max(round(axes[0] * radius * fixed), 1), max(round(axes[1] * radius * fixed), 1))
        cv2.ellipse(picture, at, half, math.degrees(angle), 0, 360, color, thickness, cv2.LINE_AA, shift=4)
    return picture


@torch.no_grad()
def blend(
    params: Mapping[str, Tensor],
    values: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    rasterize_mode: Literal["classic", "antialiased"] = "classic",
) -> tuple[Tensor, Tensor]:
    """Values of Gaussians blended like their colours, front to back.

    Args:
        params: `means` [N, 3], `quats` [N, 4], log `scales` [N, 3], logit `opacities` [N] or [N, 1].
        values: [N, D]
        viewmat: World to camera. [4, 4]
        K: px. [3, 3]
        width, height: px.
        rasterize_mode: As for `rasterize`.

    Returns:
        [H, W, D], and how much of each pixel is covered [H, W, 1].
    """
    render, alpha, _ = rasterize(
        params["means"],
        params["quats"],
        params["scales"].exp(),
        torch.sigmoid(params["opacities"].flatten()),
        values,
        viewmat[None],
        K[None],
        width,
        height,
        rasterize_mode=rasterize_mode,
    )
    return render[0], alpha[0]


def eta_map(params: Mapping[str, Tensor], statistics: Mapping[str, Tensor], *view, **options) -> Tensor:
    """Largest η of the Gaussians that make up each pixel: a mean of log η by what each adds to the pixel.

    Args:
        params: As for `blend`.
        statistics: `eta_max` [N, 3] and `n_total` [N]; Gaussians that were never observed count for nothing.
        view, options: The rest of `blend`'s.

    Returns:
        NaN where hardly anything observed is drawn. [H, W]
    """
    largest = statistics["eta_max"].amax(dim=1)
    known = ((statistics["n_total"] > 0) & (largest > 0)).float()
    values = torch.stack([torch.where(known > 0, largest, 1.0).log(), known], dim=-1)
    total, cover = blend(params, values, *view, **options)[0].unbind(-1)
    return torch.where(cover > MIN_COVER, (total / cover).exp(), torch.nan)


def children_map(params: Mapping[str, Tensor], counts: Tensor, *view, **options) -> Tensor:
    """Number of children of the Gaussians that make up each pixel, a geometric mean. counts: n per axis, [N, 3]

    Returns:
        ≥ 1; NaN where hardly anything is drawn. [H, W]
    """
    total, cover = blend(params, num_children(counts)[:, None].float().log(), *view, **options)
    return torch.where(cover > MIN_COVER, (total / cover).exp(), torch.nan)[..., 0]


def share_map(params: Mapping[str, Tensor], chosen: Tensor, *view, **options) -> Tensor:
    """How much of what is drawn at each pixel the chosen Gaussians are. chosen: bool [N]

    Returns:
        In [0, 1]; NaN where hardly anything is drawn. [H, W]
    """
    total, cover = blend(params, chosen[:, None].float(), *view, **options)
    return torch.where(cover > MIN_COVER, total / cover, torch.nan)[..., 0]


def random_colors(number: int, generator: torch.Generator) -> Tensor:
    """Bright colours that tell neighbouring Gaussians apart. [N, 3]"""
    hue, saturation, value = torch.rand((3, number), generator=generator)
    return torch.from_numpy(
        hsv_to_rgb(torch.stack([hue, 0.35 + 0.65 * saturation, 0.5 + 0.5 * value], -1).numpy())
    ).float()


def recolor(colors: Tensor, origins: Tensor, generator: torch.Generator) -> Tensor:
    """Colours after a densification step: those that are whole keep theirs, children get new ones.

    Args:
        colors: Before the step. [N, 3]
        origins: The Gaussian of before that each one was or came from. int64 [M]
        generator: On the CPU.

    Returns:
        [M, 3]
    """
    is_child = torch.bincount(origins, minlength=len(colors))[origins] > 1  # [M]
    return torch.where(is_child[:, None], random_colors(len(origins), generator).to(colors), colors[origins])


@lru_cache(maxsize=8)
def _font(size: int) -> ImageFont.FreeTypeFont:
    from matplotlib.font_manager import findfont

    return ImageFont.truetype(findfont("DejaVu Sans"), size)


@lru_cache(maxsize=8)
def _bar(scale: Scale, width: int, height: int) -> Image.Image:
    ramp = scale.colormap(np.linspace(0, 1, width), bytes=True)[None, :, :3]
    return Image.fromarray(np.repeat(ramp, height, axis=0))


def annotate(picture: Picture, text: str, scale: Scale | None = None) -> Picture:
    """A picture with a line of text, and the scale's colours and numbers, at its upper edge.

    For the viewer, whose pictures have no margin, and whose axes lie at the lower edge; tiny ones stay as they are.
    """
    height, width = picture.shape[:2]
    if height < 120 or width < 160:
        return picture
    size = max(min(height // 30, width // 40), 9)
    size = max(min(size, int(size * (width - 2 * size) / _font(size).getlength(text))), 6)  # the whole text is seen
    strip = 4 * size if scale is not None else 2 * size
    image = Image.fromarray(picture)
    image.paste((20, 20, 20), (0, 0, width, strip))
    pen, font, x0 = ImageDraw.Draw(image), _font(size), size
    pen.text((x0, size // 3), text, fill="white", font=font)
    if scale is None:
        return np.array(image)
    length = width - 4 * size
    image.paste(_bar(scale, length, size // 2), (x0, 2 * size - size // 4))
    for tick in scale.ticks:
        half = font.getlength(f"{tick:g}") / 2
        x = max(x0 + float(scale.norm(tick)) * length, half + 1)
        pen.text((x, strip - size - size // 2), f"{tick:g}", fill="white", font=font, anchor="ma")
    return np.array(image)


@dataclass(frozen=True)
class Panel:
    """A picture of a figure."""

    title: str
    picture: Picture
    scale: Scale | None = None


def draw(path: Path, panels: Sequence[Panel], columns: int | None = None) -> None:
    """Write pictures side by side as PNG, each with its title and a colour bar.

    Args:
        path: Written whole or not at all.
        panels: At least one.
        columns: None puts all in one row.

    Raises:
        WriteError: If it cannot be written.
    """
    from matplotlib.figure import Figure

    columns = len(panels) if columns is None else columns
    rows = math.ceil(len(panels) / columns)
    height, width = panels[0].picture.shape[:2]
    side = 8.0 if len(panels) == 1 else 4.5
    bar_width = 1.2 if any(panel.scale is not None for panel in panels) else 0.0
    size = (columns * (side + bar_width), rows * (side * height / width + 0.35))
    figure = Figure(figsize=size, layout="compressed")
    for axes, panel in zip(figure.subplots(rows, columns, squeeze=False).flat, panels, strict=False):
        axes.imshow(panel.picture, interpolation="nearest")
        axes.set_title(panel.title, fontsize=10)
        axes.set_axis_off()
        if (scale := panel.scale) is not None:
            bar = figure.colorbar(ScalarMappable(scale.norm, scale.colormap), ax=axes, ticks=scale.ticks)
            bar.ax.set_yticklabels([f"{tick:g} {scale.unit}".strip() for tick in scale.ticks])
            bar.ax.minorticks_off()
            bar.set_label(scale.label)
    with atomic_path(path) as partial:
        figure.savefig(partial, dpi=100, metadata={"Software": None})
