"""Plots of a benchmark's results: quality against time.

Every method has a colour (Okabe–Ito) and a marker of its own on all plots, so that none needs the colour. 7.2 in wide
with text of 8 pt and more: true to size on a page of A4 or letter.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Annotation
from matplotlib.ticker import EngFormatter, LogLocator, MaxNLocator, NullLocator
from matplotlib.transforms import Bbox
from PIL import Image

from benchmarks.results import Result
from benchmarks.table import mean

METRICS = {"psnr": ("PSNR [dB]", True), "ssim": ("SSIM", True), "lpips": ("LPIPS", False)}
"""Axis title, and whether higher is better."""

_OKABE_ITO = ("#0072B2", "#D55E00", "#009E73", "#000000", "#CC79A7", "#56B4E9", "#E69F00")  # yellow is too light
_MARKERS = "os^DvPX*<>ph"
_FILLS: dict[bool, Any] = {True: "full", False: "none"}
"""How markers are filled, by whether the run was on the machine that most share."""
_SIDES = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, 1), (1, -1), (-1, -1))
"""Where a name may stand beside its point, the best place first: 1 is to the right, or above."""
_SHOWN_BELOW = {"psnr": 5.0, "ssim": 0.15, "lpips": 0.2}
"""How much worse than the worst final value a curve's beginning may be and still be shown."""
_GREY = "#767676"
_WIDTH = 7.2
_LEAST_RATIO = 5.0
"""Between the ends of a logarithmic axis; the ticks below then are at least three."""
_TICKS = {12: (1, 2, 3, 5), 50: (1, 2, 5), 500: (1, 3)}
"""Where a logarithmic axis has ticks within a decade, by the ratio that its ends stay below."""
_RC: Any = {
    **{"font.size": 8, "figure.labelsize": 8, "axes.titlesize": 9, "axes.titleweight": "bold"},
    **{"axes.titlelocation": "left", "axes.spines.top": False, "axes.spines.right": False, "axes.edgecolor": _GREY},
    **{"axes.xmargin": 0.08, "axes.ymargin": 0.08, "axes.grid": True, "axes.axisbelow": True},
    **{"grid.color": "#e4e4e4", "grid.linewidth": 0.6, "legend.frameon": False, "savefig.facecolor": "white"},
    "figure.constrained_layout.use": True,
    "text.parse_math": False,  # a label may hold dollars
}
_styled = matplotlib.rc_context(_RC)

Points = list[tuple[float, float]]


def styles(labels: Iterable[str]) -> dict[str, dict[str, Any]]:
    """Options of `Axes.plot` for each label, in their order; none is like another of the first 12."""
    looks = zip(itertools.cycle(_OKABE_ITO), itertools.cycle(_MARKERS), strict=False)
    named = zip(dict.fromkeys(labels), looks, strict=False)
    return {label: {"color": color, "marker": marker} for label, (color, marker) in named}


@_styled
def quality(results: Iterable[tuple[tuple[str, str], Sequence[Result]]], joined: Collection[str] = ()) -> Figure:
    """PSNR, SSIM and LPIPS of scenes and labels against loop seconds, a row of panels a scene.

    Runs that were measured on their way have lines. Of the labels in `joined` the ends of runs of several settings have
    one line together, in the order of the results.
    """
    groups = dict(results)
    scenes = list(dict.fromkeys(scene for scene, _ in groups))
    looks = styles(label for _, label in groups)
    figure = Figure(figsize=(_WIDTH, 1.9 * len(scenes) + 0.6))
    grid = figure.subplots(len(scenes), len(METRICS), sharex="row", squeeze=False)
    for (scene, metric), axes in zip(itertools.product(scenes, METRICS), grid.flat, strict=True):
        here = {label: group for (where, label), group in groups.items() if where == scene}
        _plot_runs(axes, here, metric, looks, joined)
        _finish(axes, metric)
        if metric == "psnr":
            axes.set_title(scene)
    rows = [row for group in groups.values() for row in group]
    line = ""
    if any(row.get("curve") for row in rows):
        line = "-"
    handles = [Line2D([], [], **look, linestyle=line, label=label) for label, look in looks.items()]
    remark = "← less is better"
    timed = [row for row in rows if row.get("loop_seconds") is not None]
    if any(row.get("jobs_per_gpu", 1) > 1 for row in timed):
        remark = "runs shared a GPU: times are not comparable"
    _finish_figure(figure, remark, handles)
    return figure


def _plot_runs(
    axes: Axes, groups: Mapping[str, Sequence[Result]], metric: str, looks: Mapping[str, Any], joined: Collection[str]
) -> None:
    """Plot a metric of one scene's runs by their labels: each seed, the mean, and the curve up to it."""
    ends = {}
    for label, group in groups.items():
        if label in joined:
            ends[label] = _ends_of_settings(group, metric)
        else:
            ends[label] = _known([(mean(group, "loop_seconds"), mean(group, metric))])
    for label, group in groups.items():
        look = looks[label]
        if label in joined:
            _plot(axes, ends[label], **look, markersize=4.5, linestyle=":")
            continue
        seeds = _known([(row.get("loop_seconds"), row.get(metric)) for row in group])
        if len(group) > 1:
            _plot(axes, seeds, **look, alpha=0.4, markersize=3.5, linestyle="")
        _plot(axes, ends[label], **look, linestyle="", zorder=3)
        curve = _without_beginning(_curve(group, metric), itertools.chain(*ends.values()), metric)
        _plot(axes, curve, **look, markersize=3.5)


def _ends_of_settings(group: Sequence[Result], metric: str) -> Points:
    """Return mean (seconds, metric) of the runs of each setting, the settings in their order."""
    by_setting: dict[str, list[Result]] = {}
    for row in group:
        by_setting.setdefault(row["label"], []).append(row)
    return _known((mean(rows, "loop_seconds"), mean(rows, metric)) for rows in by_setting.values())


@_styled
def peers(points: Sequence[tuple[str, bool, float, float, float]]) -> Figure:
    """PSNR and LPIPS against loop seconds, each point with its name.

    Points are a name that begins with the method's, whether it ran on the machine that most share (the others are
    hollow), seconds, PSNR and LPIPS.
    """
    figure = Figure(figsize=(_WIDTH, 3.0))
    methods = [name.split()[0].rstrip(",") for name, *_ in points]
    looks = styles(methods)
    panels = list(zip(figure.subplots(1, 2), ("psnr", "lpips"), (3, 4), strict=True))
    for axes, metric, column in panels:
        for method, point in zip(methods, points, strict=True):
            axes.plot(point[2], point[column], **looks[method], linestyle="", fillstyle=_FILLS[point[1]])
        _finish(axes, metric)
    grey: dict[str, Any] = {"color": _GREY, "marker": "o", "linestyle": ""}
    handles = [Line2D([], [], **grey, label="on one machine")]
    if not all(here for _, here, *_ in points):
        handles.append(Line2D([], [], **grey, fillstyle="none", label="on other machines"))
    _finish_figure(figure, "← less is better", handles)
    figure.draw_without_rendering()  # The panels then have their places, which names must not change.
    for axes, _, column in panels:
        _name_points(axes, [(point[0], point[2], point[column]) for point in points])  # type: ignore[misc]
    return figure


def _name_points(axes: Axes, named: Sequence[tuple[str, float, float]]) -> None:
    """Write each point's name beside it, where it covers least of other points, names and what is outside the panel."""
    centres = (axes.transData.transform((x, y)).tolist() for _, x, y in named)
    taken = [Bbox.from_bounds(x - 6, y - 6, 12, 12) for x, y in centres]
    for name, x, y in named:
        places: list[tuple[float, int, Annotation, Bbox]] = []
        for number, (right, up) in enumerate(_SIDES):
            aligned: Any = {"ha": ("center", "left", "right")[right], "va": ("center", "bottom", "top")[up]}
            distance = 6  # In 1/72 in
            if right and up:  # Diagonally as far as the point's edge
                distance = 4
            offset = (right * distance, up * distance)
            text = axes.annotate(name, (x, y), offset, textcoords="offset points", in_layout=False, **aligned)
            box = text.get_window_extent()
            covered = sum(_area(Bbox.intersection(box, other)) for other in taken)
            outside = _area(box) - _area(Bbox.intersection(box, axes.bbox))
            places.append((covered + outside, number, text, box))
        places.sort(key=lambda place: place[:2])
        taken.append(places[0][3])
        for _, _, text, _ in places[1:]:
            text.remove()


def _area(box: Bbox | None) -> float:
    if box is None:
        return 0.0
    return box.width * box.height


@_styled
def save(figure: Figure, path: Path, digest: str | None = None) -> None:
    """Write a figure as PNG (200 dpi), which may hold a digest of what it was drawn from."""
    figure.savefig(path, format="png", dpi=200, metadata={"Software": None, "Description": digest})


def digest_in(path: Path) -> str | None:
    """The digest that a figure holds; None if there is no such file, or it holds none."""
    if not path.exists():
        return None
    with Image.open(path) as image:
        return image.info.get("Description")


def _known(points: Iterable[tuple[float | None, float | None]]) -> Points:
    """The points that a logarithmic x axis can show."""
    known = [(x, y) for x, y in points if x is not None and y is not None]
    return [(x, y) for x, y in known if math.isfinite(x) and x > 0 and math.isfinite(y)]


def _plot(axes: Axes, points: Points, **looks: Any) -> None:
    if points:
        axes.plot(*zip(*points, strict=True), **looks)


def _curve(group: Sequence[Result], metric: str) -> Points:
    """Mean (seconds, metric) at the steps that all of a group's curves have, the last of which is the run's end."""
    curves = []
    for row in group:
        if row.get("curve"):
            curves.append({point["step"]: point for point in row["curve"]})
    if not curves:
        return []
    means = []
    for step in sorted(set.intersection(*map(set, curves))):
        points = [curve[step] for curve in curves]
        means.append((mean(points, "seconds"), mean(points, metric)))
    return _known(means)


def _without_beginning(curve: Points, ends: Iterable[tuple[float, float]], metric: str) -> Points:
    """A curve without its far worse beginning, so that the ends can be told apart."""
    finals = [value for _, value in ends]
    if not finals:
        return curve
    _, higher = METRICS[metric]
    if higher:
        least = min(finals) - _SHOWN_BELOW[metric]
        return [(x, value) for x, value in curve if value >= least]
    most = max(finals) + _SHOWN_BELOW[metric]
    return [(x, value) for x, value in curve if value <= most]


def _finish(axes: Axes, metric: str) -> None:
    """Titles, and a logarithmic x axis with two ticks or more."""
    title, higher = METRICS[metric]
    arrow = "↓"
    if higher:
        arrow = "↑"
    axes.set_ylabel(f"{title}   ({arrow} better)")
    axes.yaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10], min_n_ticks=3))
    if not axes.lines:
        axes.text(0.5, 0.5, "not measured", transform=axes.transAxes, ha="center", va="center", color=_GREY)
        return
    axes.set_xscale("log")
    low, high = axes.get_xlim()
    widening = max(1.0, math.sqrt(_LEAST_RATIO / (high / low)))
    axes.set_xlim(low / widening, high * widening)
    ratio = high / low * widening**2
    subs = next((subs for limit, subs in _TICKS.items() if ratio < limit), (1,))
    axes.xaxis.set_major_locator(LogLocator(subs=subs))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))


def _finish_figure(figure: Figure, remark: str, handles: Sequence[Line2D]) -> None:
    """The title of x, with a remark, below all panels, and a legend above them."""
    figure.supxlabel(f"Training loop [s]   ({remark})")
    figure.align_ylabels()
    # The texts are set afterwards: matplotlib would leave labels out that start with an underscore.
    names = [str(i) for i in range(len(handles))]
    longest = max(len(str(handle.get_label())) for handle in handles)
    columns = max(1, int(_WIDTH / (0.5 + 0.065 * longest)))  # in, as are the letters' widths
    legend = figure.legend(handles, names, loc="outside upper left", ncols=columns)
    for text, handle in zip(legend.get_texts(), handles, strict=True):
        text.set_text(str(handle.get_label()))
    figure.set_figheight(figure.get_figheight() + 0.18 * (math.ceil(len(handles) / columns) - 1))
