"""The rows of `benchmarks.seconds` as pictures: the parts of a command as bars side by side, over its seconds."""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Sequence
from typing import Any

from matplotlib.figure import Figure

from benchmarks.plots import styles
from benchmarks.seconds_table import median_parts
from benchmarks.table import groups

_WIDTH = 7.2  # in
_HEIGHT_OF_PART = 0.19  # in
_LEAST_SHARE = 0.01  # Shorter parts, as a share of all seconds, are left out


def figures(rows: Sequence[Any]) -> Iterator[tuple[str, Figure]]:
    """Yield a picture for each capture and label that has runs, with a name for its file."""
    for (scene, label), group in groups(rows).items():
        yield f"{scene}-{label}".replace("/", "-"), figure_of(group)


def figure_of(group: Sequence[Any]) -> Figure:
    """Draw the median parts of some runs of one capture: a line for each, and a colour for each process."""
    total = statistics.median(row["seconds"] for row in group)
    parts = [part for part in median_parts(group) if part.end - part.begin >= _LEAST_SHARE * total]
    colours = styles(part.process for part in parts)
    figure = Figure(figsize=(_WIDTH, _HEIGHT_OF_PART * len(parts) + 0.9), layout="constrained")
    axes = figure.subplots()
    for place, part in enumerate(parts):
        length = part.end - part.begin
        axes.barh(place, length, left=part.begin, color=colours[part.process]["color"], height=0.8)
        axes.text(part.end, place, f" {length:.1f}", va="center", fontsize=7)
    axes.set_yticks(range(len(parts)), [f"{part.process}: {part.name}" for part in parts], fontsize=7)
    axes.invert_yaxis()
    axes.set_xlim(0, 1.06 * total)
    axes.axvline(total, color="black", linewidth=0.8)
    axes.set_xlabel("seconds since the command was started")
    row = group[0]
    axes.set_title(f"{row['scene']}, {row['photos']} photos, {row['label']}: {total:.1f} s", loc="left", fontsize=9)
    return figure
