"""Writing files so that they appear complete or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from sadgs_ns.errors import WriteError


@contextmanager
def atomic_path(path: Path, beside: Path | None = None) -> Iterator[Path]:
    """Give a temporary path that becomes `path` when the block ends, and is removed when the block raises.

    Its name is the same each time, so that the next write replaces the rest of a killed one. It lies beside `path`, or
    beside another path where the folder of `path`, which is made if there is none, must hold no other files. Raise
    WriteError if the disk is full or the folder cannot be written.
    """
    neighbour = path if beside is None else beside
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
