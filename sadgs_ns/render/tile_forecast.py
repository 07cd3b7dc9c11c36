"""Predict the length of a training step's tile lists, so that the host need not wait for it.

The number of pairs of a Gaussian and a tile changes little between two visits of a view, except where densification
lies between them. Views that were visited since then tell by how much it changed.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple, Protocol

MARGIN = 1.25  # Factor on the prediction, not measured: larger ones sort unused places, smaller ones repeat more steps
RECENT = 8  # Number of the latest visits among which the largest change is taken
MOST_PAIRS = 2**25
"""Longer lists are not predicted: unused places would take 200 MB, and rendering takes much longer than a wait."""
_SMALL = 1000  # Pairs that are added to both numbers of a change, so a view of few Gaussians tells little about others
_LEAST_STEP = 4096  # Smallest step between two capacities


class Counts(Protocol):
    """The part of `kernels.tiles.PairCounts` that is used here; importing that one needs Triton."""

    def ready(self) -> bool: ...
    def wait(self) -> list[int]: ...


class _Visit(NamedTuple):
    """A view was rendered."""

    epoch: int
    num_pairs: int


class _Change(NamedTuple):
    """By how much a view's number of pairs changed from one visit to the next."""

    epoch: int  # Of the earlier visit
    factor: float


class _Call(NamedTuple):
    """Views were rendered together; their numbers of pairs are on their way to the host."""

    views: Sequence[int]
    size: tuple[int, int]
    epoch: int
    capacity: int | None
    counts: Counts


class TileForecast:
    """Remembers how many pairs the training views had, and derives the capacity of tile lists from it.

    Views are the indices of training views, and `size` the width and height in px in which they are rendered.

    Attributes:
        round_to_powers: Whether capacities are rounded up to 2ⁿ or 1.5 · 2ⁿ, so that few different ones occur.
    """

    def __init__(self) -> None:
        self._epoch = 0  # An epoch ends when the number of Gaussians changes.
        self._num_gaussians = -1
        self._visits: dict[tuple[int, tuple[int, int]], _Visit] = {}  # The last one, by the view and its size
        self._changes: deque[_Change] = deque(maxlen=RECENT)  # Those whose later visit is of this epoch
        self._calls: deque[_Call] = deque()  # Those whose numbers were not used yet, the oldest first
        self.round_to_powers = False

    def capacity(self, views: Sequence[int], size: tuple[int, int], num_gaussians: int) -> int | None:
        """Predict how many places the tile lists of a call should have.

        It is the sum over the views of the number of pairs at the last visit in this size, times the largest recent
        growth of any view, times MARGIN, rounded up so that few different numbers occur.

        None means that the host must wait: a view was never visited, no view was visited since a densification, or
        there are more than MOST_PAIRS.
        """
        if num_gaussians != self._num_gaussians:
            self._epoch += 1
            self._num_gaussians = num_gaussians
            self._changes.clear()
        total = 0.0
        for view in views:
            visit = self._visits.get((view, size))
            if visit is None:
                return None
            factors = [change.factor for change in self._changes if change.epoch <= visit.epoch]
            if visit.epoch < self._epoch and not factors:
                return None
            largest_factor = max([1.0, *factors])
            total += largest_factor * visit.num_pairs
        rounded = self._round_up(int(MARGIN * total) + 1)
        if rounded > MOST_PAIRS:
            return None
        return rounded

    def _round_up(self, number: int) -> int:
        """Round a number > 0 up, so that few different ones occur."""
        steps = 16  # Number of equal steps from a power of two to the next
        if self.round_to_powers:
            steps = 2
        power_of_two = 1 << (number.bit_length() - 1)  # The largest that is not above the number
        step = max(power_of_two // steps, _LEAST_STEP)
        return -(-number // step) * step

    def rendered(self, views: Sequence[int], size: tuple[int, int], capacity: int | None, counts: Counts) -> None:
        """Note the exact numbers of the call for which `capacity` was asked last; they may arrive later."""
        self._calls.append(_Call(views, size, self._epoch, capacity, counts))

    def overflowed(self, *, wait: bool = False) -> list[int]:
        """Use the numbers that have arrived, or wait for all of them; return the views of calls that overflowed."""
        lost: list[int] = []
        while self._calls and (wait or self._calls[0].counts.ready()):
            call = self._calls.popleft()
            counts = call.counts.wait()
            for view, num_pairs in zip(call.views, counts, strict=True):
                before = self._visits.get((view, call.size))
                self._visits[view, call.size] = _Visit(call.epoch, num_pairs)
                if before is not None and call.epoch == self._epoch:
                    factor = (num_pairs + _SMALL) / (before.num_pairs + _SMALL)
                    self._changes.append(_Change(before.epoch, factor))
            if call.capacity is not None and sum(counts) > call.capacity:
                lost += call.views
        return lost
