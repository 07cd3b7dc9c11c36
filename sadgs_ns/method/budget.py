"""How many Gaussians a run may have at a time, so that its cap is shared out over all of densification."""

from __future__ import annotations

from collections.abc import MutableMapping
from dataclasses import dataclass
from typing import Any

STATE_KEYS = ("first_count", "denied_growth", "outgrew_cap")
"""Entries of the strategy's state that hold a run's budget."""


def allowed_gaussians(first: int, cap: int, progress: float) -> int:
    """Return how many Gaussians may exist after a share `progress` of densification, in [0, 1].

    The number grows from the `first` count to the cap, fast at first and slowly at the end, because new Gaussians need
    time: a tenth of densification allows a fifth of what is between, and a half of it three quarters.
    """
    left = 1 - progress
    share = 1 - left * left
    return first + int(share * max(cap - first, 0))


@dataclass
class Budget:
    """The budget of one run. Its numbers are in the strategy's state, with which a resumed run goes on."""

    cap: int
    """Most Gaussians of all processes."""
    state: MutableMapping[str, Any]

    def room(self, present: int, wanted: int, progress: float) -> int:
        """Return how many Gaussians may be added to those present, if rules want some, and remember what is denied.

        All three count the Gaussians of all processes. The number is negative if too many are present.
        """
        first = self.state.setdefault("first_count", present)
        allowed = min(allowed_gaussians(first, self.cap, progress), self.cap)
        room = allowed - present
        granted = max(min(wanted, room), 0)
        # What was denied would have grown further, in proportion.
        denied = self.state.get("denied_growth", 1.0)
        without_cap = denied * (present + wanted)
        self.state["denied_growth"] = without_cap / (present + granted)
        if without_cap > self.cap:
            self.state["outgrew_cap"] = True
        return room

    @property
    def outgrew_cap(self) -> bool:
        """Whether the run would have had more Gaussians than the cap at some time, if there were none."""
        return self.state.get("outgrew_cap", False)
