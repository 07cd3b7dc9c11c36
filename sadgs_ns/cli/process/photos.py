"""The photos of a folder, and which of them one camera took."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

from PIL import ExifTags, Image

from sadgs_ns.data.validation.images import IMAGE_SUFFIXES

_UNREAD_SUFFIXES = {".heic", ".heif", ".avif", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf"}
"""Suffixes of formats that phones and cameras write and COLMAP does not read."""


def photos_not_read(folder: Path) -> str:
    """A sentence on the photos in formats that are not read; empty if there are none."""
    others = [path.suffix for path in folder.rglob("*") if path.suffix.lower() in _UNREAD_SUFFIXES]
    if not others:
        return ""
    kinds = ", ".join(sorted(suffix[1:] for suffix in IMAGE_SUFFIXES))
    return f"Its {len(others)} {' and '.join(sorted(set(others)))} files are not read: convert them to one of {kinds}."


def find_photos(source: Path, out: Path) -> list[str]:
    """The names of a folder's photos, relative to it, without those of a scene that is made in the same folder.

    Raises:
        ValueError: If there are fewer than three photos.
    """
    if not source.is_dir():
        raise ValueError(f"{source} does not exist; give a folder of photos or a video.")
    folder, scene = source.resolve(), out.resolve()
    found = [path for path in folder.rglob("*") if path.suffix.lower() in IMAGE_SUFFIXES]
    if folder in scene.parents:
        found = [path for path in found if scene not in path.parents]
    if len(found) < 3:
        told = f"{source} holds {len(found)} photos; a reconstruction needs at least 3, better 30 or more."
        raise ValueError(f"{told} {photos_not_read(folder)}".rstrip())
    return sorted(path.relative_to(folder).as_posix() for path in found)


def photos_by_camera(photos: Path, names: Sequence[str]) -> list[list[str]]:
    """Photos that one camera at one focal length took, as far as their size and EXIF tell.

    Raises:
        ValueError: If a photo cannot be read.
    """
    groups: dict[tuple, list[str]] = defaultdict(list)
    for name in names:
        try:
            with Image.open(photos / name) as image:
                exif = image.getexif()
                lens = exif.get_ifd(ExifTags.IFD.Exif).get(ExifTags.Base.FocalLength)
                groups[image.size, exif.get(ExifTags.Base.Make), exif.get(ExifTags.Base.Model), lens].append(name)
        except OSError as error:
            raise ValueError(f"{photos / name} cannot be read as an image ({error}); remove or replace it.") from error
    return list(groups.values())
