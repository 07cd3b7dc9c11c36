"""Events with fields, by which a function reports its progress to the process that started its own."""

from __future__ import annotations

import dataclasses
import json
import os
from contextlib import suppress
from typing import Any

FILE = "SADGS_EVENTS"  # Environment variable that names a file, where a listener reads each event as a line of JSON


def report(event: str, **fields: Any) -> None:
    """Report an event to the listener, if there is one; its fields are JSON or dataclasses."""
    path = os.environ.get(FILE)
    if path:
        line = json.dumps({"event": event, **fields}, default=dataclasses.asdict) + "\n"
        # The listener has made the file; one that it removed stays away.
        with suppress(OSError), open(os.open(path, os.O_WRONLY | os.O_APPEND), "wb", buffering=0) as file:
            file.write(line.encode())


def progress(stage: str, done: int, total: int) -> None:
    """Report how much of a stage is done."""
    report("progress", stage=stage, done=done, total=total)
