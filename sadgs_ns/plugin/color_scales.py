"""Colour scales of the quantities that are shown, and pictures with a scale beside them.

The colour maps are those of matplotlib that colour-blind readers can tell apart. Its figures and fonts, which take a
fifth of a second to import, are imported where they are drawn: training needs none.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, LogNorm, Normalize
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from sadgs_ns.atomic import atomic_path

Picture = NDArray[np.uint8]
"""RGB. [H, W, 3]"""

NOTHING = "black"
"""Colour of pixels without a value: no scale has it. Grey is in the middle of cividis, and, to the colour-blind, of
viridis."""


@dataclass(frozen=True)
class Scale:
    """A colour scale, which says what colour a value has, and what a legend says of it."""

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
        """What maps values to [0, 1]; values beyond the ends get the colours of the ends."""
        return (LogNorm if self.log else Normalize)(self.low, self.high, clip=True)

    @property
    def colormap(self) -> Colormap:
        """What maps [0, 1] to colours."""
        return matplotlib.colormaps[self.colors].with_extremes(bad=NOTHING)

    def __call__(self, values: Tensor) -> Picture:
        """Colour a map of values.

        Args:
            values: Values in the scale's unit; NaN becomes black. [H, W]

        Returns:
            The coloured map. [H, W, 3]
        """
        shown = self.norm(np.ma.masked_invalid(values.detach().float().cpu().numpy()))
        return self.colormap(shown, bytes=True)[..., :3]  # type: ignore[return-value]


PERIOD = Scale("period of the texture", "viridis", 3, 60, (3, 5, 10, 20, 40), unit="px")
ETA = Scale("largest η", "PuOr_r", 1 / 30, 30, (0.03, 0.1, 0.3, 1, 3, 10, 30))
"""The scale is centred at 1: violet Gaussians are finer than the texture, orange ones violate."""
CHILDREN = Scale("children, 16 or more at the end", "cividis", 1, 16, (1, 2, 4, 8, 16))
LOW = Scale("share of consistently low Gaussians", "cividis", 0, 1, (0, 0.25, 0.5, 0.75, 1), log=False)


def to_picture(image: Tensor) -> Picture:
    """Return an image in [0, 1], [H, W, 3], as a picture; values beyond are cut."""
    return (255 * image.detach().float().clamp(0, 1)).round().byte().cpu().numpy()


@lru_cache(maxsize=8)
def _font(size: int) -> ImageFont.FreeTypeFont:
    from matplotlib.font_manager import findfont

    return ImageFont.truetype(findfont("DejaVu Sans"), size)


@lru_cache(maxsize=8)
def _bar(scale: Scale, width: int, height: int) -> Image.Image:
    ramp = scale.colormap(np.linspace(0, 1, width), bytes=True)[None, :, :3]
    return Image.fromarray(np.repeat(ramp, height, axis=0))


def annotate(picture: Picture, text: str, scale: Scale | None = None) -> Picture:
    """Return a picture with a line of text, and the scale's colours and numbers, at its upper edge.

    The viewer's pictures have no margin, and its axes lie at the lower edge. Pictures under 160×120 px stay as they
    are.

    Args:
        picture: The picture, which is not changed. [H, W, 3]
        text: One line.
        scale: The scale to show, or None for the text alone.

    Returns:
        A picture of the same size. [H, W, 3]
    """
    height, width = picture.shape[:2]
    if height < 120 or width < 160:
        return picture
    size = max(min(height // 30, width // 40), 9)
    size = max(min(size, int(size * (width - 2 * size) / _font(size).getlength(text))), 6)  # The whole text fits.
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
    """A picture of a figure, with its title and scale."""

    title: str
    picture: Picture
    scale: Scale | None = None


def draw(path: Path, panels: Sequence[Panel], columns: int | None = None) -> None:
    """Write pictures side by side as PNG, each with its title and a colour bar.

    Args:
        path: The file, which is written whole or not at all.
        panels: The pictures, at least one.
        columns: Pictures in a row; None puts all in one row.

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
