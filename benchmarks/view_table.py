"""`python -m benchmarks views RESULTS.jsonl …`: the PSNR of each held-out view, and where it collapses.

The reference of a view is the best label's median over seeds of its PSNR. A view collapses in a run whose PSNR lies
COLLAPSE dB or more under it. With `--references` the runs of these files alone make references, which so stay the same.
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from benchmarks import results, table
from benchmarks.results import Result

COLLAPSE = 3.0
"""Difference from the reference at which a view collapses, in dB."""
Runs = Mapping[str, Sequence[Result]]
"""The runs of one scene by their labels, one a seed."""


def load(paths: Iterable[Path]) -> dict[str, dict[str, list[Result]]]:
    """Read the latest runs by scene and label; those without `view_psnr` are left out with one line on stderr."""
    rows = [row for path in paths for row in results.read(path)]
    found: dict[str, dict[str, list[Result]]] = {}
    without = []
    for row in table.latest(rows):
        if row.get("view_psnr"):
            of_scene = found.setdefault(row["scene"], {})
            of_scene.setdefault(row["label"], []).append(row)
        else:
            without.append(row["key"])
    if without:
        print(f"Runs without view_psnr are skipped, {len(without)} of them, such as {without[0]}.", file=sys.stderr)
    return found


def view_names(scene: str, runs: Iterable[Result]) -> list[str]:
    """Return the names of a scene's held-out views, or their numbers if no run tells names.

    Raises ValueError if two runs have different numbers of views, or different names.
    """
    runs = list(runs)
    numbers = [str(view) for view in range(len(runs[0]["view_psnr"]))]
    lists = [row["view_names"] for row in runs if row.get("view_names")]
    names = next(iter(lists), numbers)
    same_names = all(others == names for others in lists)
    same_number = all(len(row["view_psnr"]) == len(names) for row in runs)
    if not same_names or not same_number:
        raise ValueError(f"the runs of {scene} hold out different views; give files of one split at a time.")
    return names


def references(runs: Runs) -> list[float]:
    """Return the best label's median over seeds of each view's PSNR in dB, empty without runs."""
    medians = []
    for group in runs.values():
        medians.append([statistics.median(view) for view in _by_view(group)])
    return [max(view) for view in zip(*medians, strict=True)]


def collapsed(group: Sequence[Result], reference: Sequence[float]) -> list[tuple[int, Any]]:
    """Return the pairs of a view's number and a seed in which one label's view collapses."""
    pairs = []
    for view, best in enumerate(reference):
        for row in group:
            difference = round(best - row["view_psnr"][view], 6)  # floats make 30.1 − 27.1 less than 3
            if difference >= COLLAPSE:
                pairs.append((view, row["seed"]))
    return pairs


def markdown(scene: str, runs: Runs, names: Sequence[str], reference: Sequence[float]) -> str:
    """Return a scene's table of views, with means over seeds ± standard deviations in dB, and a line for each label.

    The reference of each view is in dB; there is none where nothing is known to compare with.
    """
    every = [row for group in runs.values() for row in group]
    lines = []
    for i, name in enumerate(names):
        cells = [_mean_and_deviation(_by_view(group)[i]) for group in runs.values()]
        lines.append([name, _known_angle(every, i), *cells])
    text = [f"## {scene}", "", table.grid(["View", "Angle °", *runs], lines), ""]
    for label, group in runs.items():
        median = statistics.median(statistics.fmean(view) for view in _by_view(group))
        lowest, worst = min((psnr, i) for row in group for i, psnr in enumerate(row["view_psnr"]))
        verdict = "there is no reference"
        if reference:
            pairs = [f"{names[i]} (seed {seed})" for i, seed in collapsed(group, reference)]
            verdict = f"collapsed: {', '.join(pairs) or 'none'}"
        text.append(f"- {label}: median {median:.2f} dB; worst view {names[worst]}, {lowest:.2f} dB; {verdict}")
    return "\n".join(text)


def _by_view(group: Sequence[Result]) -> list[tuple[float, ...]]:
    return list(zip(*(row["view_psnr"] for row in group), strict=True))


def _known_angle(rows: Iterable[Result], view: int) -> str:
    """The median of the angles in degrees that rows have of a view."""
    angles = []
    for row in rows:
        angle = None
        if row.get("view_angles"):
            angle = row["view_angles"][view]
        if angle is not None:
            angles.append(angle)
    if not angles:
        return table.NOTHING
    return f"{statistics.median(angles):.1f}"


def _mean_and_deviation(values: Sequence[float]) -> str:
    mean = f"{statistics.fmean(values):.2f}"
    if len(values) < 2:
        return mean
    return f"{mean} ± {statistics.stdev(values):.2f}"


@dataclass
class Command:
    """Print the PSNR of held-out views, and which lie 3 dB or more under the best label's median."""

    results: Positional[tuple[Path, ...]]
    """files that python -m benchmarks wrote"""
    references: tuple[Path, ...] = ()
    """files whose runs alone make the references (default: the results)"""

    def __call__(self) -> int:
        counts: dict[str, tuple[int, int]] = {}  # collapsed pairs, and all that have a reference
        scenes = load(self.results)
        frozen = scenes
        if self.references:
            frozen = load(self.references)
        for scene, runs in scenes.items():
            others = frozen.get(scene, {})
            names = view_names(scene, [row for group in (*runs.values(), *others.values()) for row in group])
            reference = references(others)
            print(markdown(scene, runs, names, reference), end="\n\n")
            for label, group in runs.items():
                bad, judged = counts.get(label, (0, 0))
                bad += len(collapsed(group, reference))
                judged += len(group) * len(reference)
                counts[label] = (bad, judged)
        for label, (bad, judged) in counts.items():
            print(f"{label}: {bad} of {judged} (view, run) pairs collapsed")
        return 0
