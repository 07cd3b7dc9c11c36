"""Events with fields, by which a function reports its progress to the process that started its own."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import time
from collections.abc import Iterator
from typing import Any

FILE = "SADGS_EVENTS"  # Environment variable that names a file, where a listener reads each event as a line of JSON
TRACE = "SADGS_TRACE"
"""Environment variable that names a file, to which all processes of a command add their events and spans with the time.
`python -m benchmarks seconds` reads it."""


def report(event: str, **fields: Any) -> None:
    """Report an event to the listener, if there is one; its fields are JSON or dataclasses."""
    _add_line(FILE, {"event": event, **fields})
    _trace(time.time(), event, fields)


def progress(stage: str, done: int, total: int) -> None:
    """Report how much of a stage is done."""
    report("progress", stage=stage, done=done, total=total)


@contextlib.contextmanager
def span(name: str, **fields: Any) -> Iterator[None]:
    """Add to the trace, if there is one, when the block begins and ends, also where it is left by an exception."""
    begin = time.time()
    try:
        yield
    finally:
        _trace(time.time(), "span", {"name": name, "begin": begin, **fields})


def _trace(seconds: float, event: str, fields: dict[str, Any]) -> None:
    """Add an event to the trace, with its time in seconds since the epoch."""
    _add_line(TRACE, {"time": seconds, "process": os.getpid(), "event": event, **fields})


def _add_line(variable: str, fields: dict[str, Any]) -> None:
    """Add a line of JSON to the file that an environment variable names, if it names one that is there."""
    path = os.environ.get(variable)
    if path:
        line = json.dumps(fields, default=dataclasses.asdict) + "\n"
        # The listener has made the file; one that it removed stays away.
        with contextlib.suppress(OSError), open(os.open(path, os.O_WRONLY | os.O_APPEND), "wb", buffering=0) as file:
            file.write(line.encode())
