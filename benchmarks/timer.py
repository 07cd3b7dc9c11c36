"""The clock of the training loop."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import torch

from benchmarks.evaluate import now


class LoopTimer:
    """Times the training loop, and nothing else, from two of the trainer's callbacks.

    The GPU is waited for at the first and at the last iteration, and where the timer is stopped.
    """

    def __init__(self) -> None:
        self.seconds: float = 0.0
        """Time in the loop, until it was last stopped."""
        self.peak_gb: float | None = None
        """Largest memory that tensors took in the loop, in 10⁹ bytes; None without a GPU."""
        self.finished: bool = False
        """Whether the last iteration has ended."""
        self._start = 0.0

    def attach(self, trainer: Any) -> None:
        """Register with a nerfstudio Trainer that is set up."""
        from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation

        last = trainer.config.max_num_iterations - 1
        before, after = TrainingCallbackLocation.BEFORE_TRAIN_ITERATION, TrainingCallbackLocation.AFTER_TRAIN_ITERATION
        trainer.callbacks.insert(0, TrainingCallback([before], lambda step: self._go(), iters=(0,)))
        trainer.callbacks.append(TrainingCallback([after], self._end, iters=(last,)))

    @contextlib.contextmanager
    def stopped(self) -> Iterator[None]:
        """Count neither the time nor the memory of what is done in the loop meanwhile."""
        self._stop()
        yield
        self._go()

    def _go(self) -> None:
        if torch.cuda.is_available():
            torch.cuda.reset_peak_memory_stats()
        self._start = now()

    def _stop(self) -> None:
        self.seconds += now() - self._start
        if torch.cuda.is_available():
            self.peak_gb = max(self.peak_gb or 0.0, torch.cuda.max_memory_allocated() / 1e9)

    def _end(self, step: int) -> None:
        self._stop()
        self.finished = True
