"""The results file of a benchmark: one JSON object a line, one line a finished run."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

Result = dict[str, Any]
"""What `benchmarks.run` measured, with `key`, `status` ("ok" or "failed") and `error`."""


def read(path: Path, missing_ok: bool = False) -> list[Result]:
    """Results in the order they ended; the last one of each key.

    A line that is no result, such as one that a killed benchmark left half-written, is reported on stderr and ignored.
    Raises ValueError if there is no such file, unless `missing_ok`, or if it is not text.
    """
    if not path.is_file():
        if missing_ok:
            return []
        raise ValueError(f"{path} is not a file; give one that python -m benchmarks wrote.")
    results: dict[str, Result] = {}
    try:
        lines = path.read_text("utf-8").splitlines()
    except UnicodeDecodeError as error:
        raise ValueError(f"{path} is not text; give a file that python -m benchmarks wrote.") from error
    for number, line in enumerate(lines, 1):
        try:
            result = json.loads(line)
            key, *_ = (result[name] for name in ("key", "scene", "label", "seed", "status"))
        except (ValueError, KeyError, TypeError):
            print(f"{path}:{number} is not a result and is ignored.", file=sys.stderr)
            continue
        results.pop(key, None)
        results[key] = result
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
