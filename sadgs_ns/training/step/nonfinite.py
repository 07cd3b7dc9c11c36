"""Losses and gradients that are not finite. The device flags them, and the host reads the flags now and then."""

from __future__ import annotations

import math

import torch
from torch import Tensor

MAX_GRADIENT = 1e18  # Gradients this large count as not finite: from 1.8e19 their square overflows for good in Adam
DIVERGED_STEPS = 100  # Steps in a row that were not finite after which a run stops, if its gradients move nothing, too


class NonFiniteLog:
    """Losses and flags of up to `capacity` steps.

    Attributes:
        capacity: The most steps that the log holds until it is read.
        steps: Number of steps that were read.
        streak: Number of the last of them that were not finite.
    """

    def __init__(self, device: torch.device | str, capacity: int = 100) -> None:
        self._losses: list[Tensor] = []  # scalars on the device
        # The first column is NaN if a gradient was left out. A row has 16 bytes, because Triton would compile Adam anew
        # for an address that is no multiple of 16.
        self._gradients = torch.zeros((capacity, 4), device=device)
        self._flags = self._gradients[:, :1].unbind()  # made once, because slicing takes the host long
        self._recorded: list[tuple[int, list[int]]] = []  # Number and views of each step
        self.capacity = capacity
        self.steps = 0
        self.streak = 0

    @property
    def full(self) -> bool:
        """Whether the log must be read before it can hold another step."""
        return len(self._recorded) >= self.capacity

    @property
    def nonfinite_flag(self) -> Tensor:
        """The flag of the present step, which is not recorded yet; NaN if a gradient was not finite. float32 [1]"""
        return self._flags[len(self._recorded)]

    def record(self, step: int, views: list[int], loss: Tensor) -> None:
        """Add a step with its views and its loss, a scalar that must not change in place."""
        self._losses.append(loss)
        self._recorded.append((step, views))

    def read(self) -> list[tuple[int, list[int], str]]:
        """Return number, views and problem of each step that was not finite, and empty the log.

        This waits for the device.
        """
        if not self._recorded:
            return []
        problems = []
        losses = torch.stack(self._losses).tolist()
        gradients = self._gradients[: len(self._recorded), 0].tolist()
        for (step, views), loss, gradient in zip(self._recorded, losses, gradients, strict=True):
            problem = None
            if not math.isfinite(loss):
                problem = f"the loss was {loss}"
            elif not math.isfinite(gradient):
                problem = "gradients were not finite"
            if problem is None:
                self.streak = 0
            else:
                self.streak += 1
                problems.append((step, views, problem))
        self.steps += len(self._recorded)
        self._recorded.clear()
        self._losses.clear()
        self._gradients.zero_()
        return problems


@torch.no_grad()
def leave_out_nonfinite(gradient: Tensor, nonfinite_flag: Tensor) -> None:
    """Set gradients that are not finite to 0, in place, and `nonfinite_flag` [1] to NaN if there were some."""
    nonfinite = ~(gradient.abs() < MAX_GRADIENT)  # Comparing NaN gives False.
    gradient.masked_fill_(nonfinite, 0.0)
    nonfinite_flag.masked_fill_(nonfinite.any(), torch.nan)


def has_no_update(gradient: Tensor) -> bool:
    """Tell whether a gradient changes no parameter; this waits for the device."""
    size = gradient.abs()
    return not bool(((size > 0) & (size < MAX_GRADIENT)).any())
