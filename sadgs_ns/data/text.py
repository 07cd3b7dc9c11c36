"""Text in UTF-8. Editors of Windows write a byte order mark before it, which nerfstudio's readers take for content."""

from __future__ import annotations

from pathlib import Path

from sadgs_ns.errors import InputError


def read_text(path: Path) -> str:
    """Return a file's text; raise InputError if it is not UTF-8, or starts with a byte order mark."""
    try:
        text = path.read_text("utf8")
    except UnicodeDecodeError:
        raise InputError(f"{path} is not text in UTF-8: save it in that encoding.") from None
    check_byte_order_mark(text, path)
    return text


def check_byte_order_mark(text: str, path: Path) -> None:
    """Raise InputError if the text of a file, or its first line, starts with a byte order mark."""
    if text.startswith("\ufeff"):
        problem = f"{path} starts with a byte order mark, which nerfstudio cannot read"
        raise InputError(f"{problem}: save it as UTF-8 without one.")
