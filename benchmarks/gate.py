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

DIRECTIONS = ("higher", "lower", "near")
NEW_METRICS = {"psnr": ("higher", 0.4), "ssim": ("higher", 0.01), "lpips": ("lower", 0.01), "gaussians": ("near", 0.04)}
"""Direction and tolerance of metrics in a row that the baseline lacks; that of the count is relative to it. About the
largest half-range between two seeds in docs/results.md: a start, to be set from one's own seeds."""


@dataclass(frozen=True)
class Metric:
    """A metric of one row."""

    value: float
    direction: str
    """One of `DIRECTIONS`."""
    tolerance: float
    """Largest move for the worse that passes, in the metric's unit."""

    def fails(self, value: float) -> bool:
        """Whether a value is worse than the tolerance allows; one that is no number always is."""
        moved = value - self.value
        worse = {"higher": -moved, "lower": moved, "near": abs(moved)}[self.direction]
        return not worse <= self.tolerance


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
    return {row: _metrics(metrics, f"{path}: {row}") for row, metrics in content.items()}


def _metrics(metrics: Any, where: str) -> dict[str, Metric]:
    if not isinstance(metrics, dict) or not metrics:
        raise ValueError(f"{where} must be an object with a metric or more.")
    for name, entry in metrics.items():
        if not isinstance(entry, dict) or entry.keys() != {"value", "direction", "tolerance"}:
            raise ValueError(f"{where}, {name} must have value, direction and tolerance, and nothing else.")
        if entry["direction"] not in DIRECTIONS:
            raise ValueError(f"{where}, {name}: direction must be one of {', '.join(DIRECTIONS)}.")
        numbers = entry["value"], entry["tolerance"]
        if not all(type(n) in (int, float) and math.isfinite(n) for n in numbers) or entry["tolerance"] < 0:
            raise ValueError(f"{where}, {name}: value must be a number, and tolerance one from 0.")
    return {name: Metric(**entry) for name, entry in metrics.items()}


def write(path: Path, baseline: Baseline) -> None:
    """Write a baseline; the file appears complete or not at all."""
    from sadgs_ns.atomic import atomic_path

    content = {
        row: {name: dataclasses.asdict(metric) for name, metric in metrics.items()} for row, metrics in baseline.items()
    }
    with atomic_path(path) as partial:
        partial.write_text(json.dumps(content, indent=2) + "\n")


def regressions(baseline: Baseline, jobs: Iterable[Job], results: Iterable[Result]) -> list[str]:
    """What is worse than the baseline allows, a line each; also rows and metrics that were not measured.

    Args:
        jobs: The runs that should have been made.
        results: What they gave, and perhaps other results.
    """
    runs = _runs(jobs, results)
    lines = []
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


def updated(baseline: Baseline, jobs: Iterable[Job], results: Iterable[Result]) -> Baseline:
    """The baseline with the results' values; directions and tolerances stay, and so do rows that were not asked for.

    Rows that are new get `NEW_METRICS`, as far as they were measured.

    Raises:
        ValueError: A row's runs have not all ended well, or a metric was not measured.
    """
    new = dict(baseline)
    for row, group in _runs(jobs, results).items():
        measured = [result for result in group if result is not None]
        if len(measured) < len(group):
            raise ValueError(f"{row}: {len(group) - len(measured)} of {len(group)} runs have no result; finish them.")
        if row in baseline:
            means = {name: _mean(measured, name) for name in baseline[row]}
            for name, mean in means.items():
                if mean is None:
                    raise ValueError(f"{row}: {name} was not measured; measure it or take it out of the baseline.")
            entries = {name: dataclasses.replace(baseline[row][name], value=_rounded(means[name])) for name in means}
        else:
            entries = {}
            for name, (direction, tolerance) in NEW_METRICS.items():
                if (mean := _mean(measured, name)) is not None:
                    scale = mean if name == "gaussians" else 1.0
                    entries[name] = Metric(_rounded(mean), direction, _rounded(tolerance * scale))
        new[row] = entries
    return new


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
    """Rewrite the values in a baseline's file, or make one.

    Raises:
        ValueError: As `read` and `updated`; the file is then as it was.
    """
    old = read(path) if path.exists() else {}
    new = updated(old, jobs, results)
    write(path, new)
    added = [row for row in new if row not in old]
    print(f"{path}: {len(new)} rows.")
    if added:
        print(f"New rows have default tolerances, to be set from several seeds: {', '.join(added)}.")


def _runs(jobs: Iterable[Job], results: Iterable[Result]) -> dict[str, list[Result | None]]:
    """By row, the result of each run, None where there is none that is ok."""
    ok = {result["key"]: result for result in results if result["status"] == "ok"}
    runs: dict[str, list[Result | None]] = {}
    for job in jobs:
        runs.setdefault(f"{job.scene.name}/{job.row.label}", []).append(ok.get(job.key))
    return runs


def _mean(group: Sequence[Result], name: str) -> float | None:
    values = [result.get(name) for result in group]
    return None if None in values else statistics.fmean(values)  # type: ignore[arg-type]


def _rounded(value: float | None) -> float:
    return float(f"{value:.6g}")
