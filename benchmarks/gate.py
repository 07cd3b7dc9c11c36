"""A benchmark's results against a baseline: what got worse, by how much, and how much was allowed.

A baseline is a JSON file of rows, named `scene/label`, and their metrics: numbers of a result, averaged over seeds.

    {"fox/sadgs-indoor": {"psnr": {"value": 31.2, "direction": "higher", "tolerance": 0.4}}}

`higher` and `lower` say which way is better; `near` allows no more than the tolerance either way. Tolerances are in the
metric's unit.
"""

from __future__ import annotations

import dataclasses
import json
import math
import statistics
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks.protocol import Job
from benchmarks.results import Result
from sadgs_ns.atomic import atomic_path

DIRECTIONS = ("higher", "lower", "near")
NEW_METRICS = {"psnr": ("higher", 0.4), "ssim": ("higher", 0.01), "lpips": ("lower", 0.01), "gaussians": ("near", 0.04)}
"""Direction and tolerance of metrics in a row that the baseline lacks; that of the count is relative to it. About the
largest half-range between two seeds in docs/results.md: a start, to be set from one's own seeds."""


@dataclass(frozen=True)
class Metric:
    """A metric of one row: its value, one of DIRECTIONS, and the largest move for the worse that passes."""

    value: float
    direction: str
    tolerance: float

    def fails(self, value: float) -> bool:
        """Whether a value is worse than the tolerance allows; one that is no number always is."""
        moved = value - self.value
        return not {"higher": -moved, "lower": moved, "near": abs(moved)}[self.direction] <= self.tolerance


Baseline = dict[str, dict[str, Metric]]
"""Metrics by name, by row's name."""


def read(path: Path) -> Baseline:
    """Read a baseline.

    Raises:
        ValueError: The file is not a baseline; one sentence that names the place.
    """
    try:
        content = json.loads(path.read_text())
    except OSError as error:
        raise ValueError(f"{path} cannot be read ({error.strerror}); --update-baseline writes one.") from error
    except ValueError as error:
        raise ValueError(f"{path} is not JSON: {error}.") from error
    if not isinstance(content, dict) or not content:
        raise ValueError(f"{path} must be an object with a row or more, named scene/label.")
    for row, metrics in content.items():
        if not isinstance(metrics, dict) or not metrics:
            raise ValueError(f"{path}: {row} must be an object with a metric or more.")
        for name, entry in metrics.items():
            where = f"{path}: {row}, {name}"
            if not isinstance(entry, dict) or entry.keys() != {"value", "direction", "tolerance"}:
                raise ValueError(f"{where} must have value, direction and tolerance, and nothing else.")
            if entry["direction"] not in DIRECTIONS:
                raise ValueError(f"{where}: direction must be one of {', '.join(DIRECTIONS)}.")
            numbers = entry["value"], entry["tolerance"]
            if not all(type(n) in (int, float) and math.isfinite(n) for n in numbers) or entry["tolerance"] < 0:
                raise ValueError(f"{where}: value must be a number, and tolerance one from 0.")
    return {row: {name: Metric(**entry) for name, entry in metrics.items()} for row, metrics in content.items()}


def regressions(baseline: Baseline, jobs: Iterable[Job], results: Iterable[Result]) -> list[str]:
    """What is worse than the baseline allows, a line each; also rows and metrics that were not measured.

    Args:
        jobs: The runs that should have been made.
        results: What they gave, and perhaps other results.
    """
    runs, lines = _runs(jobs, results), []
    for row, metrics in baseline.items():
        group = runs.get(row, [])
        measured = [result for result in group if result is not None]
        if not group or len(measured) < len(group):
            done = f"{len(measured)} of {len(group)} runs ended well" if group else "no such run was asked for"
            lines.append(f"{row} is missing from the results: {done}.")
            continue
        for name, metric in metrics.items():
            mean = _mean(measured, name)
            if mean is None:
                lines.append(f"{row}: {name} was not measured; the baseline has {metric.value:.6g}.")
            elif metric.fails(mean):
                better = "either way" if metric.direction == "near" else f"{metric.direction} is better"
                lines.append(
                    f"{row}: {name} moved by {mean - metric.value:+.4g}, from {metric.value:.6g} to {mean:.6g}; "
                    f"tolerance {metric.tolerance:.4g} ({better})."
                )
    return lines


def judge(path: Path, jobs: Sequence[Job], results: Sequence[Result]) -> bool:
    """Print how results compare with the baseline in a file; True if nothing got worse."""
    baseline = read(path)
    lines = regressions(baseline, jobs, results)
    for line in lines:
        print(f"Gate: {line}")
    for row in [row for row in _runs(jobs, results) if row not in baseline]:
        print(f"Gate: {row} is not in {path}, so nothing judges it; --update-baseline adds it.")
    count = sum(len(metrics) for metrics in baseline.values())
    print(f"Gate: {'FAILED' if lines else 'passed'}, {count} metrics of {len(baseline)} rows in {path}.")
    return not lines


def renew(path: Path, jobs: Sequence[Job], results: Sequence[Result]) -> None:
    """Rewrite the values in a baseline's file, or make one; directions, tolerances and rows not asked for stay.

    Rows that are new get `NEW_METRICS`, as far as they were measured.

    Raises:
        ValueError: As `read`, a row's runs have not all ended well, or a metric was not measured; the file then stays.
    """
    baseline = read(path) if path.exists() else {}
    new, added = dict(baseline), []
    for row, group in _runs(jobs, results).items():
        measured = [result for result in group if result is not None]
        if len(measured) < len(group):
            raise ValueError(f"{row}: {len(group) - len(measured)} of {len(group)} runs have no result; finish them.")
        means = {name: _mean(measured, name) for name in baseline.get(row, NEW_METRICS)}
        if row not in baseline:
            added.append(row)
            new[row] = {}
            for name, (direction, tolerance) in NEW_METRICS.items():
                if (mean := means[name]) is not None:
                    scaled = tolerance * (mean if name == "gaussians" else 1.0)
                    new[row][name] = Metric(float(f"{mean:.6g}"), direction, float(f"{scaled:.6g}"))
            continue
        for name, mean in means.items():
            if mean is None:
                raise ValueError(f"{row}: {name} was not measured; measure it or take it out of the baseline.")
            new[row] = {**new[row], name: dataclasses.replace(baseline[row][name], value=float(f"{mean:.6g}"))}
    content = {row: {name: dataclasses.asdict(metric) for name, metric in of.items()} for row, of in new.items()}
    with atomic_path(path) as partial:
        partial.write_text(json.dumps(content, indent=2) + "\n")
    print(f"{path}: {len(new)} rows.")
    if added:
        print(f"New rows have default tolerances, to be set from several seeds: {', '.join(added)}.")


def _runs(jobs: Iterable[Job], results: Iterable[Result]) -> dict[str, list[Result | None]]:
    """By row, the result of each run, None where there is none that is ok."""
    ok = {result["key"]: result for result in results if result["status"] == "ok"}
    runs: dict[str, list[Any]] = {}
    for job in jobs:
        runs.setdefault(f"{job.scene.name}/{job.row.label}", []).append(ok.get(job.key))
    return runs


def _mean(group: Sequence[Result], name: str) -> float | None:
    values = [result.get(name) for result in group]
    return None if None in values else statistics.fmean(values)  # type: ignore[arg-type]
