"""What a caller gives to `place_photos`: options, and functions that are told how far it is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from sadgs_ns.errors import InputError
from sadgs_ns.files import check_encoding
from sadgs_ns.placing.plan import Matching

MIN_SIZE = 64  # Least longest side of the result in px; no structure is left in smaller images


Report = Callable[[str, int, int], None]
"""Called with a stage's name, the work that is done, and all its work, in photos, pairs or frames."""
Say = Callable[..., None]
"""Called with the name of an event, a sentence on it for users, and by keyword the event's fields."""


@dataclass
class PlacingOptions:
    """Options of `place_photos`."""

    source: Path
    """Folder of photos or of videos, or a video."""
    out: Path
    """Folder for the scene."""
    matching: Matching = "auto"
    """How pairs of photos are chosen; auto decides by their kind and number."""
    frames: int = 200
    """Frames to take of a video, at least 3."""
    max_size: int = 1600
    """Longest side of the result in px, at least `MIN_SIZE`, 0 to keep it."""
    camera_per_photo: bool = False
    """Whether every photo has its own zoom, which EXIF does not tell."""

    def check(self) -> None:
        """Raise InputError if a value is out of range, or a path is not in UTF-8."""
        check_encoding(self.source)
        check_encoding(self.out)
        if self.frames < 3:
            raise InputError("--frames must be at least 3.")
        check_size(self.max_size)


def check_size(max_size: int) -> None:
    """Raise InputError if photos of this longest side in px would show no structure."""
    if max_size != 0 and max_size < MIN_SIZE:
        raise InputError(f"--max-size must be at least {MIN_SIZE} px, or 0 to keep the photos' size.")
