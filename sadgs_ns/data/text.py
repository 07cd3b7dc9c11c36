"""Text in UTF-8, before which editors of Windows write a mark that nerfstudio's readers take for content."""

from __future__ import annotations

from pathlib import Path

from sadgs_ns.errors import InputError


def refuse_byte_order_mark(text: str, path: Path) -> None:
    """Raise InputError if the text of a file, or its first line, starts with a byte order mark."""
    if text.startswith("\ufeff"):
        raise InputError(
            f"{path} starts with a byte order mark, which nerfstudio cannot read: save it as UTF-8 without one."
        )
