"""Stamps of files, by which later runs see whether a file was changed, added or removed."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path

from sadgs_ns.placing.photos import threads


def photo_stamps(folder: Path, names: Sequence[str]) -> dict[str, list[int]]:
    """Return size in bytes, time of the last change in ns and checksum of the beginning of each photo or video."""

    def stamp(name: str) -> list[int]:
        status = (folder / name).stat()
        with (folder / name).open("rb") as file:
            return [status.st_size, status.st_mtime_ns, zlib.crc32(file.read(1 << 26))]

    with threads() as pool:
        return dict(zip(names, pool.map(stamp, names), strict=True))


def changes_of(folder: Path, stamps: Mapping[str, Sequence[int]], names: Sequence[str]) -> dict[str, str]:
    """Return what is "changed", "added" or "removed" among these photos since they were stamped, as ends of sentences.

    Those of the same size and time are not read. The same content at another time, as in a copy, is no change.
    """
    there = {name: (folder / name).stat() for name in names if name in stamps and (folder / name).exists()}
    touched = [name for name, now in there.items() if [now.st_size, now.st_mtime_ns] != list(stamps[name][:2])]
    now = photo_stamps(folder, touched)
    changed = {name for name in touched if (now[name][0], now[name][2]) != (stamps[name][0], stamps[name][2])}
    changes = {"changed": changed, "added": {*names} - stamps.keys(), "removed": stamps.keys() - {*names}}
    return {verb: f"{verb}: {len(n)}, such as {min(n) or folder.name}" for verb, n in changes.items() if n}
