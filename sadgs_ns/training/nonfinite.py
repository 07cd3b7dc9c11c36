"""Losses and gradients that are not finite.

They are flagged on the device in each step and read now and then, so that no step waits for the device.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

MAX_GRADIENT = 1e18
"""A gradient at least this large counts as not finite, because from 1.8e19 its square overflows for good in Adam."""

DIVERGED_STEPS = 100
"""Number of steps in a row with something not finite after which a run stops, if its gradients are useless, too."""


class NonFiniteLog:
    """A log of the losses, and of gradients that were left out, in the training steps since it was last read.

    Attributes:
        capacity: Number of steps that the log holds.
        steps: Number of all steps that have been read.
        streak: Number of the latest of these in a row in which something was not finite.
    """

    def __init__(self, device: torch.device | str, capacity: int = 100) -> None:
        self._losses: list[Tensor] = []  # They are scalars, which stay where they are until the log is read.
        # The first column is NaN where a gradient was left out. Rows have 16 bytes, because Triton would compile Adam
        # anew for rows that are less aligned.
        self._gradients = torch.zeros((capacity, 4), device=device)
        self._slots = self._gradients[:, :1].unbind()  # They are made once, because slicing takes the host long.
        self._steps: list[tuple[int, list[int]]] = []
        self.capacity, self.steps, self.streak = capacity, 0, 0

    @property
    def full(self) -> bool:
        """Whether the log must be read before it can hold another step."""
        return len(self._steps) >= self.capacity

    @property
    def slot(self) -> Tensor:
        """Where the present step, before it is recorded, notes with NaN that a gradient was not finite, float32 [1]."""
        return self._slots[len(self._steps)]

    def record(self, step: int, views: list[int], loss: Tensor) -> None:
        """Note the loss of a step of these views, a scalar that nobody changes in place; the device has no work."""
        self._losses.append(loss)
        self._steps.append((step, views))

    def read(self) -> list[tuple[int, list[int], str]]:
        """Return the steps in which something was not finite, and empty the log; this waits for the device.

        Returns:
            For each such step its number, its views, and "the loss was nan" (or inf) or "gradients were not finite".
        """
        if not self._steps:
            return []
        wrong = []
        losses, gradients = torch.stack(self._losses).tolist(), self._gradients[: len(self._steps), 0].tolist()
        for (step, views), loss, gradient in zip(self._steps, losses, gradients, strict=True):
            if not math.isfinite(loss):
                what = f"the loss was {loss}"
            elif not math.isfinite(gradient):
                what = "gradients were not finite"
            else:
                self.streak = 0
                continue
            self.streak += 1
            wrong.append((step, views, what))
        self.steps += len(self._steps)
        self._steps.clear()
        self._losses.clear()
        self._gradients.zero_()
        return wrong


@torch.no_grad()
def leave_out_nonfinite(gradient: Tensor, nonfinite_flag: Tensor) -> None:
    """Set gradients from which Adam could not recover to 0, in place, without waiting for the device.

    `nonfinite_flag`, float32 [1], becomes NaN if there was such a gradient.
    """
    wrong = ~(gradient.abs() < MAX_GRADIENT)  # Comparing NaN gives False.
    gradient.masked_fill_(wrong, 0.0)
    nonfinite_flag.masked_fill_(wrong.any(), torch.nan)


def has_no_update(gradient: Tensor) -> bool:
    """Return whether no element of a gradient changes its parameter; this waits for the device."""
    size = gradient.abs()
    return not bool(((size > 0) & (size < MAX_GRADIENT)).any())
