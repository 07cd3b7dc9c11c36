"""Errors whose message is all that their reader needs.

`InputError` and `RunError` are also a SystemExit: where nobody catches them, as in `ns-train`, Python prints the
message alone and exits with 1. Where somebody does, they are the ValueError and RuntimeError that they say they are.
"""

from __future__ import annotations

import shutil
from pathlib import Path


class _OneSentence(SystemExit):
    def __init__(self, message: str) -> None:
        super().__init__(message)
        self.code: str = f"error: {message}"  # what Python prints; str() stays the message


class InputError(_OneSentence, ValueError):
    """Data, options or a checkpoint that cannot be used; the message names the input and the remedy."""


class RunError(_OneSentence, RuntimeError):
    """A run that cannot go on; the message says why, what is left of it and what helps."""


class WriteError(OSError):
    """A file that could not be written."""

    def __init__(self, path: Path, error: Exception) -> None:
        super().__init__(
            f"{path} could not be written ({reason(error)}; {free_space(path)} free there): make room or name a folder "
            "that can be written; nothing half-written is left, and a file that was there is as it was."
        )


def reason(error: BaseException) -> str:
    """An error of a library in a few words: its first line without the full stop."""
    text = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
    lines = text.strip().splitlines()
    return lines[0].strip().rstrip(".:") if lines else type(error).__name__


def free_space(path: Path) -> str:
    """Room on the disk of a file or folder that need not exist, such as "12.3 GB"."""
    existing = next((p for p in (path, *path.absolute().parents) if p.exists()), Path("/"))
    return f"{shutil.disk_usage(existing).free / 1e9:.1f} GB"
