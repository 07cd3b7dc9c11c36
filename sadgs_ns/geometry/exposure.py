"""Gains of photos whose exposures differ, from the colours that their common points have in them.

A point has about one colour in all photos that see it. So the logarithm of its light in a photo is the photo's gain
plus the point's own colour, but for gloss, shade and wrong observations. Medians withstand these: points' colours are
medians over photos, photos' gains are medians over points, and both are taken in turn until they settle.

Light is in stops: a stop is a factor of 2.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

FEWEST_POINTS = 20
"""Points that a photo must share with others; one with fewer has no gain of its own."""
MOST_OBSERVATIONS = 100_000
"""More observations are thinned out evenly, because the medians' time grows with them. Twice as many find known gains
no better."""
ROUNDS = 60
"""Most rounds of medians. After 20 of them gains that change slowly along castle's walk are off by .11 to .18 stops,
after 60 by .01."""
SETTLED = 0.001
"""Stops by which no gain changes any more."""

_LARGEST = 31.0  # Stops; no colour is so far from another.
_KEY_STEP = 64.0  # Between the keys of segments, more than twice as much

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Observations:
    """K colours of points in photos. No point is observed twice in one photo."""

    views: Ints  # Indices of photos. [K]
    points: Ints  # Indices of points. [K]
    stops: Floats  # log₂ of linear light of each channel. [K, 3]

    def of_views(self, chosen: NDArray[np.bool_]) -> Observations:
        """Return the observations in some photos, bool [V]."""
        return _chosen(self, chosen[self.views])


@dataclass(frozen=True)
class Exposures:
    """Gains of V photos, and the colours that P points have at the median gain."""

    stops: Floats  # log₂ of the gains; each channel's median over known photos is 0. [V, 3]
    known: NDArray[np.bool_]  # Whether a photo has enough points; the gains of the others are 1. [V]
    points: Floats  # log₂ of the points' light at the median gain; NaN where none is known. [P, 3]
    deviation: float  # Standard deviation of the gains' mean over channels, in stops, without what noise explains
    spread: float  # Range of the gains' mean over channels, in stops
    residual_before: float  # Median distance of observations from their point's median without gains, in stops
    residual_after: float  # The same with gains


def fit_exposures(observations: Observations, num_views: int, num_points: int) -> Exposures:
    """Find the gains of photos and the points' colours. Nothing is random."""
    observations = _thinned(observations)
    shared = _shared(observations, num_points)
    counts = np.bincount(shared.views, minlength=num_views)
    known = counts >= FEWEST_POINTS
    stops = np.zeros((num_views, 3))
    if not known.any():
        return Exposures(stops, known, np.full((num_points, 3), np.nan), 0.0, 0.0, 0.0, 0.0)
    shared = shared.of_views(known)
    for _ in range(ROUNDS):
        colors = points_at_median(shared, stops, num_points)
        moved, _ = gains_of_others(shared, colors, num_views)
        change = np.abs(moved - stops).max()
        stops = moved
        if change < SETTLED:
            break
    stops -= np.median(stops[known], axis=0)
    stops[~known] = 0.0
    before = _distances(shared, np.zeros_like(stops), num_points)
    after = _distances(shared, stops, num_points)
    means = stops[known].mean(axis=1)
    # A median's standard error, of errors that are about normal; 1.48 times their median size is a deviation.
    noise = 1.25 * 1.48 * np.median(after) / np.sqrt(counts[known])
    variance = means.var() - np.square(noise).mean()
    return Exposures(
        stops=stops,
        known=known,
        points=points_at_median(observations.of_views(known), stops, num_points),
        deviation=float(np.sqrt(max(variance, 0.0))),
        spread=float(np.ptp(means)),
        residual_before=float(np.median(before)),
        residual_after=float(np.median(after)),
    )


def points_at_median(observations: Observations, stops: Floats, num_points: int) -> Floats:
    """Return log₂ of the points' light at the median gain, given the photos' gains [V, 3]; NaN without any. [P, 3]"""
    values = observations.stops - stops[observations.views]
    return _medians(values, observations.points, num_points)


def mean_gains(views: Ints, points: Ints, stops: Floats, num_points: int) -> Floats:
    """Return the mean of log₂ of the gains of the photos that show each point; 0 if none does. [P, 3]

    Args:
        views: Photos of K pairs of a photo and a point that it shows. [K]
        points: Points of these pairs. [K]
        stops: log₂ of the gains of all photos. [V, 3]
        num_points: P.
    """
    counts = np.bincount(points, minlength=num_points)
    columns = []
    for channel in stops[views].T:
        columns.append(np.bincount(points, channel, num_points) / np.maximum(counts, 1))
    return np.stack(columns, axis=1)


def gains_of_others(observations: Observations, points: Floats, num_views: int) -> tuple[Floats, NDArray[np.bool_]]:
    """Return log₂ of the gains of photos that had no part in the points' colours [P, 3], and whether each is known.

    They are [V, 3] and [V]. A gain that is not known is 1.
    """
    values = observations.stops - points[observations.points]
    usable = np.isfinite(values).all(axis=1)
    views = observations.views[usable]
    known = np.bincount(views, minlength=num_views) >= FEWEST_POINTS
    stops = _medians(values[usable], views, num_views)
    return np.where(known[:, None], stops, 0.0), known


def _chosen(observations: Observations, chosen: NDArray[np.bool_]) -> Observations:
    """Return some of the observations, bool [K]."""
    return Observations(observations.views[chosen], observations.points[chosen], observations.stops[chosen])


def _thinned(observations: Observations) -> Observations:
    """Return at most `MOST_OBSERVATIONS`, all of every n-th point."""
    every = math.ceil(len(observations.views) / MOST_OBSERVATIONS)
    if every <= 1:
        return observations
    return _chosen(observations, observations.points % every == 0)


def _shared(observations: Observations, num_points: int) -> Observations:
    """Return the observations of points that two photos or more see; only these tell photos from each other."""
    counts = np.bincount(observations.points, minlength=num_points)
    return _chosen(observations, counts[observations.points] >= 2)


def _distances(observations: Observations, stops: Floats, num_points: int) -> Floats:
    """Distances of observations' mean channels from their point's median, in stops, given gains [V, 3]. [K]"""
    values = observations.stops - stops[observations.views]
    means = values.mean(axis=1, keepdims=True)
    middles = _medians(means, observations.points, num_points)
    return np.abs(means - middles[observations.points])[:, 0]


def _medians(values: Floats, segments: Ints, number: int) -> Floats:
    """Return the median of each column of values [K, D] in each of so many segments; NaN if it is empty. [number, D]"""
    counts = np.bincount(segments, minlength=number)
    starts = np.cumsum(counts) - counts
    lower = starts + np.maximum(counts - 1, 0) // 2
    upper = starts + counts // 2
    filled = counts > 0
    medians = np.full((number, values.shape[1]), np.nan)
    for column, channel in enumerate(values.T):
        # Sorting one key takes half the time of sorting by two.
        order = np.argsort(_KEY_STEP * segments + channel.clip(-_LARGEST, _LARGEST))
        sorted_values = channel[order]
        medians[filled, column] = 0.5 * (sorted_values[lower[filled]] + sorted_values[upper[filled]])
    return medians
