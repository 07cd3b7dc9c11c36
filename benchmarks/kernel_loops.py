"""Training steps of one run, timed again and again from the same state, with and without a kernel.

A run trains as usual to two of its steps: to one in the middle of densification, and to one in the middle of what
follows. From each the same steps are timed for one kernel's twin after the other, in rounds, so that a machine that
becomes slower does so for all. The steps do not densify, and what nerfstudio's loop does beside steps is not timed.
"""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import torch
from nerfstudio.engine.callbacks import TrainingCallbackLocation

from benchmarks.evaluate import now
from benchmarks.kernel_twins import Twin, replaced
from sadgs_ns.method.schedule import Windows, due
from sadgs_ns.training.step.cuda_graphs import GraphedSteps

REFERENCE = "all kernels"
"""Name of the steps in which no kernel is replaced."""
LATE_STEPS = 100
"""Steps that are timed after densification."""
WARM_STEPS = 10
"""Steps that are not timed before others that are: kernels are compiled and CUDA graphs are captured."""
FILLS = 3
"""How often the structure tensors of all images are timed."""


@dataclass(frozen=True)
class Phase:
    """Steps of a run that are timed."""

    name: str  # "densification" or "after"
    begin: int  # The first of them, from 0 on
    steps: int
    weight: int  # Number of the run's steps that are like these
    captures: bool  # Whether the time in which CUDA graphs are captured counts, as after each densification


@dataclass
class Measured:
    """What was measured of a kernel's twin, or with all kernels."""

    seconds: dict[str, list[float]] = field(default_factory=dict)  # Of a phase's steps in each round
    launches: dict[str, float] = field(default_factory=dict)  # Kernels that a step of a phase launches
    replayed: dict[str, int] = field(default_factory=dict)  # Steps of a phase, with the warm ones, that were graphs
    failure: str = ""  # Why no step could be captured
    error: str = ""  # What ended the measuring


def phases_of(windows: Windows, iterations: int) -> list[Phase]:
    """Return the steps that are timed: those between two densification steps, and some after the last one.

    The next densification is by AbsGS, as most are, so that the steps sum absolute gradients.
    """
    every = windows.absgs_every
    stop = windows.refine_stop_iter
    interval = stop // every // 2
    if due((interval + 1) * every, windows.structure_every):
        interval -= 1
    begin = (stop + iterations) // 2
    return [
        Phase("densification", interval * every, every, stop, captures=True),
        Phase("after", begin, min(LATE_STEPS, iterations - begin), iterations - stop, captures=False),
    ]


class State:
    """What steps change in a run, as it was when this was made, after at least one step."""

    def __init__(self, trainer: Any) -> None:
        self._trainer = trainer
        pipeline = trainer.pipeline
        forecast = pipeline.model.tile_forecast
        if forecast is not None:
            pipeline.views.sampler.requeue(forecast.overflowed(wait=True))
            self._forecast = _copied(vars(forecast))
        sums = [value for value in pipeline.model.strategy_state.values() if isinstance(value, torch.Tensor)]
        self._tensors = [*trainer.optimizers.update().tensors(), *sums]
        self._values = [tensor.detach().clone() for tensor in self._tensors]
        self._order = copy.deepcopy(pipeline.views.sampler.state_dict())
        self._counts = [state["step"].clone() for state in self._moments() if state["step"].dim() == 0]
        self._schedules = copy.deepcopy([rates.state_dict() for rates in trainer.optimizers.schedulers.values()])
        self._rates = [group["lr"] for group in self._groups()]

    def _moments(self) -> list[dict[str, Any]]:
        """Return the state of Adam of each parameter; the count of a table's rows has a dimension."""
        return [state for adam in self._trainer.optimizers.optimizers.values() for state in adam.state.values()]

    def _groups(self) -> list[dict[str, Any]]:
        """Return the options of Adam of each parameter."""
        return [group for adam in self._trainer.optimizers.optimizers.values() for group in adam.param_groups]

    @torch.no_grad()
    def restore(self) -> None:
        """Put everything back, and drop all CUDA graphs, as densification does."""
        trainer = self._trainer
        pipeline = trainer.pipeline
        if trainer.graphed is not None:
            trainer.graphed._drop()
            if trainer.graphed.failure:
                trainer.graphed = GraphedSteps(pipeline.model)
        for tensor, value in zip(self._tensors, self._values, strict=True):
            tensor.copy_(value)
        counted = [state for state in self._moments() if state["step"].dim() == 0]
        for state, count in zip(counted, self._counts, strict=True):
            state["step"] = count.clone()
        pipeline.views.sampler.load_state_dict(copy.deepcopy(self._order))
        for schedule, saved in zip(trainer.optimizers.schedulers.values(), self._schedules, strict=True):
            schedule.load_state_dict(copy.deepcopy(saved))
        for group, rate in zip(self._groups(), self._rates, strict=True):
            group["lr"] = rate
        if pipeline.model.tile_forecast is not None:
            vars(pipeline.model.tile_forecast).update(_copied(self._forecast))


def _copied(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return attributes, of which those that hold others are copies."""
    return {name: copy.copy(value) for name, value in values.items()}


def run_to(trainer: Any, first: int, end: int) -> None:
    """Train from a step on until the steps before `end` are done, as nerfstudio's loop does."""
    for step in range(first, end):
        _call_back(trainer, step, TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
        trainer.train_iteration(step)
        _call_back(trainer, step, TrainingCallbackLocation.AFTER_TRAIN_ITERATION)


def _call_back(trainer: Any, step: int, location: TrainingCallbackLocation) -> None:
    for callback in trainer.callbacks:
        callback.run_callback_at_location(step, location=location)


def train_steps(trainer: Any, first: int, number: int) -> None:
    """Train some steps without densification."""
    log = trainer.pipeline.log
    for step in range(first, first + number):
        if log.full:
            log.read()
        _call_back(trainer, step, TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
        trainer.train_iteration(step)


def time_steps(trainer: Any, phase: Phase, state: State) -> float:
    """Return the seconds of a phase's steps, from the same state each time."""
    state.restore()
    if not phase.captures:
        train_steps(trainer, phase.begin, WARM_STEPS)
    before = now()
    train_steps(trainer, phase.begin, phase.steps)
    return now() - before


@contextmanager
def without_graphs(trainer: Any) -> Iterator[None]:
    """Launch kernels one by one within a block of code."""
    graphed = trainer.graphed
    trainer.graphed = None
    try:
        yield
    finally:
        trainer.graphed = graphed


def count_launches(trainer: Any, phase: Phase, state: State, steps: int) -> float:
    """Return how many kernels a step of a phase launches on the GPU, copies not counted."""
    state.restore()
    with without_graphs(trainer):
        train_steps(trainer, phase.begin, 1)
        now()
        with torch.profiler.profile() as profile:
            train_steps(trainer, phase.begin, steps)
            now()
    return launches_in(profile.events()) / steps


def launches_in(events: Any) -> int:
    """Count the kernels among a profile's events."""
    launches = 0
    for event in events:
        on_gpu = event.device_type.name == "CUDA"
        if on_gpu and not event.name.startswith(("Memcpy", "Memset")):
            launches += 1
    return launches


class Rounds:
    """Times the steps of a phase in rounds, and counts their launches.

    A twin that raises has the error, and is left out from then on.
    """

    def __init__(self, trainer: Any, twins: Mapping[str, Twin | None], measured: Mapping[str, Measured]) -> None:
        self._trainer = trainer
        self._twins = twins
        self._measured = measured

    def run(self, phase: Phase, rounds: int, limit: float) -> None:
        """Do at most so many rounds, and none that would begin after `limit` seconds, but for the first."""
        state = State(self._trainer)
        for name in self._twins:
            self._attempt(name, lambda name: self._prepare(name, phase, state))
        end = time.monotonic() + limit
        for number in range(rounds):
            if number > 0 and time.monotonic() > end:
                break
            for name in self._twins:
                self._attempt(name, lambda name: self._time(name, phase, state))
        state.restore()

    def _attempt(self, name: str, measure: Callable[[str], None]) -> None:
        """Measure something with a twin in its kernel's place, unless that failed before."""
        if self._measured[name].error:
            return
        try:
            with replaced(self._twins[name]), self._graphs_if_possible(name):
                measure(name)
        except Exception as error:  # CUDA, torch, gsplat and Triton each raise their own.
            self._measured[name].error = f"{type(error).__name__}: {error}".splitlines()[0]

    @contextmanager
    def _graphs_if_possible(self, name: str) -> Iterator[None]:
        """Launch the kernels of a twin that waits one by one: a capture that fails takes time."""
        twin = self._twins[name]
        if twin is not None and twin.waits:
            with without_graphs(self._trainer):
                yield
        else:
            yield

    def _prepare(self, name: str, phase: Phase, state: State) -> None:
        """Train the warm steps of a phase, and count the launches of a step if there is a GPU.

        `_attempt` has put the twin `name` in its kernel's place.
        """
        state.restore()
        train_steps(self._trainer, phase.begin, WARM_STEPS)
        if torch.cuda.is_available():
            # A step that observes η launches more kernels; over this many steps, the mean has its share of one.
            steps_per_observation = self._trainer.pipeline.model.strategy.windows.eta_every
            num_steps = min(steps_per_observation, phase.steps)
            launches = count_launches(self._trainer, phase, state, num_steps)
            self._measured[name].launches[phase.name] = launches

    def _time(self, name: str, phase: Phase, state: State) -> None:
        measured = self._measured[name]
        before = self._replayed()
        seconds = time_steps(self._trainer, phase, state)
        measured.seconds.setdefault(phase.name, []).append(seconds)
        measured.replayed[phase.name] = self._replayed() - before
        if self._trainer.graphed is not None:
            measured.failure = self._trainer.graphed.failure

    def _replayed(self) -> int:
        """Return how many steps were replayed so far."""
        graphed = self._trainer.graphed
        if graphed is None:
            return 0
        return graphed.replayed


def time_images(trainer: Any, twin: Twin | None) -> float:
    """Return the seconds in which the structure tensors of all training images are computed, the least of some."""
    cache = trainer.pipeline.structure_cache
    seconds = []
    with replaced(twin):
        for _ in range(1 + FILLS):
            cache.filled = False
            before = now()
            cache.fill()
            seconds.append(now() - before)
    return min(seconds[1:])
