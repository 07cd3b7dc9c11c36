"""A line that says how far a stage is."""

from __future__ import annotations

import time

from rich.console import Console
from rich.live import Live
from rich.text import Text


class StatusLine:
    """The name of a stage, its time and its status. A terminal shows each change; a file gets the line at the end."""

    def __init__(self, name: str, console: Console) -> None:
        self._name, self._console, self._status, self._start = name, console, "", time.monotonic()
        self._live = Live(console=console, get_renderable=self._text) if console.is_terminal else None

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
        """Show how far the stage is."""
        self._status = status

    def finish(self, status: str) -> None:
        """Leave the line as it is with this status, and begin another one of its name."""
        self._status = status
        self._console.print(self._text(), soft_wrap=True)
        self._status, self._start = "", time.monotonic()

    def print(self, sentence: str) -> None:
        """Print a sentence above the line."""
        self._console.print(Text(sentence), soft_wrap=True)

    def _text(self) -> Text:
        passed = clock(time.monotonic() - self._start)
        return Text(f"{self._name:<9}{passed:>8}  {self._status}".rstrip(), no_wrap=True, overflow="ellipsis")


def clock(seconds: float) -> str:
    """Return a time as "1:02" or "1:00:02"."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02}:{rest:02}" if minutes >= 60 else f"{minutes}:{rest:02}"
