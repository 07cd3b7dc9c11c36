"""Errors whose message is one sentence that is all their reader needs."""

from __future__ import annotations

import shutil
import sys
from pathlib import Path
from types import TracebackType


class InputError(ValueError):
    """Data, options or a checkpoint cannot be used; the message names the input and the remedy."""


class RunError(RuntimeError):
    """A run cannot go on; the message says why, what is left of it and what helps."""


class WriteError(OSError):
    """A file could not be written; the message names it, the free space and the remedy.

    Args:
        path: The file.
        error: What writing it raised.
    """

    def __init__(self, path: Path, error: Exception) -> None:
        super().__init__(
            f"{path} could not be written ({reason(error)}; {free_space(path)} free there): make room or name a folder "
            "that can be written; nothing half-written is left, and a file that was there is as it was."
        )


def print_uncaught_errors_as_sentences() -> None:
    """Have Python print our errors, where nobody catches them, as their sentence alone instead of a traceback.

    nerfstudio's commands run none of our code around what they do, but all of them import the package's `plugin`
    folder, which calls this. Python's exit code stays 1, and other errors are shown as before.
    """
    show = sys.excepthook

    def show_sentence(kind: type[BaseException], error: BaseException, traceback: TracebackType | None) -> None:
        if isinstance(error, InputError | RunError | WriteError):
            print(f"error: {error}", file=sys.stderr)
        else:
            show(kind, error, traceback)

    sys.excepthook = show_sentence


def reason(error: BaseException) -> str:
    """Shorten a library's error to a few words: its first line without the full stop."""
    text = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    lines = text.strip().splitlines()
    return lines[0].strip().rstrip(".:") if lines else type(error).__name__


def free_space(path: Path) -> str:
    """Return the room on the disk of a file or folder, which need not exist, such as "12.3 GB"."""
    existing = next((p for p in (path, *path.absolute().parents) if p.exists()), Path("/"))
    return f"{shutil.disk_usage(existing).free / 1e9:.1f} GB"
