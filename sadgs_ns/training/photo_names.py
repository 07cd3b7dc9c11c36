"""Names of training photos, by which they are known again when a run is resumed."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path


def common_folder(files: Sequence[Path]) -> Path:
    """Return the folder that holds all files, in it or below."""
    return Path(os.path.commonpath([file.parent for file in files]))


def photo_names(files: Sequence[Path]) -> list[str]:
    """Return the path of each photo from the folder that holds all, with the name of this folder before it."""
    root = common_folder(files).parent
    return [file.relative_to(root).as_posix() for file in files]


def same_photos(before: Sequence[str], now: Sequence[str]) -> list[int | None]:
    """Find each of the photos `now` among those `before`, by their `photo_names`; None where one was added.

    If no name is as before, the folder has another name, or the images are of another size. Then two photos are the
    same if of all photos that were, and of all that are, their paths have the most parts in common at the end.
    """
    indices = {name: index for index, name in enumerate(before)}
    if not indices.keys().isdisjoint(now):
        return [indices.get(name) for name in now]
    before_by_file = _by_file(before)
    now_by_file = _by_file(now)
    found = []
    for index, name in enumerate(now):
        file = name.rpartition("/")[2]
        nearest = _nearest(name, before, before_by_file[file])
        if nearest is not None and _nearest(before[nearest], now, now_by_file[file]) != index:
            nearest = None
        found.append(nearest)
    return found


def _by_file(names: Sequence[str]) -> dict[str, list[int]]:
    """Group indices of names by the last part."""
    groups = defaultdict(list)
    for index, name in enumerate(names):
        groups[name.rpartition("/")[2]].append(index)
    return groups


def _nearest(name: str, names: Sequence[str], candidates: Sequence[int]) -> int | None:
    """Return the candidate among names that has the most parts in common with a name; None if several have as many."""
    counts = {index: _common_parts(name, names[index]) for index in candidates}
    most = max(counts.values(), default=0)
    nearest = [index for index, count in counts.items() if count == most]
    if len(nearest) != 1:
        return None
    return nearest[0]


def _common_parts(name: str, other: str) -> int:
    """Return how many parts at the end of two paths are equal."""
    count = 0
    for part, other_part in zip(reversed(name.split("/")), reversed(other.split("/")), strict=False):
        if part != other_part:
            break
        count += 1
    return count
