"""What users are told of a cleaning, in the viewer's panel and by `sadgs-export`, whose options it names."""

from __future__ import annotations

import math

from sadgs_ns.errors import InputError
from sadgs_ns.geometry.cleaning import Cleaning, Remaining


def check_options(cleaning: Cleaning) -> None:
    """Raise InputError if a number is negative or not finite, an extent is 0, or the box's corners are reversed."""
    for option, value in (("--min-views", cleaning.min_views), ("--dust", cleaning.dust)):
        if not 0 <= value < math.inf:
            raise InputError(f"{option} {value:g} must be 0, which takes nothing away, or more.")
    extent = cleaning.max_extent
    if extent is not None and not 0 < extent < math.inf:
        raise InputError(f"--max-extent {extent:g} must be more than 0: leave it out to take nothing away.")
    if cleaning.crop is not None and not _is_box(cleaning.crop):
        box = " ".join(f"{value:g}" for value in cleaning.crop)
        raise InputError(f"--crop {box} is no box: give the lowest x, y and z, then the highest x, y and z.")


def _is_box(crop: tuple[float, ...]) -> bool:
    """Tell whether all corners are finite, and the lowest one is below the highest one on each axis."""
    corners = zip(crop[:3], crop[3:], strict=True)
    return all(-math.inf < low < high < math.inf for low, high in corners)


def removal_sentences(cleaning: Cleaning, remaining: Remaining) -> list[str]:
    """Return a sentence for each option that is set: how many Gaussians it takes away.

    A Gaussian counts for the first option that takes it away.
    """
    sentences = []
    for option, number in remaining.num_removed.items():
        description = _description(option, cleaning, remaining.num_views)
        if number == 1:
            sentences.append(f"1 Gaussian {description} is taken away.")
        else:
            sentences.append(f"{number:,} Gaussians {description} are taken away.")
    return sentences


def _description(option: str, cleaning: Cleaning, num_views: int) -> str:
    """Say which Gaussians an option takes away. `option` is the name of a field of `Cleaning`."""
    if option == "crop":
        return "outside the box"
    if option == "max_extent":
        return f"longer than {cleaning.max_extent:g}"
    if option == "min_views":
        return f"seen by fewer than {cleaning.min_views} of {num_views} training views"
    return f"of less than {cleaning.dust:g} px in every training view"
