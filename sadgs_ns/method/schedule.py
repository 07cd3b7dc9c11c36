"""The length of a run, the views of a step, and the times of densification, derived from the capture.

A *view visit* is one rendering of one training view with its gradients. Many visits to few views overfit, and few
visits to many views underfit, so it grows with the number of views (docs/results.md#why-these-defaults).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

BASE_VISITS = 2000
"""View visits of every run, before those for each view."""
VISITS_PER_VIEW = 50
"""View visits of a run for each training view."""
STEPS_BEFORE_VIEWS = 2000
"""Optimizer steps that a run should have before its steps take one more view."""
MOST_EFFORT = 100
"""Largest `effort`: a million iterations of four views for a capture of 760."""
MOST_VIEWS = 4
"""Largest number of views in a step that is derived."""
FULL_VISITS_FROM = (50, 90)
"""Up to the first number of views, visits grow with the square root of an effort above 1, because more of them overfit.
From the second on, they grow with effort itself."""
GROWTH_WITH_EFFORT = -0.32
"""Power of effort above 1 that multiplies the thresholds of growth where views are many."""
MORE_GROWTH_FROM = (20, 60)
"""Up to the first number of views, effort leaves the thresholds of growth as they are; from the second on, its whole
power multiplies them."""
DROPOUT_FROM = 85
"""Visits to each view above which Gaussians are left out of steps (docs/results.md#the-ladder)."""
DROPOUT_PER_DOUBLING = 0.1
"""Probability of being left out that each doubling of those visits adds, up to `DROPOUT_VIEWS` training views."""
DROPOUT_VIEWS = 40
"""Training views above which that probability falls as one over their number."""
MOST_DROPOUT = 0.25
"""Largest such probability."""
DENSIFICATION_SHARE = 16 / 30
"""Share of a run in which Gaussians are added and removed."""
RESETS_FROM = 600
"""Shortest run that resets opacities, in iterations: a reset cost shorter ones 2.7 to 11 dB (docs/results.md)."""
LATEST_STOP = (19, 30)
"""Largest share of a run in which Gaussians may be added and removed, as a fraction (released code)."""
_PARTS = 30
"""A run is divided into this many parts of equal length, in whole iterations."""
_WINDOWS = {
    "structure_every": 5,
    "absgs_every": 1,
    "refine_start_iter": 1,
    "refine_stop_iter": round(_PARTS * DENSIFICATION_SHARE),
    "reset_every": 12,
    "eta_every": 0.1,
}
"""`Windows` in parts of the run."""


@dataclass(frozen=True)
class Schedule:
    """The length of a run."""

    iterations: int
    """Optimizer steps."""
    views_per_iteration: int
    """Views that are rendered for one of them; the loss is their mean."""


@dataclass(frozen=True)
class Windows:
    """The times of densification, as the options of `StructureAwareStrategy` that have these names."""

    structure_every: int
    absgs_every: int
    refine_start_iter: int
    refine_stop_iter: int
    reset_every: int
    eta_every: int


def schedule(
    num_views: int, *, effort: float = 1.0, iterations: int | None = None, views_per_iteration: int | None = None
) -> Schedule:
    """Derive the length of a run from the number of its training views, at least 1; given numbers stay.

    With effort 1 the run visits views 2,000 + 50 · num_views times. Another effort, > 0, multiplies that; above 1 its
    square root does so if views are few (`FULL_VISITS_FROM`). A step takes one more view for every 2,000 visits, up to
    four.
    """
    visits = _view_visits(num_views, effort)
    if views_per_iteration is None:
        affordable = int(visits) // STEPS_BEFORE_VIEWS
        affordable = min(affordable, MOST_VIEWS)
        views_per_iteration = max(affordable, 1)
    views_per_iteration = min(views_per_iteration, num_views)
    if iterations is None:
        iterations = math.ceil(visits / views_per_iteration)
    return Schedule(iterations, views_per_iteration)


def _view_visits(num_views: int, effort: float) -> float:
    """Derive how many view visits a run should have."""
    power = 1.0
    if effort > 1:
        power = (1 + _share_between(FULL_VISITS_FROM, num_views)) / 2
    return effort**power * (BASE_VISITS + VISITS_PER_VIEW * num_views)


def _share_between(bounds: tuple[int, int], num_views: int) -> float:
    """Return 0 up to the first number of views, 1 from the second on, and linearly between them."""
    few, many = bounds
    share = (num_views - few) / (many - few)
    share = max(share, 0.0)
    return min(share, 1.0)


def dropout(length: Schedule, num_views: int) -> float:
    """Derive the probability with which a step leaves a Gaussian out, from how often the run visits each view.

    It grows with the logarithm of these visits, from 0 at `DROPOUT_FROM` of them, and less if views are many.
    """
    visits_of_each = length.iterations * length.views_per_iteration / num_views
    doublings = math.log2(max(visits_of_each, 1.0) / DROPOUT_FROM)
    rate = DROPOUT_PER_DOUBLING * doublings
    rate *= min(1.0, DROPOUT_VIEWS / num_views)
    rate = max(rate, 0.0)
    return min(rate, MOST_DROPOUT)


@lru_cache(maxsize=64)
def windows(iterations: int, **given: int | None) -> Windows:
    """Derive the times of densification from the number of iterations; fields that are given and not None stay.

    In the proportions of the released code: of thirty parts of the run, an AbsGS step ends each from the first to the
    sixteenth, a structure step takes the place of every fifth, and opacities are reset once after twelve, but not in
    runs of fewer than `RESETS_FROM` iterations. Densification ends after at most 19/30 of the run; where that is before
    `refine_start_iter`, there is none. Raises TypeError if another name is given.
    """
    part = round(iterations / _PARTS)
    part = max(part, 1)
    derived = {name: max(round(parts * part), 1) for name, parts in _WINDOWS.items()}
    if iterations < RESETS_FROM:
        derived["reset_every"] = 0
    chosen = {name: value for name, value in given.items() if value is not None}
    result = Windows(**(derived | chosen))
    numerator, denominator = LATEST_STOP
    latest = iterations * numerator // denominator
    stop = min(result.refine_stop_iter, latest)
    if stop < result.refine_start_iter:
        stop = 0
    return replace(result, refine_stop_iter=stop)


def due(iteration: int, every: int) -> bool:
    """Tell whether something that happens every `every` iterations happens at this one; 0 is never."""
    return every > 0 and iteration % every == 0


def next_due(iteration: int, every: int) -> float:
    """Return the first iteration, from this one on, at which it is `due`; infinity if never."""
    if every <= 0:
        return math.inf
    return math.ceil(iteration / every) * every


def growth_threshold(effort: float, num_views: int) -> float:
    """Factor on the gradients at which AbsGS adds Gaussians: effort above 1 adds more of them if views are many."""
    if effort <= 1:
        return 1.0
    return effort ** (GROWTH_WITH_EFFORT * _share_between(MORE_GROWTH_FROM, num_views))


def between_one_and_four(views_per_iteration: int, at_four: float) -> float:
    """Interpolate a factor on a learning rate, which is 1 in steps of one view, to steps of several views.

    From four views on it is `at_four`, > 0; below, it is the power of the number of views that is `at_four` at four.
    """
    power = min(math.log(views_per_iteration, MOST_VIEWS), 1.0)
    return float(at_four**power)
