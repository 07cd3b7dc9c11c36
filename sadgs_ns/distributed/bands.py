"""Which process composites which rows of which view of a step."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

ROWS = 16
"""px. Views are cut between rows that this divides, as do the sides of all our tiles."""
MARGIN = 16
"""px. Rows beyond a band that are drawn, too: SSIM's window reaches 5 px beyond the rows that count."""


class Band(NamedTuple):
    """Rows of a view that one process composites; a whole view is a band, too."""

    view: int
    """Number of the view in the step."""
    rank: int
    """The process that composites it."""
    first: int
    """First row that counts in the loss."""
    last: int
    """One past the last row that counts."""
    top: int
    """First row that is drawn."""
    bottom: int
    """One past the last row that is drawn."""


def share_out(num_views: int, height: int, num_ranks: int) -> list[Band]:
    """Share the rows of a step's views out evenly: where the number of processes divides that of views, whole views.

    Args:
        num_views: Number of views, at least 1.
        height: px.
        num_ranks: Number of processes.

    Returns:
        Bands in the order of their processes, which is that of the views and rows, too.
    """
    # The last unit of a view also has the rows that ROWS leaves over, so that SSIM's window fits each band.
    units = max(height // ROWS, 1)
    bands = []
    for rank in range(num_ranks):
        start, end = (r * num_views * units // num_ranks for r in (rank, rank + 1))
        for view in range(start // units, -(-end // units)):
            begin, stop = max(start - view * units, 0), min(end - view * units, units)
            first, last = begin * ROWS, height if stop == units else stop * ROWS
            if begin < stop:
                top, bottom = max(first - MARGIN, 0), min(last + MARGIN, height)
                bands.append(Band(view, rank, first, last, top, bottom))
    return bands


def first_ranks(bands: Sequence[Band]) -> dict[int, int]:
    """Return, by the numbers of the views, the processes that composite their first rows.

    Args:
        bands: All bands, as `share_out` returns them.
    """
    return {band.view: band.rank for band in reversed(bands)}


@lru_cache(maxsize=1024)
def views_of_rank(sizes: tuple[tuple[int, int], ...], num_ranks: int, rank: int) -> tuple[int, ...]:
    """Return of which views of a step a process composites rows; many steps are looked ahead at, and most are alike.

    Args:
        sizes: Height and width of each view in px; views of one size are shared out together.
        num_ranks: Number of processes.
        rank: The process.

    Returns:
        Numbers of the views in the step, in the order in which it composites them.
    """
    groups: dict[tuple[int, int], list[int]] = defaultdict(list)
    for view, size in enumerate(sizes):
        groups[size].append(view)
    bands = ((share_out(len(views), height, num_ranks), views) for (height, _), views in groups.items())
    return tuple(views[band.view] for shared, views in bands for band in shared if band.rank == rank)
