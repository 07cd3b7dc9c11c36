"""The rows of `benchmarks.cameras` as tables: one of captures, one of drawn ones whose cameras are known."""

from __future__ import annotations

import statistics
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from benchmarks.table import NOTHING, grid, number

Row = Mapping[str, Any]
_HEADER = [
    "photos", "cameras", "last adjustment", "registered", "observations a photo", "between seeds, px", "worst view, px",
    "left out, median px", "mean px", "adjustment, s", "all, s", "cores", "seeds",
]  # fmt: skip
_HEADER_OF_TRUTHS = ["drawn", "cameras", "last adjustment", "centres, % of extent", "rotations, °", "seeds"]


def markdown(rows: Sequence[Row], labels: Mapping[str, str] | None = None) -> str:
    """Return a Markdown table with a line for each capture, label and variant, or "" if there is no line.

    Most numbers are means over seeds or over pairs of seeds. The worst view is the worst of all pairs, and seconds are
    medians over seeds. `labels` gives the labels to show and their names in the table; by default all are shown.
    """
    lines = []
    for names, row in _chosen(rows, labels):
        is_of_capture = "pairs" in row
        if is_of_capture:
            lines.append([*names, *_cells(row)])
    if not lines:
        return ""
    return grid(_HEADER, lines, names=3)


def markdown_of_truths(rows: Sequence[Row], labels: Mapping[str, str] | None = None) -> str:
    """Return a table of the drawn captures as `markdown` does, with means over seeds."""
    lines = []
    for names, row in _chosen(rows, labels):
        if "centres" in row:
            centres = number(statistics.fmean(row["centres"]), 4)
            rotations = number(statistics.fmean(row["rotations"]), 4)
            lines.append([*names, centres, rotations, str(len(row["seeds"]))])
    if not lines:
        return ""
    return grid(_HEADER_OF_TRUTHS, lines, names=3)


def _chosen(rows: Sequence[Row], labels: Mapping[str, str] | None) -> Iterator[tuple[list[str], Row]]:
    """Return the rows that are ok and have one of the labels, capture by capture, each with its names in a table."""
    good = [row for row in rows if row["status"] == "ok"]
    shown = labels or {row["label"]: row["label"] for row in good}
    for capture in dict.fromkeys(row["scene"] for row in good):
        for label, name in shown.items():
            for row in good:
                if (row["scene"], row["label"]) == (capture, label):
                    yield [capture, name, row["variant"]], row


def _cells(row: Row) -> list[str]:
    registered = sorted(set(row["registered"]))
    cells = [f"{'–'.join(map(str, registered))} of {row['photos']}"]
    cells.append(f"{statistics.fmean(row['observations']):,.0f}")
    moved = [pair["mean"] for pair in row["pairs"]]
    worst = [pair["worst"] for pair in row["pairs"]]
    mean = None
    if moved:
        mean = statistics.fmean(moved)
    cells.append(number(mean, 3))
    cells.append(number(max(worst, default=None), 3))
    for measure in ("median", "mean"):
        cells.append(number(statistics.fmean(errors[measure] for errors in row["left_out"]), 3))
    seconds = row.get("seconds")
    if seconds:
        cells.append(number(statistics.median(stages["adjustment"] for stages in seconds), 1))
        cells.append(number(statistics.median(sum(stages.values()) for stages in seconds), 1))
        cells.append(str(row["cores"]))
    else:  # They were measured on a machine that did other work, too.
        cells += [NOTHING, NOTHING, NOTHING]
    cells.append(str(len(row["seeds"])))
    return cells
