"""How many Gaussians a run may have at a time, so that its cap is spread over all of densification."""

from __future__ import annotations

from collections.abc import MutableMapping
from dataclasses import dataclass
from typing import Any

STATE_KEYS = ("first_count", "denied_growth", "outgrew_cap")
"""Entries of the strategy's state that hold a run's budget."""


def growth_share(progress: float) -> float:
    """Return which share of the growth up to the cap is allowed after a share of densification, both in [0, 1].

    It rises fast at first and slowly at the end, because new Gaussians need time: a tenth of densification allows a
    fifth of the growth, and a half of it three quarters.
    """
    left = 1 - progress
    return 1 - left * left


@dataclass
class Budget:
    """The budget of one run. Its numbers are in the strategy's state, with which a resumed run goes on."""

    cap: int
    """Most Gaussians of all processes."""
    state: MutableMapping[str, Any]

    def room(self, present: int, wanted: int, progress: float) -> int:
        """Return how many Gaussians may be added to those present, and remember what that denies.

        The allowed number grows from that of the first call to the cap. Counts are those of all processes, and
        `progress` is the share of densification that is done. The result is negative if too many are present.
        """
        first = self.state.setdefault("first_count", present)
        growth = max(self.cap - first, 0)
        allowed = first + int(growth_share(progress) * growth)
        room = min(allowed, self.cap) - present
        granted = max(min(wanted, room), 0)
        # What was denied before would have grown in proportion.
        without_cap = self.state.get("denied_growth", 1.0) * (present + wanted)
        self.state["denied_growth"] = without_cap / (present + granted)
        if without_cap > self.cap:
            self.state["outgrew_cap"] = True
        return room

    @property
    def outgrew_cap(self) -> bool:
        """Whether the run would have had more Gaussians than the cap at some time, if there were none."""
        return self.state.get("outgrew_cap", False)
