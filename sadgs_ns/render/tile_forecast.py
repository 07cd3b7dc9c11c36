"""Foresees how long the tile lists of a training step will be, so that the host need not wait for their length.

The number of pairs of a Gaussian and a tile changes little between two visits of a view, except where densification
lies between them. Views that were visited since then tell by how much it changed.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple, Protocol

MARGIN = 1.25
"""Factor on what is foreseen. It was chosen without measurements: larger ones sort more unused places, and smaller ones
repeat more steps."""
RECENT = 8
"""Number of the latest visits among which the largest change is taken."""
MOST_PAIRS = 2**25
"""Lists longer than this are not foreseen: their unused places would take more than 200 MB, and rendering them takes so
long that a wait does not matter."""
_SMALL = 1000
"""Pairs that are added to both numbers of a change, so that a view of a few Gaussians tells little about others."""
_LEAST_STEP = 4096
"""Smallest step between two capacities."""


class Counts(Protocol):
    """Numbers of pairs of views that were rendered together, on their way to the host (`kernels.tiles.PairCounts`)."""

    def ready(self) -> bool:
        """Tell whether they have arrived, without waiting."""
        ...

    def wait(self) -> list[int]:
        """Wait until they have arrived, and return one for each view."""
        ...


class _Visit(NamedTuple):
    epoch: int
    num_pairs: int


class _Call(NamedTuple):
    views: Sequence[int]
    size: tuple[int, int]
    epoch: int
    capacity: int | None
    counts: Counts


class TileForecast:
    """What is known of the numbers of pairs of the training views, and the capacities that follow from them.

    For each call of the rasterizer, `capacity` says how many places its tile lists should have, and `rendered` takes
    the exact numbers, which arrive later. `overflowed` reads those that have arrived.

    Attributes:
        coarse: Whether capacities are rounded up to powers of two and one and a half times these, so that only few
            different ones occur. They then are a fifth larger in the mean, which small scenes do not notice.
        times_overflowed: Number of calls that drew nothing so far, because they needed more places.
    """

    def __init__(self) -> None:
        self._epoch, self._num_gaussians = 0, -1  # Epochs end where the number of Gaussians changes.
        self._visits: dict[tuple[int, tuple[int, int]], _Visit] = {}
        self._changes: deque[tuple[int, float]] = deque(maxlen=RECENT)  # epoch of the visit before, and the factor
        self._calls: deque[_Call] = deque()
        self.coarse = False
        self.times_overflowed = 0

    def capacity(self, views: Sequence[int], size: tuple[int, int], num_gaussians: int) -> int | None:
        """Foresee how many places the tile lists of a call should have.

        Args:
            views: Indices of the training views that the call renders.
            size: Width and height in px of its images; nothing is known of a view in a size that it never had.
            num_gaussians: Number of Gaussians.

        Returns:
            The sum over the views of the number at the last visit, times the largest recent change of any view (if that
            is a growth), times MARGIN, rounded up so that few different numbers occur. None where a view was not
            visited yet, where its last visit was before a densification and no view has shown yet what changed since,
            or where there are more than MOST_PAIRS: then the host must wait for the exact number.
        """
        if num_gaussians != self._num_gaussians:
            self._epoch, self._num_gaussians = self._epoch + 1, num_gaussians
            self._changes.clear()
        total = 0.0
        for view in views:
            visit = self._visits.get((view, size))
            if visit is None:
                return None
            changes = [change for before, change in self._changes if before <= visit.epoch]
            if visit.epoch < self._epoch and not changes:
                return None
            total += max([1.0, *changes]) * visit.num_pairs
        rounded = _round_up(int(MARGIN * total) + 1, 2 if self.coarse else 16)
        return rounded if rounded <= MOST_PAIRS else None

    def rendered(self, views: Sequence[int], size: tuple[int, int], capacity: int | None, counts: Counts) -> None:
        """Take the exact numbers of a call, which may not have arrived yet.

        Args:
            views: As passed to `capacity` for this call, which must have been the latest one; so is `size`.
            size: Width and height in px.
            capacity: What the tile lists had place for; None if they had the exact length.
            counts: The numbers of pairs of the views.
        """
        self._calls.append(_Call(views, size, self._epoch, capacity, counts))

    def overflowed(self, *, wait: bool = False) -> list[int]:
        """Learn from the numbers that have arrived.

        Args:
            wait: Whether to wait for those of all calls.

        Returns:
            The views of calls that needed more places than they had, and therefore drew nothing.
        """
        lost: list[int] = []
        while self._calls and (wait or self._calls[0].counts.ready()):
            call = self._calls.popleft()
            counts = call.counts.wait()
            for view, num_pairs in zip(call.views, counts, strict=True):
                before = self._visits.get((view, call.size))
                self._visits[view, call.size] = _Visit(call.epoch, num_pairs)
                if before is not None and call.epoch == self._epoch:
                    self._changes.append((before.epoch, (num_pairs + _SMALL) / (before.num_pairs + _SMALL)))
            if call.capacity is not None and sum(counts) > call.capacity:
                self.times_overflowed += 1
                lost += call.views
        return lost


def _round_up(number: int, parts: int) -> int:
    """Round up to one of the steps that divide the way from a power of two to the next into equal parts.

    With 16 parts, at most a sixteenth is added, and the allocator of the device's memory meets sizes that it knows.
    """
    step = max((1 << number.bit_length() - 1) // parts, _LEAST_STEP)
    return -(-number // step) * step
