"""Reads COLMAP's database as it is stored."""

from __future__ import annotations

import contextlib
import sqlite3
from pathlib import Path


def rows_of(database: Path, table: str) -> list[tuple]:
    """All that a table of COLMAP's database holds, byte by byte, in the order of its pairs of photos."""
    with contextlib.closing(sqlite3.connect(database)) as opened:
        return opened.execute(f"SELECT * FROM {table} ORDER BY pair_id").fetchall()
