"""Events with fields, by which a function tells the process that had it called how far it is."""

from __future__ import annotations

import dataclasses
import json
import os
from contextlib import suppress
from typing import Any

FILE = "SADGS_EVENTS"
"""Environment variable with the path of the file from which a listener reads events, each of which is a JSON line."""


def report(event: str, **fields: Any) -> None:
    """Tell the listener, if there is one, of an event, whose fields are what JSON holds and dataclasses."""
    if path := os.environ.get(FILE):
        line = json.dumps({"event": event, **fields}, default=dataclasses.asdict) + "\n"
        with suppress(OSError):
            file = os.open(path, os.O_WRONLY | os.O_APPEND)
            try:
                os.write(file, line.encode())
            finally:
                os.close(file)


def progress(stage: str, done: int, total: int) -> None:
    """Tell the listener how much of a stage is done."""
    report("progress", stage=stage, done=done, total=total)
