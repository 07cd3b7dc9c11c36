"""The choice of the pairs of photos to match, and the summary."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from sadgs_ns.cli.cameras.photos import Photo
from sadgs_ns.errors import InputError, RunError

EXHAUSTIVE_LIMIT = 200
"""Most photos for which every pair is matched; twice the photos take four times as long."""
MAX_SIDE = 3200
"""Longest side in px to which photos are scaled down to find features, as COLMAP does."""
_PAIRS_PER_PHOTO = {"sequential": 16, "spatial": 50, "vocabulary": 100}
"""Other photos that each photo is matched with, at most."""
Matching = Literal["auto", "exhaustive", "sequential", "spatial", "vocabulary"]


@dataclass(frozen=True)
class Summary:
    """How many photos registered, and why others did not."""

    photos: int
    registered: int
    points: int
    reprojection_error: float  # Mean over all observations, px
    left_out: dict[str, str]  # The reason for each photo that did not register
    matching: Matching
    attempts: str = ""  # A sentence on a second attempt to place the cameras, if one was made

    def __str__(self) -> str:
        lines = [
            f"{self.registered} of {self.photos} photos registered, {self.points:,} points, "
            f"mean reprojection error {self.reprojection_error:.2f} px. {self.attempts}".rstrip()
        ]
        return "\n".join(lines + [f"  {name}: {why}" for name, why in sorted(self.left_out.items())])

    @property
    def is_poor(self) -> bool:
        """Whether fewer than half of the photos registered."""
        return self.registered < 0.5 * self.photos


def choose_matching(
    asked: Matching, photos: Sequence[Photo], is_video: bool, fetch_vocabulary: Callable[[], None]
) -> tuple[Matching, str]:
    """Return how photos are matched, which is never "auto", and a sentence on the choice, which may be empty.

    `fetch_vocabulary` brings COLMAP's vocabulary tree to this machine, or raises RunError. Raise InputError if the way
    that was asked for cannot work on these photos or this machine.
    """
    nowhere = [photo.name for photo in photos if not photo.position]
    if asked == "spatial" and nowhere:
        raise InputError(
            f"--matching spatial needs a GPS position with altitude in the EXIF data of every photo, and "
            f"{len(nowhere)} of the {len(photos)} have none, such as {nowhere[0]}; use sequential, exhaustive or auto."
        )
    # Indoors a phone repeats its last position, whose nearest photos are any.
    are_apart = 2 * len({photo.position for photo in photos}) > len(photos) and not nowhere
    if asked == "auto" and (is_video or len(photos) <= EXHAUSTIVE_LIMIT or are_apart):
        asked = "sequential" if is_video else "exhaustive" if len(photos) <= EXHAUSTIVE_LIMIT else "spatial"
    if asked not in ("auto", "vocabulary"):
        return asked, ""
    try:
        fetch_vocabulary()
    except RunError as error:
        why = str(error).partition(";")[0]
        lacking = f"There is no vocabulary tree, which pycolmap downloads at its first use: {why}."
        if asked == "vocabulary":
            raise InputError(
                f"{lacking} Use --matching sequential for photos in the order of their taking, or exhaustive."
            ) from error
        if len({re.sub(r"\d+", "0", photo.name) for photo in photos}) == 1:
            return "sequential", (
                f"{lacking} The photos are numbered, so each is matched with those that follow it "
                "(--matching sequential); if many do not register, use --matching exhaustive."
            )
        return "exhaustive", (
            f"{lacking} Each photo is matched with all others (--matching exhaustive), which takes long; --matching "
            "sequential is quicker for photos in the order of their taking."
        )
    return "vocabulary", ""


def searched_pixels(size: tuple[int, int]) -> float:
    """Return the number of pixels in which features of a photo of this width and height are searched."""
    width, height = size
    return width * height * min(1.0, MAX_SIDE / max(width, height)) ** 2


def pairs_to_match(photos: int, matching: Matching, known: int = 0) -> int:
    """Return the largest number of pairs that are matched, without those of the `known` photos alone."""

    def all_pairs(count: int) -> int:
        return min(count * _PAIRS_PER_PHOTO.get(matching, count), count * (count - 1) // 2)

    return all_pairs(photos) - all_pairs(known)
