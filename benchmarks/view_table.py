"""`python -m benchmarks views RESULTS.jsonl …`: the PSNR of each held-out view, and runs that lie far below others.

A view collapses in a run whose PSNR lies FAR dB or more under the median of the same label's other seeds. The reference
of a view is the best label's median over seeds of its PSNR, and a run's view is far behind if it lies FAR dB or more
under that. With `--references` the runs of these files alone make references, which so stay the same.
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

FAR = 3.0
"""Difference in dB from which on a view collapses, or is far behind."""
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


def far_behind(group: Sequence[Result], reference: Sequence[float]) -> list[tuple[int, Any]]:
    """Return the pairs of a view's number and a seed in which one label's view lies far under its reference."""
    pairs = []
    for view, best in enumerate(reference):
        for row in group:
            if _is_far(row["view_psnr"][view], best):
                pairs.append((view, row["seed"]))
    return pairs


def collapsed(group: Sequence[Result]) -> list[tuple[int, Any]]:
    """Return the pairs of a view's number and a seed in which a view lies far under the label's other seeds.

    A single seed has nothing to compare with.
    """
    pairs = []
    for view, values in enumerate(_by_view(group)):
        for index, row in enumerate(group):
            others = values[:index] + values[index + 1 :]
            if others and _is_far(values[index], statistics.median(others)):
                pairs.append((view, row["seed"]))
    return pairs


def _is_far(psnr: float, reference: float) -> bool:
    """Return whether a PSNR lies FAR dB or more under a reference."""
    return round(reference - psnr, 6) >= FAR  # Floats make 30.1 − 27.1 less than 3.


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
        parts = [f"median {median:.2f} dB", f"worst view {names[worst]}, {lowest:.2f} dB"]
        if reference:
            parts.append(f"far behind: {_listed(names, far_behind(group, reference))}")
        else:
            parts.append("there is no reference")
        if len(group) > 1:
            parts.append(f"collapsed: {_listed(names, collapsed(group))}")
        text.append(f"- {label}: {'; '.join(parts)}")
    return "\n".join(text)


def _listed(names: Sequence[str], pairs: Sequence[tuple[int, Any]]) -> str:
    """Return pairs of a view's number and a seed in words."""
    return ", ".join(f"{names[view]} (seed {seed})" for view, seed in pairs) or "none"


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
    """Print the PSNR of held-out views, and which lie 3 dB or more under other seeds or the best label's median."""

    results: Positional[tuple[Path, ...]]
    """files that python -m benchmarks wrote"""
    references: tuple[Path, ...] = ()
    """files whose runs alone make the references (default: the results)"""

    def __call__(self) -> int:
        behind: dict[str, tuple[int, int]] = {}  # Pairs that are far behind, and all that have a reference.
        lost: dict[str, tuple[int, int]] = {}  # Pairs that collapsed, and all whose label has other seeds.
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
                bad, judged = behind.get(label, (0, 0))
                bad += len(far_behind(group, reference))
                judged += len(group) * len(reference)
                behind[label] = (bad, judged)
                bad, judged = lost.get(label, (0, 0))
                bad += len(collapsed(group))
                if len(group) > 1:
                    judged += len(group) * len(names)
                lost[label] = (bad, judged)
        for label, (bad, judged) in behind.items():
            print(f"{label}: {bad} of {judged} (view, run) pairs are far behind", end="; ")
            bad, judged = lost[label]
            print(f"{bad} of {judged} whose label has other seeds collapsed")
        return 0
