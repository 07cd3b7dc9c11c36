"""Files that appear complete or not at all."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from sadgs_ns.errors import WriteError


@contextmanager
def atomic_path(path: Path, beside: Path | None = None) -> Iterator[Path]:
    """A temporary path that becomes `path` when the block ends well, and vanishes when it raises.

    It is named after `beside` and the same each time, so that the next write replaces what a killed one left.

    Args:
        path: Made with its folder, or replaced.
        beside: A neighbour of the temporary path: `path` itself, unless its folder takes no other files.

    Raises:
        WriteError: If the disk is full or the folder cannot be written.
    """
    path = Path(path)
    neighbour = path if beside is None else beside
    partial = neighbour.with_name(f".{neighbour.stem}.partial{neighbour.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield partial
        os.replace(partial, path)
    except OSError as error:
        raise WriteError(path, error) from error
    finally:
        with suppress(OSError):  # where even the folder could not be made
            partial.unlink(missing_ok=True)
