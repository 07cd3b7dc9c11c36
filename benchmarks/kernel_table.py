"""The table of what each kernel brings, from the rows of `python -m benchmarks kernels`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from benchmarks.table import grid


def markdown(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return a line for each kernel, with the loop and the launches of a step of each scene.

    The loop is relative to that with all kernels. Launches are those without and with the kernel. A dash stands where
    nothing was measured.
    """
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    kernels = list(dict.fromkeys(row["label"] for row in rows))
    found = {(row["scene"], row["label"]): row for row in rows}
    header = ["Kernel", "In its place"]
    for scene in scenes:
        header += [f"{scene}: loop", "launches a step"]
    lines = []
    for kernel in kernels:
        of_kernel = [found.get((scene, kernel)) for scene in scenes]
        by = next(row["by"] for row in of_kernel if row is not None)
        cells = [kernel, by]
        for row in of_kernel:
            cells += [_loop(row), _launches(row)]
        lines.append(cells)
    return grid(header, lines, names=2)


def _loop(row: Mapping[str, Any] | None) -> str:
    """Return the loop's ratio, and in brackets its range over the rounds."""
    if row is None:
        return "–"
    if row["status"] != "ok":
        return "failed"
    if "low" not in row or row["low"] == row["high"]:
        return f"{row['ratio']:.3f}"
    return f"{row['ratio']:.3f} ({row['low']:.3f} to {row['high']:.3f})"


def _launches(row: Mapping[str, Any] | None) -> str:
    """Return the launches of a step with the twin, and of a step of the same run with the kernel."""
    if row is None or row.get("launches") is None:
        return "–"
    launches = f"{row['launches']:.0f}"
    if row.get("launches_with_kernel") is None:
        return launches
    return f"{launches} / {row['launches_with_kernel']:.0f}"
