"""Where the time of a training step goes.

A step is taken apart at seams that every splatting model of nerfstudio has: its rendering, its losses, autograd's
backward pass and the optimizers. Whatever lies between them is the rest, so the phases always add up to the step.
"""

from __future__ import annotations

import contextlib
import itertools
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

import sadgs_ns.method.strategy
from benchmarks.evaluate import now

PHASES: tuple[str, ...] = ("rasterize_forward", "rasterize_backward", "loss", "eta", "optimizer", "rest")
STEPS = 30
"""Steps that are measured, at least."""
WARMUP = 3
"""Steps before them."""

_SCHEDULE = ("refine_every", "reset_every", "structure_every", "absgs_every", "refine_stop_iter")
"""Fields of a strategy, gsplat's or ours, that say when it densifies; ours derives those that are None."""
_FAR = {"refine_stop_iter": sys.maxsize // 2, "absgs_every": sys.maxsize // 8}
"""Where they are put, if not to a quarter of the largest integer: the end lies behind all that is due, and the next
AbsGS step before the next structure step, which would forget its gradients."""


@contextlib.contextmanager
def replaced(owner: Any, name: str, wrap: Callable[[Callable[..., Any]], Callable[..., Any]]) -> Iterator[None]:
    """For the duration, calls of a function of a module, class or object go to `wrap(function)`."""
    own = vars(owner).get(name)
    setattr(owner, name, wrap(getattr(owner, name)))
    try:
        yield
    finally:
        if own is None:
            delattr(owner, name)  # it was the class's
        else:
            setattr(owner, name, own)


class Stopwatch:
    """Books the time between marks under phases.

    On CUDA a mark is an event in the GPU's own queue, so that neither waits for the other; elsewhere it is the clock's
    time. Time in which the GPU waits for the host counts for the phase that it waits in.
    """

    def __init__(self, device: torch.device) -> None:
        self._device = device
        self._marks: list[tuple[str, Any]] = [("rest", None)]  # the phase that begins, and when

    @property
    def phase(self) -> str:
        """What time is booked under now."""
        return self._marks[-1][0]

    def restart(self) -> None:
        """Forget what was booked."""
        now()
        self._marks.clear()
        self.begin("rest")

    def begin(self, phase: str) -> None:
        """Book the time from now on under a phase."""
        if self._device.type == "cuda":
            when: Any = torch.cuda.Event(enable_timing=True)
            when.record(torch.cuda.current_stream(self._device))
        else:
            when = time.perf_counter()
        self._marks.append((phase, when))

    def seconds(self) -> dict[str, float]:
        """Seconds of each phase since `restart`; they add up to all of the time since then."""
        self.begin(self.phase)
        now()
        total = dict.fromkeys(PHASES, 0.0)
        for (phase, start), (_, end) in itertools.pairwise(self._marks):
            total[phase] += start.elapsed_time(end) / 1000 if self._device.type == "cuda" else end - start
        return total

    def during(self, phase: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """A function whose time is booked under a phase, and what follows it as what came before."""

        def booked(*args: Any, **kwargs: Any) -> Any:
            before = self.phase
            self.begin(phase)
            try:
                return function(*args, **kwargs)
            finally:
                self.begin(before)

        return booked

    def when_gradient_arrives(self, tensor: Any, phase: str) -> None:
        """In the backward pass, book the time from the tensor's gradient on under a phase."""
        if isinstance(tensor, Tensor) and tensor.requires_grad:
            tensor.register_hook(lambda _: self.begin(phase))


@contextlib.contextmanager
def booked(trainer: Any, watch: Stopwatch) -> Iterator[None]:
    """For the duration, a nerfstudio Trainer's steps are booked by phase."""
    model, optimizers = trainer.pipeline.model, trainer.optimizers

    def booking(forward: str, backward: str, tensors: Callable[[Any], Iterable[Any]]) -> Callable[..., Any]:
        """Book a function under a phase, and the backward pass from its tensors' gradients on under another."""

        def wrap(function: Callable[..., Any]) -> Callable[..., Any]:
            def call(*args: Any, **kwargs: Any) -> Any:
                result = watch.during(forward, function)(*args, **kwargs)
                for tensor in tensors(result):
                    watch.when_gradient_arrives(tensor, backward)
                return result

            return call

        return wrap

    # sadgs trains on several views at once, which nerfstudio's method cannot express.
    render = "get_training_outputs" if hasattr(model, "get_training_outputs") else "get_outputs"
    places: list[tuple[Any, str, Any]] = [
        (model, render, booking("rasterize_forward", "rasterize_backward", lambda outputs: [outputs["rgb"]])),
        # With several renderings a step, the backward pass of one begins where its loss has a gradient.
        (model, "get_loss_dict", booking("loss", "loss", dict.values)),
        (torch.Tensor, "backward", partial(watch.during, "loss")),
        (sadgs_ns.method.strategy, "observe", partial(watch.during, "eta")),
    ]
    zeroing_and_steps = ("zero_grad_some", "optimizer_scaler_step_some", "scheduler_step_all")
    places += [(optimizers, name, partial(watch.during, "optimizer")) for name in zeroing_and_steps]
    if getattr(trainer, "graphed", None) is not None:  # A graph has no seams.
        places.append((trainer, "graphed", lambda graphed: None))
    with contextlib.ExitStack() as stack:
        for place in places:
            stack.enter_context(replaced(*place))
        yield


@contextlib.contextmanager
def within_densification(model: Any) -> Iterator[None]:
    """For the duration, a model's strategy collects its statistics as before it stopped, and never acts on them.

    Its window is opened and the next clone, split, prune and reset is put out of reach; what is off (0) stays off.
    """
    strategy, plan = getattr(model, "strategy", None), getattr(model, "plan", None)
    if strategy is None:
        yield
        return
    far = {name: _FAR.get(name, sys.maxsize // 4) for name in _SCHEDULE if getattr(strategy, name, 0)}
    try:
        model.strategy = replace(strategy, **far)
        if plan is not None:
            model.plan = replace(plan, iterations=sys.maxsize)  # The parameters are not averaged, either.
        yield
    finally:
        model.strategy = strategy
        if plan is not None:
            model.plan = plan


def measure(trainer: Any, steps: int = STEPS) -> dict[str, float]:
    """Train some steps beyond the end of a run and take their time apart.

    In these steps the strategy observes η and gathers gradients as in one that AbsGS reads, but densifies nothing, so
    they take longer than the run's mean step. `rasterize_forward` ends with the image, `rasterize_backward` begins with
    its gradient, and `loss` lies between. `eta` is the observation's share of each step, `optimizer` includes zeroing
    gradients and the rates' schedules, and `rest` is choosing views, metrics and nerfstudio's overhead.

    `trainer` is nerfstudio's after `train`, and `steps` are rounded up to a multiple of `eta_every`. Returns the mean
    milliseconds of each phase in a step; their sum is the step's wall time.
    """
    model, measured = trainer.pipeline.model, steps_after_run(trainer, steps)
    watch = Stopwatch(torch.device(model.device))
    with within_densification(model), booked(trainer, watch):
        for step in range(measured.start - WARMUP, measured.stop):
            if step == measured.start:
                watch.restart()
            train_step(trainer, step)
        seconds = watch.seconds()
    return {phase: 1000 * value / len(measured) for phase, value in seconds.items()}


def steps_after_run(trainer: Any, at_least: int) -> range:
    """Return the steps to be measured: beyond the end of a run and `WARMUP` more, in whole periods of η."""
    windows = getattr(getattr(trainer.pipeline.model, "strategy", None), "windows", None)
    every = 1 if windows is None else windows.eta_every
    first = trainer.config.max_num_iterations + WARMUP
    return range(first, first + -(-at_least // every) * every)


def train_step(trainer: Any, step: int) -> None:
    """One turn of nerfstudio's training loop."""
    from nerfstudio.engine.callbacks import TrainingCallbackLocation

    trainer.step = step
    trainer.pipeline.train()
    for callback in trainer.callbacks:
        callback.run_callback_at_location(step, location=TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
    trainer.train_iteration(step)
    for callback in trainer.callbacks:
        callback.run_callback_at_location(step, location=TrainingCallbackLocation.AFTER_TRAIN_ITERATION)
