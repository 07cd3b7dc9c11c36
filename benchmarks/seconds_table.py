"""The rows of `benchmarks.seconds` as a table: when each part of a command begins and ends."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from benchmarks.table import grid, groups

Row = Mapping[str, Any]
_HEADER = ["photos", "version", "process", "part", "begins, s", "ends, s", "lasts, s"]


@dataclass(frozen=True)
class Part:
    """A part of a command's work, in seconds since its start."""

    process: str
    name: str
    begin: float
    end: float


def median_parts(rows: Iterable[Row]) -> list[Part]:
    """Return the parts that all runs have, in the order of their beginnings, with medians over the runs.

    A part that a run does several times counts from its first beginning to its last end.
    """
    runs = [_joined(row["parts"]) for row in rows]
    parts = []
    for process, name in runs[0]:
        if all((process, name) in run for run in runs):
            begin = statistics.median(run[process, name][0] for run in runs)
            end = statistics.median(run[process, name][1] for run in runs)
            parts.append(Part(process, name, begin, end))
    return sorted(parts, key=lambda part: part.begin)


def _joined(parts: Iterable[Sequence[Any]]) -> dict[tuple[str, str], tuple[float, float]]:
    """Return the first beginning and the last end of each part of a run, by its process and name."""
    joined: dict[tuple[str, str], tuple[float, float]] = {}
    for process, name, begin, end in parts:
        before = joined.get((process, name), (begin, end))
        joined[process, name] = (min(before[0], begin), max(before[1], end))
    return joined


def markdown(rows: Sequence[Any]) -> str:
    """Return a table with a line for each part of each capture and label, and one for all of them."""
    lines = []
    for (scene, label), group in groups(rows).items():
        for part in median_parts(group):
            lines.append([scene, label, part.process, part.name, *_cells(part.begin, part.end)])
        total = statistics.median(row["seconds"] for row in group)
        on_cores = statistics.median(row["cpu_seconds"] for row in group)
        runs = f"{len(group)} runs, {on_cores:.1f} s on all cores"
        lines.append([scene, label, "all", runs, *_cells(0.0, total)])
    return grid(_HEADER, lines, names=4)


def _cells(begin: float, end: float) -> list[str]:
    return [f"{begin:.2f}", f"{end:.2f}", f"{end - begin:.2f}"]
