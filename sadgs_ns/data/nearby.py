"""The search for files that are nearly there: of another suffix, case, Unicode normal form or folder."""

from __future__ import annotations

import os
import re
import unicodedata
from collections import defaultdict
from collections.abc import Collection, Iterable
from pathlib import Path, PurePosixPath

from sadgs_ns.data.images import IMAGE_SUFFIXES, UNREAD_REMEDY, UNREAD_SUFFIXES

_SUFFIXES = IMAGE_SUFFIXES | UNREAD_SUFFIXES
_MAP = re.compile(r"mask|depth|normal", re.IGNORECASE)  # In names of images that are no photos
_SMALLER = re.compile(r".+_\d+")  # Folders of smaller copies
_MOST_FILES = 200_000  # A search ends after so many files, as one that is started in a home folder should.


class NearbyFiles:
    """The images in and below a capture's folder, which is read at the first search."""

    def __init__(self, data: Path, taken: Collection[Path] = ()) -> None:
        """Search in the folder `data`, but never find the files `taken`, which others are named for."""
        self._data = data
        self._taken = set(taken)
        self._indices: dict[Path, dict[str, list[Path]]] = {}

    def find(self, missing: Path) -> list[Path]:
        """Return the images that the name of a missing one may mean, all of them equally near; or none.

        They are below the capture's folder, or in the missing file's own one. A photo is never found for a mask, nor a
        mask or a smaller copy for a photo.
        """
        candidates = list(self._index(self._data).get(_stem(missing.name), []))
        if missing.parent.is_dir() and not missing.parent.is_relative_to(self._data):
            candidates += self._index(missing.parent).get(_stem(missing.name), [])
        found = [
            path
            for path in candidates
            if path not in self._taken and path != missing and _is_of_one_kind(missing, path)
        ]
        nearness = [_nearness(missing, path) for path in found]
        return [path for path, value in zip(found, nearness, strict=True) if value == max(nearness)]

    def sentence(self, missing: Path) -> str | None:
        """Return the rest of a sentence that starts with a missing file and names the one that it means, or None."""
        found = self.find(missing)
        if not found:
            return None
        path = found[0]
        if len(found) > 1:
            listed = f"{path} and {found[1]}"
            return f"does not exist, but {listed} do: correct the name, or save one of them as this"
        problem = f"does not exist, but {path} does"
        if path.suffix.lower() in UNREAD_SUFFIXES:
            return f"{problem}, in a format that is not read: {UNREAD_REMEDY}"
        if _composed(str(path)) == _composed(str(missing)):
            form = "NFC"
            if unicodedata.is_normalized("NFD", path.name):
                form = "NFD"
            return f"{problem}, whose name is written in another way (Unicode's {form}): rename it"
        return f"{problem}: correct the name, or save that as this"

    def _index(self, folder: Path) -> dict[str, list[Path]]:
        """Return the images in and below a folder by the stems of their names."""
        if folder not in self._indices:
            self._indices[folder] = _read_folder(folder)
        return self._indices[folder]


def similar_name(name: str, names: Iterable[str]) -> str | None:
    """Return the first of some names that differs from a name only in suffix, case, normal form or folder, or None."""
    return next((other for other in names if _stem(other) == _stem(name)), None)


def _read_folder(folder: Path) -> dict[str, list[Path]]:
    index: dict[str, list[Path]] = defaultdict(list)
    number = 0
    for parent, folders, files in os.walk(folder):
        folders[:] = sorted(name for name in folders if not name.startswith("."))
        for name in sorted(files):
            path = Path(parent, name)
            if path.suffix.lower() in _SUFFIXES:
                index[_stem(name)].append(path)
        number += len(files)
        if number > _MOST_FILES:
            break
    return index


def _composed(name: str) -> str:
    return unicodedata.normalize("NFC", name)


def _folded(name: str) -> str:
    """Return a name without the differences of case and normal form."""
    return _composed(_composed(name).casefold())


def _stem(name: str) -> str:
    """Return a file's name without folders, which Windows ends with backslashes, and without suffixes of images."""
    name = _folded(name.replace("\\", "/").rpartition("/")[2])
    while PurePosixPath(name).suffix in _SUFFIXES:
        name = PurePosixPath(name).stem
    return name


def _is_of_one_kind(missing: Path, path: Path) -> bool:
    """Return whether both are photos, or both are masks or other maps, and no photo's smaller copy is among them."""
    shared = os.path.commonpath([missing.absolute(), path.absolute()])
    expected = os.path.relpath(missing, shared)
    found = os.path.relpath(path, shared)
    if bool(_MAP.search(expected)) != bool(_MAP.search(found)):
        return False
    return not any(_SMALLER.fullmatch(part) and part not in expected for part in Path(found).parts[:-1])


def _nearness(missing: Path, path: Path) -> tuple[bool, int, bool]:
    """Return whether a file is below the folders of a missing one that exist, and how much of both paths agrees.

    That is the number of folders above both files that have one name, and whether their suffixes have.
    """
    around = next((parent for parent in missing.parents if parent.is_dir()), missing.parent)
    # A path that Windows wrote has backslashes.
    missing_folders = str(missing.parent).replace("\\", "/").split("/")
    folders = path.parent.parts
    alike = 0
    for one, other in zip(reversed(missing_folders), reversed(folders), strict=False):
        if _folded(one) != _folded(other):
            break
        alike += 1
    has_suffix = missing.suffix.lower() == path.suffix.lower()
    return path.is_relative_to(around), alike, has_suffix
