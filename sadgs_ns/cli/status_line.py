"""The lines of `sadgs`: the progress of each stage, and where the time went."""

from __future__ import annotations

import time
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.text import Text

_PARTS = {
    "imported": ("start", "data and model"),
    "training begins": ("start", "kernels"),
    "loop begins": ("training", "iterations"),
    "loop ends": ("training", "saving"),
}
"""Events of training, and the stage and its part that each begins."""


class StatusLine:
    """The name of a stage, its time and its status. A terminal shows each change; a file gets the line at the end."""

    def __init__(self, name: str, console: Console) -> None:
        self._name = name
        self._console = console
        self._status = ""
        self._start = time.monotonic()
        self._live: Live | None = None
        if console.is_terminal:
            self._live = Live(console=console, get_renderable=self._text)

    def __enter__(self) -> StatusLine:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *error: object) -> None:
        if self._live is not None:
            self._live.stop()
        else:
            self._console.print(self._text(), soft_wrap=True)

    def update(self, status: str) -> None:
        """Show the progress of the stage."""
        self._status = status

    def finish(self, status: str) -> None:
        """Leave the line as it is with this status, and begin another one of its name."""
        self._status = status
        self._console.print(self._text(), soft_wrap=True)
        self._status = ""
        self._start = time.monotonic()

    def print(self, sentence: str) -> None:
        """Print a sentence above the line."""
        self._console.print(Text(sentence), soft_wrap=True)

    def _text(self) -> Text:
        passed = clock(time.monotonic() - self._start)
        line = f"{self._name:<9}{passed:>8}  {self._status}".rstrip()
        return Text(line, no_wrap=True, overflow="ellipsis")


def clock(seconds: float) -> str:
    """Return a time as "1:02" or "1:00:02"."""
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes}:{rest:02}"
    return f"{minutes // 60}:{minutes % 60:02}:{rest:02}"


class Timeline:
    """The parts of a command's stages, each of which lasts until the next begins."""

    def __init__(self) -> None:
        self._begun: list[tuple[str, str, float]] = []  # Stage, part and time of its beginning

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
        """Return stage, part and seconds of each part."""
        lengths = []
        end = time.monotonic()
        for stage, part, begun in reversed(self._begun):
            lengths.append((stage, part, end - begun))
            end = begun
        return lengths[::-1]

    def __str__(self) -> str:
        """Return the times of the stages, as "cameras 0:15, start 0:03"."""
        stages: dict[str, float] = {}
        for stage, _, seconds in self._seconds():
            stages[stage] = stages.get(stage, 0.0) + seconds
        return ", ".join(f"{stage} {clock(seconds)}" for stage, seconds in stages.items())

    def table(self) -> str:
        """Return a line for each part, in the columns of the stages' lines."""
        return "\n".join(f"{stage:<9}{seconds:6.1f} s  {part}" for stage, part, seconds in self._seconds())
