"""Names of training photos, by which they are known again when a run is resumed."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path


def common_folder(files: Sequence[Path]) -> Path:
    """Return the absolute path of the folder that holds all files, in it or below."""
    return Path(os.path.commonpath([os.path.abspath(file.parent) for file in files]))


def paths_from(folder: Path, files: Sequence[Path]) -> list[Path]:
    """Return the paths of files from a folder, whose path is absolute, that holds them; theirs may be relative."""
    return [Path(os.path.abspath(file)).relative_to(folder) for file in files]


def photo_names(files: Sequence[Path]) -> list[str]:
    """Return the path of each photo from the folder that holds all, with the name of this folder before it."""
    return [path.as_posix() for path in paths_from(common_folder(files).parent, files)]


def same_photos(before: Sequence[str], now: Sequence[str]) -> list[int | None]:
    """Find each of the photos `now` among those `before`, by their `photo_names`; None where one was added.

    If any name is as before, only equal names are the same photo. Otherwise the folder has another name, or the images
    are of another size. Then those photos are the same whose paths have an equal end that no other photo has; longer
    ends count first.
    """
    found: list[int | None] = [None] * len(now)
    indices = {name: index for index, name in enumerate(before)}
    if not indices.keys().isdisjoint(now):
        return [indices.get(name) for name in now]
    left_before = set(range(len(before)))
    left_now = set(range(len(now)))
    most_parts = max((name.count("/") + 1 for name in (*before, *now)), default=0)
    for count in range(most_parts, 0, -1):
        ends_before = _unique_ends(before, left_before, count)
        ends_now = _unique_ends(now, left_now, count)
        for end in ends_before.keys() & ends_now.keys():
            found[ends_now[end]] = ends_before[end]
            left_before.remove(ends_before[end])
            left_now.remove(ends_now[end])
    return found


def _unique_ends(names: Sequence[str], indices: Iterable[int], count: int) -> dict[tuple[str, ...], int]:
    """Return the last parts of those names that have so many and share them with no other, with their indices."""
    parts = {index: tuple(names[index].split("/")) for index in indices}
    ends = {index: of_name[-count:] for index, of_name in parts.items() if len(of_name) >= count}
    numbers = Counter(ends.values())
    return {end: index for index, end in ends.items() if numbers[end] == 1}
