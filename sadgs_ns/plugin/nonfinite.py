"""Losses and gradients that are not finite: noted on the device in each step and read now and then, so none waits."""

from __future__ import annotations

import math

import torch
from torch import Tensor

MAX_GRADIENT = 1e18
"""A gradient at least this large counts as not finite: from 1.8e19 its square overflows for good in Adam."""

HOPELESS_STEPS = 100
"""A run stops after so many steps in a row in which something was not finite, if it also learns nothing any more."""


class NonFiniteLog:
    """What happened in the training steps since it was last read.

    `steps` counts all steps that were read, `streak` those at their end in which something was not finite.

    Args:
        device: Where losses and gradients are.
        capacity: Steps it holds.
    """

    def __init__(self, device: torch.device | str, capacity: int = 100) -> None:
        self._losses = torch.zeros(capacity, device=device)
        # NaN where one was left out. Rows of 16 bytes: Triton would compile Adam anew for a less aligned one.
        self._gradients = torch.zeros((capacity, 4), device=device)
        self._slots = self._gradients[:, :1].unbind()  # views made once: slicing takes the host long
        self._steps: list[tuple[int, list[int]]] = []
        self.steps = self.streak = 0

    @property
    def full(self) -> bool:
        """Whether it must be read before it can hold another step."""
        return len(self._steps) == len(self._losses)

    def begin_step(self, step: int, views: list[int], loss: Tensor) -> None:
        """Note a step's loss, in one small copy on the device.

        Args:
            step: Counted from 0.
            views: Indices of the step's training views.
            loss: Scalar.
        """
        self._losses[len(self._steps)] = loss.detach()
        self._steps.append((step, views))

    @property
    def gradients(self) -> Tensor:
        """Where the present step notes, with NaN, that a gradient was not finite. float32 [1]"""
        return self._slots[max(len(self._steps) - 1, 0)]

    def read(self) -> list[tuple[int, list[int], str]]:
        """Steps in which something was not finite, and forget all; waits for the device.

        Returns:
            Step, its views, and what was wrong: "the loss was nan" or "gradients were not finite".
        """
        wrong = []
        for (step, views), loss, gradient in zip(
            self._steps, self._losses.tolist(), self._gradients[:, 0].tolist(), strict=False
        ):
            if not math.isfinite(loss):
                wrong.append((step, views, f"the loss was {loss}"))
            elif not math.isfinite(gradient):
                wrong.append((step, views, "gradients were not finite"))
            else:
                self.streak = -1
            self.streak += 1
        self.steps += len(self._steps)
        self._steps.clear()
        self._gradients.zero_()
        return wrong


@torch.no_grad()
def leave_out_nonfinite(gradient: Tensor, noted: Tensor) -> None:
    """Set gradients of which Adam could not recover to 0, in place, without waiting for the device.

    Args:
        gradient: Any shape.
        noted: Becomes NaN if there was one. [1]
    """
    wrong = ~(gradient.abs() < MAX_GRADIENT)  # NaN compares as False
    gradient.masked_fill_(wrong, 0.0)
    noted.masked_fill_(wrong.any(), torch.nan)


def is_useless(gradient: Tensor) -> bool:
    """Whether no element of a gradient changes its parameter; waits for the device.

    Args:
        gradient: Any shape, before or after `leave_out_nonfinite`.
    """
    size = gradient.abs()
    return not bool(((size > 0) & (size < MAX_GRADIENT)).any())
