"""The way in which pairs of photos are chosen, and the summary."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from sadgs_ns.data.images import SMALL_PHOTO

EXHAUSTIVE_LIMIT = 40  # Most photos for which every pair is matched; twice the photos take four times as long
NEIGHBORS = 20  # Photos that each of more photos is matched with at least, those that look most alike (docs/results.md)
Matching = Literal["auto", "exhaustive", "sequential", "similar"]


@dataclass(frozen=True)
class Summary:
    """How many photos registered, why others did not, and what speaks against the cameras."""

    photos: int
    registered: int
    points: int
    reprojection_error: float  # Mean over all observations, px
    left_out: dict[str, str]  # The reason for each photo that did not register
    matching: Matching
    attempts: str = ""  # A sentence on a second attempt to place the cameras, if one was made
    doubts: list[str] = field(default_factory=list)  # Reasons why the cameras may be wrong, as in `Judgement`
    faults: list[str] = field(default_factory=list)  # Reasons why they are wrong
    longest_side: int = 0  # Of the median photo, px; 0 if an earlier version made the scene

    def __str__(self) -> str:
        registered = f"{self.registered} of {self.photos} photos registered, {self.points:,} points"
        error = f"mean reprojection error {self.reprojection_error:.2f} px."
        lines = [f"{registered}, {error} {self.attempts}".rstrip()]
        for name, reason in sorted(self.left_out.items()):
            lines.append(f"  {name}: {reason}")
        return "\n".join(lines)

    @property
    def is_poor(self) -> bool:
        """Whether fewer than half of the photos registered, or the cameras are wrong."""
        return self.registered < 0.5 * self.photos or bool(self.faults)

    @property
    def larger_photos(self) -> str:
        """The remedy for photos that are so small that they show few features, as a part of a sentence, or ""."""
        if not 0 < self.longest_side < SMALL_PHOTO:
            return ""
        return f"the photos in their original size, since these are {self.longest_side} px wide and show few features"


def choose_matching(asked: Matching, photos: int, is_video: bool) -> Matching:
    """Return how pairs of so many photos, or frames of a video, are chosen; any way but "auto"."""
    if asked != "auto":
        return asked
    if is_video:
        return "sequential"
    if photos <= EXHAUSTIVE_LIMIT:
        return "exhaustive"
    return "similar"
