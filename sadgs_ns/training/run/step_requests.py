"""What the processes of a run ask of each other in a step, so that all of them do it after the same step."""

from __future__ import annotations

from dataclasses import dataclass

from sadgs_ns.interrupts import SIGNALS

_SAVE = 1  # The bit of `save`; no signal has the number 0, and each has the bit of its number.


@dataclass(frozen=True)
class StepRequests:
    """What one process asks for, or what any of them has asked for."""

    save: bool = False  # Save a checkpoint.
    signals: tuple[int, ...] = ()  # Stop because of these signals, by their numbers, in the order of `SIGNALS`.

    def encode(self) -> int:
        """Return one whole number for `World.flags_out`; the bitwise or of all processes' holds what any asks for."""
        flags = 0
        if self.save:
            flags |= _SAVE
        for number in self.signals:
            flags |= 1 << number
        return flags

    @classmethod
    def decode(cls, flags: int) -> StepRequests:
        """Return what was asked for, given `World.flags_in`."""
        save = flags & _SAVE != 0
        signals = tuple(int(number) for number in SIGNALS if flags & 1 << number)
        return cls(save, signals)
