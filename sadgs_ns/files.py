"""Files that appear complete or not at all, settings in JSON, and folders that only one process uses."""

from __future__ import annotations

import fcntl
import json
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from sadgs_ns.errors import InputError, WriteError, reason


@contextmanager
def atomic_path(path: Path, beside: Path | None = None) -> Iterator[Path]:
    """Give a temporary path that becomes `path` when the block ends, and is removed when the block raises.

    Its name is the same each time, so that the next write replaces the rest of a killed one. It lies beside `path`, or
    beside another path where the folder of `path`, which is made if there is none, must hold no other files. Raise
    WriteError if the disk is full or the folder cannot be written.
    """
    neighbour = beside or path
    partial = neighbour.with_name(f".{neighbour.stem}.partial{neighbour.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield partial
        os.replace(partial, path)
    except OSError as error:
        raise WriteError(path, error) from error
    finally:
        with suppress(OSError):  # Even its folder may be missing.
            partial.unlink(missing_ok=True)


def read_settings(file: Path, folder: Path) -> dict[str, Any]:
    """Return the settings of a folder, none if their file does not exist; raise InputError if it is damaged."""
    if not file.exists():
        return {}
    try:
        return dict(json.loads(file.read_text("utf8")))
    except ValueError as error:
        raise InputError(f"{file} is damaged ({reason(error)}): delete {folder} and begin again.") from error


def write_json(file: Path, value: Any) -> None:
    """Write JSON as `atomic_path` does."""
    with atomic_path(file) as partial:
        partial.write_text(json.dumps(value), "utf8")


@contextmanager
def locked(folder: Path, refusal: str, seconds: float = 0.0) -> Iterator[int]:
    """Lock a folder until all processes with the yielded file descriptor have ended.

    Raise InputError with the message `refusal` if the folder does not become free in these seconds.
    """
    lock = os.open(folder, os.O_RDONLY)
    try:
        end = time.monotonic() + seconds
        while not _takes(lock):
            if time.monotonic() > end:
                raise InputError(refusal)
            time.sleep(0.2)
        yield lock
    finally:
        os.close(lock)


def _takes(lock: int) -> bool:
    """Take the lock of an open folder, and return whether it was free."""
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
