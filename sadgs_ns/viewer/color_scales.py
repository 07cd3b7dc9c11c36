"""Colour scales, their legends, and pictures with a scale beside them.

The colour maps are those of matplotlib that colour-blind readers can tell apart. Importing matplotlib takes a third of
a second, and training needs it only while a viewer shows a map. So the functions here import it.
"""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from sadgs_ns.files import atomic_path

if TYPE_CHECKING:
    from matplotlib.colorbar import Colorbar
    from matplotlib.colors import Colormap, Normalize
    from matplotlib.figure import Figure

Picture = NDArray[np.uint8]  # RGB. [H, W, 3]

NOTHING = "black"  # Colour of pixels without a value. No scale has it, while cividis has grey in its middle


@dataclass(frozen=True)
class Scale:
    """A colour scale for values from `low` to `high`, with its legend."""

    label: str
    colors: str  # Name of a colour map of matplotlib
    low: float
    high: float
    ticks: tuple[float, ...]
    log: bool = True
    unit: str = ""

    @property
    def norm(self) -> Normalize:
        """Maps values to [0, 1]; values beyond the ends get the colours of the ends."""
        from matplotlib.colors import LogNorm, Normalize

        if self.log:
            return LogNorm(self.low, self.high, clip=True)
        return Normalize(self.low, self.high, clip=True)

    @property
    def colormap(self) -> Colormap:
        """Maps [0, 1] to colours."""
        import matplotlib

        return matplotlib.colormaps[self.colors].with_extremes(bad=NOTHING)

    def __call__(self, values: Tensor) -> Picture:
        """Colour a map of values in the scale's unit; NaN becomes black. [H, W] → [H, W, 3]"""
        known = np.ma.masked_invalid(values.detach().float().cpu().numpy())
        rgba: Any = self.colormap(self.norm(known), bytes=True)  # [H, W, 4]
        return rgba[..., :3]


PERIOD = Scale("period of the texture", "viridis", 3, 60, (3, 5, 10, 20, 40), unit="px")
ETA = Scale("largest η", "PuOr_r", 1 / 30, 30, (1 / 30, 0.1, 0.3, 1, 3, 10, 30))
"""The scale is centred at 1: violet Gaussians are finer than the texture, orange ones violate."""
CHILDREN = Scale("children, 16 or more at the end", "cividis", 1, 16, (1, 2, 4, 8, 16))
LOW = Scale("share of consistently low Gaussians", "cividis", 0, 1, (0, 0.25, 0.5, 0.75, 1), log=False)


def to_picture(image: Tensor) -> Picture:
    """Return an image, clamped to [0, 1], as a picture. [H, W, 3]"""
    clamped = image.detach().float().clamp(0, 1)
    return (255 * clamped).round().byte().cpu().numpy()


def legend(text: str, scale: Scale | None = None) -> str:
    """Return Markdown with a line of text and, if a scale is given, an image of its colours and numbers."""
    if scale is None:
        return text
    png = base64.b64encode(bar(scale)).decode()
    return f"{text}\n\n![{scale.label}](data:image/png;base64,{png})"


@lru_cache(maxsize=8)
def bar(scale: Scale) -> bytes:
    """Return a PNG of the scale's colours, 720 px wide, with its numbers below them, to be shown at half that size."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(3.6, 0.45), dpi=200, facecolor="#141414", layout="constrained")
    axes = _add_bar(figure, scale, cax=figure.subplots(), orientation="horizontal").ax
    axes.tick_params(colors="white", labelsize=8, length=0)
    png = io.BytesIO()
    figure.savefig(png, format="png")
    return png.getvalue()


def _add_bar(figure: Figure, scale: Scale, **place: Any) -> Colorbar:
    """Add a bar of colours to a figure; `place` holds arguments of `Figure.colorbar` that say where."""
    from matplotlib.cm import ScalarMappable

    colored = ScalarMappable(scale.norm, scale.colormap)
    number_format = f"%.2g {scale.unit}".rstrip()
    added = figure.colorbar(colored, ticks=scale.ticks, format=number_format, **place)
    added.minorticks_off()
    return added


@dataclass(frozen=True)
class Panel:
    """A picture of a figure, with its title and scale."""

    title: str
    picture: Picture
    scale: Scale | None = None


def draw(path: Path, panels: Sequence[Panel], columns: int) -> None:
    """Write pictures with titles and colour bars, in rows of `columns`, as a PNG; raise WriteError if it fails.

    There must be at least one picture. The room for each has the shape of the first one.
    """
    from matplotlib.figure import Figure

    rows = math.ceil(len(panels) / columns)
    figure = Figure(figsize=_figure_size(panels, rows, columns), layout="compressed")
    all_axes = figure.subplots(rows, columns, squeeze=False).flat
    for axes, panel in zip(all_axes, panels, strict=False):  # The last row may have more axes than pictures.
        axes.imshow(panel.picture, interpolation="nearest")
        axes.set_title(panel.title, fontsize=10)
        axes.set_axis_off()
        if panel.scale is not None:
            _add_bar(figure, panel.scale, ax=axes).set_label(panel.scale.label)
    with atomic_path(path) as partial:
        figure.savefig(partial, dpi=100, metadata={"Software": None})


def _figure_size(panels: Sequence[Panel], rows: int, columns: int) -> tuple[float, float]:
    """Return width and height in inches of a figure with rows of pictures; a single picture is drawn larger."""
    height, width = panels[0].picture.shape[:2]
    picture_width = 4.5
    if len(panels) == 1:
        picture_width = 8.0
    bar_width = 0.0
    if any(panel.scale is not None for panel in panels):
        bar_width = 1.2
    title_height = 0.35
    picture_height = picture_width * height / width
    return columns * (picture_width + bar_width), rows * (picture_height + title_height)
