"""The results file of a benchmark: one JSON object a line, one line a finished run."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

Result = dict[str, Any]
"""What `benchmarks.run` measured, with `key`, `status` ("ok" or "failed") and `error`."""
_IDENTITY = ("key", "scene", "label", "seed", "status")


def read(path: Path, strict: bool = False) -> list[Result]:
    """Results in the order they ended; the last one of each key, none if there is no file.

    A line that a killed benchmark left half-written is reported on stderr and ignored.

    Args:
        strict: Whether such a line, one that does not say whose result it is, or no file is an error.

    Raises:
        ValueError: With `strict`; names the file and the line.
    """
    if strict and not path.is_file():
        raise ValueError(f"{path} is not a file; give one that python -m benchmarks wrote.")
    results: dict[str, Result] = {}
    try:
        lines = path.read_text("utf-8").splitlines() if path.exists() else []
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is not text; give a file that python -m benchmarks wrote.") from error
    for number, line in enumerate(lines, 1):
        try:
            result = json.loads(line)
            for name in _IDENTITY if strict else ():
                result[name]
            results.pop(result["key"], None)
            results[result["key"]] = result
        except (ValueError, KeyError, TypeError) as error:
            if strict:
                raise ValueError(f"{path}:{number} is not a benchmark's result; delete that line.") from error
            print(f"{path}:{number} is not a result and is ignored.", file=sys.stderr)
    return list(results.values())


def append(path: Path, result: Result) -> None:
    """Add a result, on the disk when this returns."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("ab+") as file:
        if file.tell() > 0:
            file.seek(-1, os.SEEK_END)
            if file.read(1) != b"\n":  # a half-written line must not swallow this one
                file.write(b"\n")
        file.write(json.dumps(result).encode() + b"\n")
        file.flush()
        os.fsync(file.fileno())
