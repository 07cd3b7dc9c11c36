"""A benchmark's results against a baseline: what got worse, by how much, and how much was allowed.

A baseline is a JSON file of rows, named `scene/label`, and their metrics: numbers of a result, averaged over seeds.

    {"fox/sadgs-indoor": {"psnr": {"value": 31.2, "direction": "higher", "tolerance": 0.4}}}

`higher` and `lower` say which way is better; `near` allows no more than the tolerance either way. Where a change is
meant, put the values that the gate prints into the file.
"""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks import table
from benchmarks.protocol import Job
from benchmarks.results import Result

DIRECTIONS = ("higher", "lower", "near")


@dataclass(frozen=True)
class Metric:
    """A metric of one row: its value, one of DIRECTIONS, and the largest move for the worse that passes."""

    value: float
    direction: str
    tolerance: float

    def __post_init__(self) -> None:
        if self.direction not in DIRECTIONS:
            raise ValueError(f"direction must be one of {', '.join(DIRECTIONS)}")
        numbers = (self.value, self.tolerance)
        are_finite = all(type(number) in (int, float) and math.isfinite(number) for number in numbers)
        if not are_finite or self.tolerance < 0:
            raise ValueError("value must be a number, and tolerance one from 0")

    def fails(self, value: float) -> bool:
        """Whether a value is worse than the tolerance allows; one that is no number always is."""
        moved = value - self.value
        worse = {"higher": -moved, "lower": moved, "near": abs(moved)}[self.direction]
        return not worse <= self.tolerance


Baseline = dict[str, dict[str, Metric]]
"""Metrics by name, by row's name."""


def read(path: Path) -> Baseline:
    """Read a baseline; raises ValueError if the file is none."""
    try:
        content = json.loads(path.read_text())
        baseline: Baseline = {}
        for row, metrics in content.items():
            baseline[row] = {name: Metric(**entry) for name, entry in metrics.items()}
        return baseline
    except (OSError, AttributeError, TypeError, ValueError) as error:
        raise ValueError(
            f"{path} is no baseline ({error}); it must hold rows, their metrics, and of each value, direction and "
            "tolerance."
        ) from error


def regressions(baseline: Baseline, jobs: Iterable[Job], results: Iterable[Result]) -> list[str]:
    """Return a sentence for each metric that is worse than the baseline allows.

    A row has a sentence, too, if it is not in the baseline, if no job is of it, or if one of its runs did not end well;
    and so has a metric that a run did not measure.
    """
    good = {result["key"]: result for result in results if result["status"] == "ok"}
    runs: dict[str, list[Result | None]] = defaultdict(list)  # Results of each row's jobs; None if there is no good one
    for job in jobs:
        row = f"{job.scene.name}/{job.row.label}"
        runs[row].append(good.get(job.key))
    lines = [f"{row} is not in the baseline, so nothing judges it; add it." for row in runs if row not in baseline]
    for row, metrics in baseline.items():
        if row not in runs:
            lines.append(f"{row} is missing from the results: no such run was asked for.")
            continue
        measured = [result for result in runs[row] if result is not None]
        asked_for = len(runs[row])
        if len(measured) < asked_for:
            lines.append(f"{row} is missing from the results: {len(measured)} of {asked_for} runs ended well.")
            continue
        for name, metric in metrics.items():
            values = table.values(measured, name)
            if len(values) < len(measured):
                lines.append(f"{row}: {name} was not measured; the baseline has {metric.value:.6g}.")
                continue
            mean = sum(values) / len(values)
            if metric.fails(mean):
                lines.append(f"{row}: {name} {_movement(metric, mean)}")
    return lines


def _movement(metric: Metric, value: float) -> str:
    """How far a value has moved from the baseline's, and how far it may."""
    better = f"{metric.direction} is better"
    if metric.direction == "near":
        better = "either way"
    return (
        f"moved by {value - metric.value:+.4g}, from {metric.value:.6g} to {value:.6g}; "
        f"tolerance {metric.tolerance:.4g} ({better})."
    )


def judge(path: Path, jobs: Sequence[Job], results: Sequence[Result]) -> bool:
    """Print how results compare with the baseline in a file; True if nothing got worse."""
    baseline = read(path)
    lines = regressions(baseline, jobs, results)
    for line in lines:
        print(f"Gate: {line}")
    verdict = "passed"
    if lines:
        verdict = "FAILED"
    count = sum(len(metrics) for metrics in baseline.values())
    print(f"Gate: {verdict}, {count} metrics of {len(baseline)} rows in {path}.")
    return not lines
