"""Stamps of files, by which later runs see whether a file was changed, added or removed."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path

from sadgs_ns.placing.photos import threads

_CHECKED_BYTES = 1 << 26  # Size of the beginning of a file that its checksum is of


def photo_stamps(folder: Path, names: Sequence[str]) -> dict[str, list[int]]:
    """Return size in bytes, time of the last change in ns and checksum of the beginning of each photo or video."""

    def stamp(name: str) -> list[int]:
        status = (folder / name).stat()
        with (folder / name).open("rb") as file:
            checksum = zlib.crc32(file.read(_CHECKED_BYTES))
        return [status.st_size, status.st_mtime_ns, checksum]

    with threads() as pool:
        stamps = pool.map(stamp, names)
        return dict(zip(names, stamps, strict=True))


def changes_of(folder: Path, stamps: Mapping[str, Sequence[int]], names: Sequence[str]) -> dict[str, str]:
    """Return what is "changed", "added" or "removed" among these photos since they were stamped, as ends of sentences.

    Those of the same size and time are not read. The same content at another time, as in a copy, is no change.
    """
    touched = [name for name in names if name in stamps and _is_touched(folder / name, stamps[name])]
    changed = set()
    for name, now in photo_stamps(folder, touched).items():
        before = stamps[name]
        if now[0] != before[0] or now[2] != before[2]:
            changed.add(name)
    changes = {"changed": changed, "added": set(names) - stamps.keys(), "removed": stamps.keys() - set(names)}
    sentences = {}
    for change, files in changes.items():
        if files:
            example = min(files) or folder.name  # A single video has no name in its folder.
            sentences[change] = f"{change}: {len(files)}, such as {example}"
    return sentences


def _is_touched(file: Path, stamp: Sequence[int]) -> bool:
    """Return whether a file has another size or time than when it was stamped; one that is missing has not."""
    if not file.exists():
        return False
    status = file.stat()
    return status.st_size != stamp[0] or status.st_mtime_ns != stamp[1]
