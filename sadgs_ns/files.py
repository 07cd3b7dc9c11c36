"""Files that appear complete or not at all, settings in JSON, and folders that only one process uses."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from sadgs_ns.errors import InputError, WriteError, reason

_NO_LOCKS = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP, errno.EINVAL, errno.EBADF)
"""Errors of file systems that have no locks. NFS raises the last one, because it wants to write what it locks, which no
folder allows."""


def check_encoding(path: Path) -> None:
    """Raise InputError if a path is not in UTF-8: COLMAP, FFmpeg and torch cannot open what lies there, or crash."""
    absolute = os.path.abspath(path)
    try:
        absolute.encode()
    except UnicodeEncodeError:
        problem = f"{absolute!a} is not in UTF-8"
        raise InputError(f"{problem}, which COLMAP, FFmpeg and torch need: rename its folder or file.") from None


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
        lock = os.open(partial, os.O_RDWR | os.O_CREAT, 0o666)
    except OSError as error:
        raise WriteError(path, error) from error
    try:
        if not _is_free(lock):
            raise InputError(f"Another process writes {path} now: wait until it is done, or name another file.")
        with _removed_at_end(partial):
            yield partial
            os.replace(partial, path)
    except OSError as error:
        raise WriteError(path, error) from error
    finally:
        os.close(lock)


@contextmanager
def _removed_at_end(path: Path) -> Iterator[None]:
    """Remove a file at the end of the block if it is still there."""
    try:
        yield
    finally:
        with suppress(OSError):  # Even its folder may be missing.
            path.unlink(missing_ok=True)


def read_settings(file: Path, folder: Path) -> dict[str, Any]:
    """Return the settings of a folder, none if their file does not exist; raise InputError if it is damaged."""
    if not file.exists():
        return {}
    try:
        return dict(json.loads(file.read_text("utf8")))
    except (TypeError, ValueError) as error:  # It is no JSON, or JSON of another kind than an object.
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
    lock = lock_folder(folder, refusal, seconds)
    try:
        yield lock
    finally:
        os.close(lock)


def lock_folder(folder: Path, refusal: str, seconds: float = 0.0) -> int:
    """Lock a folder and return the file descriptor that holds the lock until it is closed; raise as `locked`.

    If the file system has no locks, print a line and go on without.
    """
    lock = os.open(folder, os.O_RDONLY)
    end = time.monotonic() + seconds
    try:
        while not _take(lock):
            if time.monotonic() > end:
                raise InputError(refusal)
            time.sleep(0.2)
    except InputError:
        os.close(lock)
        raise
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            os.close(lock)
            raise
        problem = f"The file system of {folder} has no locks ({reason(error)})"
        print(f"{problem}: take care that only one command at a time works there.", file=sys.stderr, flush=True)
    return lock


def _is_free(lock: int) -> bool:
    """Take the lock of an open file; return whether it was free, which counts as so where there are no locks."""
    try:
        return _take(lock)
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            raise
    return True


def _take(lock: int) -> bool:
    """Take the lock of an open file or folder, and return whether it was free."""
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
