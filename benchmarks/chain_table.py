"""The rows of `benchmarks.chain` as a table: means over the held-out photos that registered in every row compared."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks.table import NOTHING, count, grid, number

Row = Mapping[str, Any]
HEADER = [
    "photos", "rows", "registered", "PSNR", "SSIM", "LPIPS", "worst view", "Gaussians",
    "cameras, s", "training, s", "export, s", "left out",
]  # fmt: skip
MEASURES = (("psnr", 0, 2), ("ssim", 1, 4), ("lpips", 2, 4))
"""Measures of a view: their names, their places in a row's `views`, and digits to show."""


def markdown(rows: Sequence[Row], labels: Mapping[str, str] | None = None) -> str:
    """Return a table with a line for each capture and label, means and standard deviations over the seeds.

    `labels` chooses and names the rows' labels; by default all are shown.
    """
    good = [row for row in rows if row["status"] == "ok"]
    shown = labels or {row["label"]: row["label"] for row in good}
    lines = []
    for capture in dict.fromkeys(row["scene"] for row in good):
        here = [row for row in good if row["scene"] == capture and row["label"] in shown]
        common = common_views(here)
        for label, name in shown.items():
            group = [row for row in here if row["label"] == label]
            if group:
                lines.append([capture, name, *_cells(group, common)])
            gained = [{**row, "views": row["gain_views"]} for row in group if "gain_views" in row]
            if gained:
                lines.append([capture, f"{name}, at the photo's exposure", *_cells(gained, common)])
    return grid(HEADER, lines, names=2)


def common_views(rows: Sequence[Row]) -> list[str]:
    """Return the held-out photos that registered in all rows."""
    first, *others = [row["views"] for row in rows]
    return [name for name in first if all(name in views for views in others)]


def mean_of(row: Row, common: Sequence[str], place: int) -> float | None:
    """Return a row's mean of one measure over some views; None if a view lacks it."""
    values = [row["views"][name][place] for name in common]
    if not values or any(value is None for value in values):
        return None
    return statistics.fmean(values)


def _cells(group: Sequence[Row], common: Sequence[str]) -> list[str]:
    registered = sorted({row["registered"] for row in group})
    cells = [f"{'–'.join(map(str, registered))} of {group[0]['photos']}"]
    for _, place, digits in MEASURES:
        cells.append(_spread([mean_of(row, common, place) for row in group], digits))
    worst = [min(row["views"][name][0] for name in common) for row in group if common]
    cells.append(number(min(worst, default=None), 1))
    cells.append(count(statistics.fmean(row["gaussians"] for row in group)))
    for stage in ("cameras", "training", "export"):
        cells.append(number(statistics.median(row["seconds"][stage] for row in group), 1))
    missing = sorted({name for row in group for name in row["views"].keys() | {*row["missing"]}} - {*common})
    cells.append(", ".join(missing) or NOTHING)
    return cells


def _spread(values: Sequence[float | None], digits: int) -> str:
    """Return a mean, and for several seeds their standard deviation."""
    known = [value for value in values if value is not None]
    if not known:
        return NOTHING
    mean = number(statistics.fmean(known), digits)
    if len(known) < 2:
        return mean
    return f"{mean} ± {number(statistics.stdev(known), digits)}"
