"""Where the time of `sadgs` goes."""

from __future__ import annotations

import time
from typing import Any

from sadgs_ns.cli.status_line import clock

_PARTS = {
    "imported": ("start", "data and model"),
    "training begins": ("start", "kernels"),
    "loop begins": ("training", "iterations"),
    "loop ends": ("training", "saving"),
}
"""Events of training, and the stage and its part that each begins."""


class Timeline:
    """The parts of a command's stages, each of which lasts until the next begins."""

    def __init__(self) -> None:
        self._begun: list[tuple[str, str, float]] = []

    def begin(self, stage: str, part: str) -> None:
        """End the present part and begin another one, unless it is the present one."""
        if not self._begun or self._begun[-1][:2] != (stage, part):
            self._begun.append((stage, part, time.monotonic()))

    def follow(self, event: str, **fields: Any) -> None:
        """Begin the part that an event begins, if it does."""
        if event in _PARTS:
            self.begin(*_PARTS[event])
        elif event == "progress":
            self.begin(self._begun[-1][0], fields["stage"])

    def _seconds(self) -> list[tuple[str, str, float]]:
        ends = [*(begun for _, _, begun in self._begun[1:]), time.monotonic()]
        return [(stage, part, end - begun) for (stage, part, begun), end in zip(self._begun, ends, strict=False)]

    def __str__(self) -> str:
        """Return the times of the stages, as "cameras 0:15, start 0:03"."""
        stages: dict[str, float] = {}
        for stage, _, seconds in self._seconds():
            stages[stage] = stages.get(stage, 0.0) + seconds
        return ", ".join(f"{stage} {clock(seconds)}" for stage, seconds in stages.items())

    def table(self) -> str:
        """Return a line for each part, in the columns of the stages' lines."""
        return "\n".join(f"{stage:<9}{seconds:6.1f} s  {part}" for stage, part, seconds in self._seconds())
