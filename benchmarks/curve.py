"""The clock of the training loop, and how quality rises with time: held-out views measured while the clock stands."""

from __future__ import annotations

import contextlib
import random
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation

from benchmarks import evaluate
from benchmarks.evaluate import now


class LoopTimer:
    """Times the training loop, and nothing else, from two of the trainer's callbacks.

    The GPU is waited for at the first and at the last iteration, and where the timer is stopped.
    """

    def __init__(self) -> None:
        self.seconds: float = 0.0
        """Seconds in the loop before the timer last stopped."""
        self.peak_gb: float | None = None
        """Largest GPU memory that tensors took in the loop, in 10⁹ bytes; None without a GPU."""
        self.finished: bool = False
        """Whether the last iteration has ended."""
        self._start = 0.0

    def attach(self, trainer: Any) -> None:
        """Register with a nerfstudio Trainer that is set up."""
        last = trainer.config.max_num_iterations - 1
        before = TrainingCallbackLocation.BEFORE_TRAIN_ITERATION
        after = TrainingCallbackLocation.AFTER_TRAIN_ITERATION
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


@contextlib.contextmanager
def undisturbed(pipeline: Any) -> Iterator[None]:
    """Put a nerfstudio pipeline in eval mode, and afterwards everything as it was.

    That is the training mode, the random states of Python, numpy and torch, and what rendering notes on the model:
    splatfacto's strategy still reads the `info` of the step's own rendering.
    """
    training = pipeline.training
    noted = dict(vars(pipeline.model))
    python = random.getstate()
    numpy = np.random.get_state()
    devices = [torch.cuda.current_device()] if torch.cuda.is_available() else []
    pipeline.eval()
    try:
        with torch.random.fork_rng(devices):
            yield
    finally:
        random.setstate(python)
        np.random.set_state(numpy)
        pipeline.train(training)
        vars(pipeline.model).clear()
        vars(pipeline.model).update(noted)


class Curve:
    """Measures the held-out views every so many iterations of a run, while its timer is stopped.

    It does so right after the optimizers' step and before what the iteration densifies: a split or an opacity reset
    lowers quality for some steps, and methods that densify at other iterations would show it differently.
    """

    def __init__(self, every: int, timer: LoopTimer) -> None:
        self.points: list[dict[str, Any]] = []
        """In the order of iterations, each with `step` (iterations done), `seconds` of the loop so far, `psnr`, `ssim`,
        `lpips` and `gaussians`. The run's last iteration is not among them: the evaluation after the run measures it.
        """
        self._every = every
        self._timer = timer
        self._lpips: Any = None  # The network of LPIPS, once it is needed

    def attach(self, trainer: Any) -> None:
        """Register with a nerfstudio Trainer that is set up."""

        def measure(step: int) -> None:
            pipeline = trainer.pipeline
            with self._timer.stopped(), undisturbed(pipeline):
                if self._lpips is None:
                    self._lpips = evaluate.load_lpips()
                views = pipeline.datamanager.fixed_indices_eval_dataloader
                measured = evaluate.quality(pipeline.model, views, self._lpips)
            self.points.append(point(step + 1, self._timer.seconds, measured, int(pipeline.model.num_points)))

        iterations = tuple(range(self._every - 1, trainer.config.max_num_iterations - 1, self._every))
        after = TrainingCallbackLocation.AFTER_TRAIN_ITERATION
        trainer.callbacks.insert(0, TrainingCallback([after], measure, iters=iterations))


def point(step: int, seconds: float, measured: dict[str, float | None], gaussians: int) -> dict[str, Any]:
    """A point of the curve, from what `evaluate.quality` measured."""
    quality = {name: measured[name] for name in ("psnr", "ssim", "lpips")}
    return {"step": step, "seconds": seconds, **quality, "gaussians": gaussians}
