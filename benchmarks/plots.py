"""Plots of a benchmark's results: quality against time and against the number of Gaussians, and where the time goes.

Every method has a colour (Okabe–Ito), a marker and a line style of its own on all plots, every stage a colour and a
hatch, so that none needs the colour. 7.2 in wide with text of 8 pt and more: true to size on a page of A4 or letter.
"""

from __future__ import annotations

import io
import itertools
import json
import math
import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.text import Annotation
from matplotlib.ticker import EngFormatter, Formatter, FuncFormatter, LogLocator, MaxNLocator, NullLocator
from matplotlib.transforms import Bbox
from PIL import Image

from benchmarks.results import Result
from benchmarks.table import mean

Groups = dict[tuple[str, str], list[Result]]
"""Results that are ok by scene and label, as `table.groups` gives them."""

METRICS = {"psnr": ("PSNR [dB]", True), "ssim": ("SSIM", True), "lpips": ("LPIPS", False)}
"""Axis title, and whether higher is better."""
COSTS = {"loop_seconds": "Training loop [s]   (← less is better)", "gaussians": "Gaussians   (← fewer is better)"}
"""Fields that quality is drawn against, with the title of their axis."""
PEER_METRICS = ("psnr", "lpips")
"""The fields of METRICS that `peers` draws, in the order of `Point`."""
STAGES = {
    "import_seconds": "import",
    "setup_seconds": "setup",
    "initialization_seconds": "initialization",
    "load_seconds": "load images",
    "structure_tensor_seconds": "structure tensors",
    "loop_seconds": "training loop",
}

_OKABE_ITO = ("#0072B2", "#D55E00", "#009E73", "#000000", "#CC79A7", "#56B4E9", "#E69F00")  # yellow is too light
_MARKERS = "os^DvPX*<>phd"
_FILLS = ("full", "none", "left", "top", "right", "bottom")
_LINES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)))
_STAGE_COLORS = ("#DDDDDD", "#E69F00", "#009E73", "#F0E442", "#CC79A7", "#56B4E9", "#D55E00", "#0072B2")
_HATCHES = ("....", "////", "xxxx", "\\\\\\\\", "++++", "", "----", "oooo")
_SHOWN_BELOW = {"psnr": 5.0, "ssim": 0.15, "lpips": 0.2}
"""How much worse than the worst final value a curve's beginning may be and still be shown."""

_INK, _GREY = "#222222", "#767676"
_WIDTH, _BAR = 7.2, 0.25
_LEAST_RATIO = 5.0
"""Between the ends of a logarithmic axis; the ticks below then are at least three."""
_TICKS = {12: (1, 2, 3, 5), 50: (1, 2, 5), 500: (1, 3)}
"""Where a logarithmic axis has ticks within a decade, by the ratio that its ends stay below."""
_RC: Any = {
    "font.size": 8,
    "axes.titlesize": 9,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": _GREY,
    "axes.labelcolor": _INK,
    "text.color": _INK,
    "xtick.color": _INK,
    "ytick.color": _INK,
    "axes.xmargin": 0.08,
    "axes.ymargin": 0.08,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e4e4e4",
    "grid.linewidth": 0.6,
    "lines.markersize": 6,
    "hatch.linewidth": 0.5,
    "legend.frameon": False,
    "figure.labelsize": 8,
    "figure.constrained_layout.use": True,
    "text.parse_math": False,  # a label may hold dollars
    "svg.hashsalt": "sadgs-bench-report",  # the same results give the same bytes
    "savefig.facecolor": "white",
}
_FRONT: dict[str, Any] = {"color": _GREY, "linewidth": 1.0, "drawstyle": "steps-post", "zorder": 1}
_styled = matplotlib.rc_context(_RC)


@dataclass(frozen=True)
class Style:
    """How a method is drawn; colours and line styles repeat, a marker with its filling does not before 78 methods."""

    color: str
    marker: str
    fill: str
    line: Any

    def line2d(self, **changes: Any) -> dict[str, Any]:
        """Arguments of `Axes.plot`."""
        looks = {"color": self.color, "marker": self.marker, "fillstyle": self.fill, "linestyle": self.line}
        return {**looks, "markerfacecoloralt": "white", **changes}


class Point(NamedTuple):
    """The end of a run, as `peers` draws it."""

    name: str
    """Its first word is that of the method."""
    here: bool
    """Whether it ran on the machine that most points share."""
    cost: float
    psnr: float
    lpips: float

    @property
    def method(self) -> str:
        """What points of one look have in common."""
        return self.name.split()[0].rstrip(",")


class Growth(NamedTuple):
    """Milliseconds of a training step of one view; None where the memory was too small."""

    gaussians: int
    megapixels: float
    ours_ms: float | None
    gsplat_ms: float | None


def styles(labels: Iterable[str]) -> dict[str, Style]:
    """A style for each label, in their order."""
    fills = itertools.cycle(itertools.product(_FILLS, _MARKERS))
    looks = zip(itertools.cycle(_OKABE_ITO), fills, itertools.cycle(_LINES), strict=False)
    return {
        label: Style(color, marker, fill, line)
        for label, (color, (fill, marker), line) in zip(dict.fromkeys(labels), looks, strict=False)
    }


def pareto_front(points: Iterable[tuple[float, float]], higher_is_better: bool) -> list[tuple[float, float]]:
    """The points (cost, quality) that no other point beats: none costs as little or less with better quality.

    Returns:
        By rising cost; of equal points one.
    """
    sign = 1 if higher_is_better else -1
    front: list[tuple[float, float]] = []
    for cost, quality in sorted(points, key=lambda point: (point[0], -sign * point[1])):
        if not front or sign * quality > sign * front[-1][1]:
            front.append((cost, quality))
    return front


@_styled
def quality_time(groups: Groups, looks: dict[str, Style]) -> Figure:
    """PSNR, SSIM and LPIPS against training seconds, a row of panels a scene: a line where runs have a curve."""
    figure, panels = _quality_panels(groups)
    for (scene, metric), axes in panels.items():
        finals = [
            point
            for label, group in _of_scene(groups, scene)
            for point in _final_points(axes, group, "loop_seconds", metric, looks[label])
        ]
        for label, group in _of_scene(groups, scene):
            for row in group if len(group) > 1 else []:
                look = looks[label].line2d(alpha=0.3, linewidth=0.7, marker="")
                _plot(axes, _near(_curve([row], metric), finals, metric), look)
            _plot(axes, _near(_curve(group, metric), finals, metric), looks[label].line2d(markersize=3.5))
    _finish(panels, FuncFormatter(lambda x, _: f"{x:g}"))
    lines = any(row.get("curve") for group in groups.values() for row in group)
    _finish_figure(
        figure, f"Training loop [s]   ({_time_remark(groups)})", _method_handles(groups, looks, lines), lines
    )
    return figure


@_styled
def quality_count(groups: Groups, looks: dict[str, Style]) -> Figure:
    """PSNR, SSIM and LPIPS against the number of Gaussians, a row of panels a scene, with the Pareto front."""
    figure, panels = _quality_panels(groups)
    means = {
        (scene, metric): [
            point
            for label, group in _of_scene(groups, scene)
            for point in _final_points(axes, group, "gaussians", metric, looks[label])
        ]
        for (scene, metric), axes in panels.items()
    }
    _finish(panels, EngFormatter(sep=""))
    for (scene, metric), axes in panels.items():
        if front := pareto_front(means[scene, metric], METRICS[metric][1]):
            worst, right = axes.get_ylim()[0 if METRICS[metric][1] else 1], axes.get_xlim()[1]
            steps = [(front[0][0], worst), *front, (right, front[-1][1])]
            axes.plot(*zip(*steps, strict=True), **_FRONT, scalex=False, scaley=False)
    handles = [
        *_method_handles(groups, looks, lines=False),
        Line2D([], [], **_FRONT, label="Pareto front of the means"),
    ]
    _finish_figure(figure, "Gaussians   (← fewer is better)", handles, lines=False)
    return figure


@_styled
def time_breakdown(groups: Groups) -> Figure:
    """Stacked bars, one a scene and label, means over seeds: seconds by stage and, if recorded, ms a step by phase."""
    parts = [(groups, STAGES, f"Seconds a run   ({_time_remark(groups)})")]
    phases = {key: [row["phases"] for row in group if row.get("phases")] for key, group in groups.items()}
    if any(phases.values()):
        names = dict.fromkeys(name for rows in phases.values() for row in rows for name in row)
        titles = {name: name.replace("_", " ") for name in names}
        parts.append((phases, titles, f"Milliseconds a training step   ({_time_remark(groups)})"))
    ticks = {label: textwrap.fill(label, 26) for _, label in groups}
    bar = max(0.25, 0.08 + 0.13 * max(1 + tick.count("\n") for tick in ticks.values()))
    height = 0.36 * len(_scenes(groups)) + bar * len(groups) + 0.9
    figure = Figure(figsize=(_WIDTH, height * len(parts)))
    for part, (measured, names, title) in zip(
        figure.subfigures(len(parts), 1, squeeze=False)[:, 0], parts, strict=True
    ):
        _stacked_bars(part, measured, names, title, ticks)
    return figure


def _stacked_bars(figure: SubFigure, groups: Groups, names: dict[str, str], title: str, ticks: dict[str, str]) -> None:
    """A panel a scene, a bar a label (as in `ticks`), a segment a field of `names` (field: what to call it)."""
    counts = {scene: len(_of_scene(groups, scene)) for scene in _scenes(groups)}
    panels = figure.subplots(len(counts), 1, sharex=True, squeeze=False, height_ratios=list(counts.values()))[:, 0]
    looks = {
        name: {"facecolor": color, "hatch": hatch, "edgecolor": _INK, "linewidth": 0}
        for name, color, hatch in zip(names, itertools.cycle(_STAGE_COLORS), itertools.cycle(_HATCHES), strict=False)
        if any(mean(group, name) for group in groups.values())
    }
    longest = 0.0
    for axes, scene in zip(panels, counts, strict=True):
        for y, (_, group) in enumerate(_of_scene(groups, scene)):
            end = 0.0
            for name, look in looks.items():
                length = mean(group, name) or 0.0
                axes.barh(y, length, 0.7, end, **look)
                end += length
            axes.text(end, y, f" {end:.1f}" if end else " not measured", va="center")
            longest = max(longest, end)
        axes.set_yticks(range(counts[scene]), [ticks[label] for label, _ in _of_scene(groups, scene)])
        axes.set_ylim(counts[scene] - 0.45, -0.55)
        axes.tick_params(axis="y", length=0)
        axes.grid(False, axis="y")
        axes.set_title(scene)
    panels[-1].set_xlabel(title)
    panels[-1].set_xlim(0, 1.1 * longest or 1)
    _legend(figure, [Patch(**look, label=names[name]) for name, look in looks.items()], 2.5)


@_styled
def growth(rows: Sequence[Growth]) -> Figure:
    """Milliseconds of a step against the number of Gaussians, and against pixels, both axes logarithmic.

    Args:
        rows: The first one's size goes with all numbers of Gaussians, and its number with all sizes.
    """
    number, size = rows[0].gaussians, rows[0].megapixels
    figure = Figure(figsize=(_WIDTH, 2.8))
    left, right = figure.subplots(1, 2, sharey=True)
    looks = styles(("ours", "gsplat and torch"))
    panels = (
        (left, [(row.gaussians, row) for row in rows if row.megapixels == size], f"{size:g} megapixels"),
        (right, [(1e6 * row.megapixels, row) for row in rows if row.gaussians == number], f"{number:,} Gaussians"),
    )
    for axes, points, title in panels:
        for label, field in (("ours", "ours_ms"), ("gsplat and torch", "gsplat_ms")):
            timed = sorted((x, getattr(row, field)) for x, row in points if getattr(row, field) is not None)
            axes.plot(*zip(*timed, strict=True), label=label, **looks[label].line2d())
        axes.set(xscale="log", yscale="log", title=title)
        axes.xaxis.set_major_formatter(EngFormatter(sep=""))
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_minor_locator(NullLocator())
        axes.yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:g}"))
    left.set(xlabel="Gaussians", ylabel="Milliseconds a training step")
    right.set_xlabel("Pixels")
    left.legend()
    return figure


@_styled
def peers(cost: str, points: Sequence[Point]) -> Figure:
    """PSNR and LPIPS against a cost on a logarithmic axis, each point with its name; those of other machines hollow.

    Args:
        cost: Field that the points' cost is, of COSTS.
    """
    figure = Figure(figsize=(_WIDTH, 3.0))
    panels = {("", metric): axes for metric, axes in zip(PEER_METRICS, figure.subplots(1, 2), strict=True)}
    looks = styles(point.method for point in points)
    for (_, metric), axes in panels.items():
        for point in points:
            look = looks[point.method].line2d(linestyle="", fillstyle="full" if point.here else "none")
            axes.plot(point.cost, getattr(point, metric), **look)
    _finish(panels, EngFormatter(sep=""))
    grey: dict[str, Any] = {"color": _GREY, "marker": "o", "linestyle": ""}
    handles = [Line2D([], [], **grey, label="on one machine")]
    if not all(point.here for point in points):
        handles.append(Line2D([], [], **grey, fillstyle="none", label="on other machines"))
    _finish_figure(figure, COSTS[cost], handles, lines=False)
    figure.draw_without_rendering()  # The panels then have their places, which names must not change.
    for (_, metric), axes in panels.items():
        _name_points(axes, [(point.name, point.cost, getattr(point, metric)) for point in points])
    return figure


def _name_points(axes: Axes, named: Sequence[tuple[str, float, float]]) -> None:
    """Write each point's name beside it, where it covers least of other points, names and what is outside the panel."""
    centres = (axes.transData.transform((x, y)).tolist() for _, x, y in named)
    taken = [Bbox.from_bounds(x - 6, y - 6, 12, 12) for x, y in centres]
    for name, x, y in named:
        places: list[tuple[float, int, Annotation, Bbox]] = []
        for number, (right, up) in enumerate(((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1))):
            aligned: Any = {"ha": ("center", "left", "right")[right], "va": ("center", "bottom", "top")[up]}
            # Diagonally as far as the point's edge; in 1/72 in.
            offset = (right * (6 if not up else 4), up * (6 if not right else 4))
            text = axes.annotate(name, (x, y), offset, textcoords="offset points", in_layout=False, **aligned)
            box = text.get_window_extent()
            covered = sum(_area(Bbox.intersection(box, other)) for other in taken)
            places.append((covered + _area(box) - _area(Bbox.intersection(box, axes.bbox)), number, text, box))
        places.sort(key=lambda place: place[:2])
        taken.append(places[0][3])
        for _, _, text, _ in places[1:]:
            text.remove()


def _area(box: Bbox | None) -> float:
    return 0.0 if box is None else box.width * box.height


def as_text(cost: str, points: Sequence[Point]) -> str:
    """What `peers` draws, for a file to say of what it was drawn."""
    return json.dumps([cost, *points])


def drawn_points(path: Path) -> str | None:
    """What `as_text` gave when a file was drawn; None if there is no such file, or it does not say."""
    if not path.exists():
        return None
    with Image.open(path) as image:
        return image.info.get("Description")


@_styled
def save_peers(cost: str, points: Sequence[Point], path: Path) -> None:
    """Write `peers` as PNG (200 dpi), which holds `as_text`."""
    metadata = {"Software": None, "Description": as_text(cost, points)}
    peers(cost, points).savefig(path, format="png", dpi=200, metadata=metadata)


@_styled
def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG (200 dpi) and as SVG.

    Args:
        path: Without suffix.
    """
    figure.savefig(path.with_suffix(".png"), dpi=200, metadata={"Software": None})
    path.with_suffix(".svg").write_text(svg(figure), encoding="utf-8")


@_styled
def svg(figure: Figure) -> str:
    """A figure as SVG, the same text for the same results."""
    written = io.StringIO()
    figure.savefig(written, format="svg", metadata={"Date": None})
    return written.getvalue()


def _scenes(groups: Groups) -> list[str]:
    return list(dict.fromkeys(scene for scene, _ in groups))


def _of_scene(groups: Groups, scene: str) -> list[tuple[str, list[Result]]]:
    """Labels and results of a scene, the labels in one order for all scenes."""
    return [
        (label, groups[scene, label]) for label in dict.fromkeys(name for _, name in groups) if (scene, label) in groups
    ]


def _quality_panels(groups: Groups) -> tuple[Figure, dict[tuple[str, str], Axes]]:
    """A figure of a row of panels a scene, one a metric."""
    scenes = _scenes(groups)
    figure = Figure(figsize=(_WIDTH, 1.9 * len(scenes) + 0.3))
    grid = figure.subplots(len(scenes), len(METRICS), sharex="row", squeeze=False)
    for scene, row in zip(scenes, grid, strict=True):
        row[0].set_title(scene)
    return figure, dict(zip(itertools.product(scenes, METRICS), grid.flat, strict=True))


def _finite(points: Iterable[tuple[float | None, float | None]]) -> list[tuple[float, float]]:
    """The points that a logarithmic x axis can show."""
    return [
        (x, y) for x, y in points if x is not None and y is not None and math.isfinite(x) and x > 0 and math.isfinite(y)
    ]


def _plot(axes: Axes, points: Iterable[tuple[float | None, float | None]], looks: dict[str, Any]) -> None:
    if shown := _finite(points):
        axes.plot(*zip(*shown, strict=True), **looks)


def _curve(group: list[Result], name: str) -> list[tuple[float | None, float | None]]:
    """Mean (seconds, metric) at the steps that all of a group's curves have, and the end of the runs; empty without."""
    curves = [{point["step"]: point for point in row["curve"]} for row in group if row.get("curve")]
    if not curves:
        return []
    steps = sorted(set.intersection(*map(set, curves)))
    points = [[curve[step] for curve in curves] for step in steps]
    curve = [(mean(point, "seconds"), mean(point, name)) for point in points]
    end = mean(group, "loop_seconds")
    return [*curve, (end, mean(group, name))] if end and all(x is None or x < end for x, _ in curve) else curve


def _final_points(axes: Axes, group: list[Result], cost: str, metric: str, style: Style) -> list[tuple[float, float]]:
    """Draw the runs as small points and their mean as a large one, which is returned, if there is one."""
    for row in group if len(group) > 1 else []:
        _plot(axes, [(row.get(cost), row.get(metric))], style.line2d(alpha=0.4, markersize=3.5, linestyle=""))
    average = [(mean(group, cost), mean(group, metric))]
    _plot(axes, average, style.line2d(zorder=3, linestyle=""))
    return _finite(average)


def _near(
    curve: list[tuple[float | None, float | None]], finals: list[tuple[float, float]], metric: str
) -> list[tuple[float, float]]:
    """A curve without its far worse beginning, so that the ends can be told apart."""
    sign, shown = (1 if METRICS[metric][1] else -1), _finite(curve)
    worst = min((sign * value for _, value in finals or shown), default=0.0)
    return [(x, value) for x, value in shown if sign * value >= worst - _SHOWN_BELOW[metric]]


def _time_remark(groups: Groups) -> str:
    if any(row.get("jobs_per_gpu", 1) > 1 for group in groups.values() for row in group):
        return "runs shared a GPU: times are not comparable"
    return "← less is better"


def _finish(panels: dict[tuple[str, str], Axes], form: Formatter) -> None:
    """Titles, and a logarithmic x axis with two ticks or more."""
    for (_, metric), axes in panels.items():
        title, higher = METRICS[metric]
        axes.set_ylabel(f"{title}   ({'↑' if higher else '↓'} better)")
        axes.yaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10], min_n_ticks=3))
        if not axes.lines:
            axes.text(0.5, 0.5, "not measured", transform=axes.transAxes, ha="center", va="center", color=_GREY)
            axes.set_yticks([])
        if not any(panel.lines for panel in axes.get_shared_x_axes().get_siblings(axes)):
            axes.set_xticks([])
            continue
        axes.set_xscale("log")
        low, high = axes.get_xlim()
        widening = max(1.0, math.sqrt(_LEAST_RATIO / (high / low)))
        axes.set_xlim(low / widening, high * widening)
        ratio = high / low * widening**2
        subs = next((subs for limit, subs in _TICKS.items() if ratio < limit), (1,))
        axes.xaxis.set_major_locator(LogLocator(subs=subs))
        axes.xaxis.set_minor_locator(NullLocator())
        axes.xaxis.set_major_formatter(form)


def _finish_figure(figure: Figure, title: str, handles: Sequence[Artist], lines: bool) -> None:
    """The title of x below all panels and the legend above them, which makes the figure taller."""
    figure.supxlabel(title)
    figure.align_ylabels()
    figure.set_figheight(figure.get_figheight() + _legend(figure, handles, 3.2 if lines else 1.5))


def _method_handles(groups: Groups, looks: dict[str, Style], lines: bool) -> list[Line2D]:
    plain = {} if lines else {"linestyle": ""}
    labels = dict.fromkeys(label for _, label in groups)
    handles = [Line2D([], [], **looks[label].line2d(label=label, **plain)) for label in labels]
    if any(len(group) > 1 for group in groups.values()):
        seeds = {"color": _GREY, "alpha": 0.6, "marker": "o", "markersize": 3.5, "linestyle": ""}
        handles.append(Line2D([], [], **seeds, label="small: single seeds"))
    return handles


def _legend(figure: Figure | SubFigure, handles: Sequence[Artist], length: float) -> float:
    """A legend above the panels in as few lines as fit; returns its height in inches.

    Args:
        length: Of the handles, in units of the font's size.
    """
    labels = [textwrap.fill(str(handle.get_label()), 60) for handle in handles]
    height = 0.0
    for lines in range(max(math.ceil(len(labels) / 6), 1), len(labels) + 1):
        # The texts are set afterwards: matplotlib would leave labels out that start with an underscore.
        names, columns = [str(i) for i in range(len(labels))], math.ceil(len(labels) / lines)
        legend = figure.legend(handles, names, loc="outside upper left", ncols=columns, handlelength=length)
        for text, label in zip(legend.get_texts(), labels, strict=True):
            text.set_text(label)
        box = legend.get_window_extent()
        height = box.height / figure.dpi
        if box.width < 0.98 * figure.bbox.width or columns == 1:
            break
        legend.remove()
    return height
