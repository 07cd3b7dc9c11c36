"""The rows of a step's views that each process composites."""

from __future__ import annotations

import math
from collections import defaultdict
from functools import lru_cache
from typing import NamedTuple

ROWS = 16  # px; views are cut at multiples of this, as tiles are
MARGIN = 16
"""Rows beyond a band in px that are drawn, too, because SSIM's window reaches 5 px beyond the rows that count."""


class Band(NamedTuple):
    """Rows of a view that one process composites; a whole view is a band, too."""

    view: int  # Number of the view in the step
    rank: int  # The process that composites it
    first: int  # First row that counts in the loss
    last: int  # The row after the last that counts
    top: int  # First row that is drawn
    bottom: int  # The row after the last that is drawn


def share_rows(num_views: int, height: int, num_ranks: int) -> list[Band]:
    """Share the rows of one view or more, of one height in px, evenly among processes.

    The bands are in the order of processes, views and rows, and whole views if their number allows it.
    """
    # The last unit of a view also has the rows that ROWS leaves over, so that SSIM's window fits each band.
    units = max(height // ROWS, 1)
    all_units = num_views * units
    bands = []
    for rank in range(num_ranks):
        start = rank * all_units // num_ranks
        end = (rank + 1) * all_units // num_ranks
        first_view = start // units
        end_view = math.ceil(end / units)
        for view in range(first_view, end_view):
            begin = max(start - view * units, 0)
            stop = min(end - view * units, units)
            if begin >= stop:
                continue
            first = begin * ROWS
            last = stop * ROWS
            if stop == units:
                last = height
            top = max(first - MARGIN, 0)
            bottom = min(last + MARGIN, height)
            bands.append(Band(view, rank, first, last, top, bottom))
    return bands


@lru_cache(maxsize=1024)
def views_of_rank(sizes: tuple[tuple[int, int], ...], num_ranks: int, rank: int) -> tuple[int, ...]:
    """Return the numbers of the views with rows that a process composites, in its order.

    `sizes` are height and width of each view in px; views of one size are shared out together. Results are kept,
    because looking ahead asks for many steps, and most are alike.
    """
    groups: dict[tuple[int, int], list[int]] = defaultdict(list)
    for view, size in enumerate(sizes):
        groups[size].append(view)
    composited = []
    for (height, _), views in groups.items():
        for band in share_rows(len(views), height, num_ranks):
            if band.rank == rank:
                composited.append(views[band.view])
    return tuple(composited)
