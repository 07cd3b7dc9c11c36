"""`python -m benchmarks table RESULTS.jsonl`: the table of a results file, and a plot of quality against time."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from benchmarks import results, table


@dataclass
class Command:
    """Print the table of a results file, and plot quality against time."""

    results: Positional[Path]
    """JSON-lines file that python -m benchmarks wrote"""
    reference: str | None = None
    """label of the row that the columns Ratio and Matched compare with"""
    plots: Path | None = None
    """folder that takes quality-time.png"""

    def __call__(self) -> int:
        rows = results.read(self.results)
        grouped = table.groups(table.latest(rows))
        if not grouped:
            raise ValueError(f"{self.results} has no successful run among its {len(rows)}.")
        labels = dict.fromkeys(label for _, label in grouped)
        if self.reference is not None and self.reference not in labels:
            raise ValueError(f"--reference {self.reference!r} is no label of these: {', '.join(labels)}.")
        print(table.markdown(rows, self.reference))
        if self.plots is not None:
            from benchmarks import plots  # matplotlib takes a second to import

            self.plots.mkdir(parents=True, exist_ok=True)
            plots.save(plots.quality(grouped.items()), self.plots / "quality-time.png")
        return 0
