"""Gains of photos whose exposures differ, from the colours that their common points have in them.

A point has about one colour in all photos that see it. So the logarithm of its light in a photo is the photo's gain
plus the point's own colour, but for gloss, shade and wrong observations. Gains and colours are fitted together by least
squares in which observations that are far off count less (*reweighted* least squares). Medians of points and of photos
in turn withstand wrong observations, too, but they come to rest before gains that change slowly along a walk are found.

Light is in stops: a stop is a factor of 2.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix, diags
from scipy.sparse.linalg import splu

FEWEST_POINTS = 20
"""Points that a photo must share with others; one with fewer has no gain of its own."""
MOST_OBSERVATIONS = 400_000
"""More observations are thinned out evenly, because the time grows with them: between half of this and all are kept.
With a quarter of it known gains of fox, castle, mouse and south are found with up to twice the error."""
OBSERVATIONS_OF_A_PHOTO = 200
"""For each photo on average so many may be kept even if that is more, as it is from 2,000 photos on."""
NOISE = 0.2
"""Stops by which a good observation may be off. One that is farther off counts less the farther it is (Cauchy's
loss). On the mean of thirteen captures half as much finds known gains as well, and twice as much a fifth worse."""
FINEST = 0.02
"""Stops from which on the first loss is the distance; below, it is the square."""
STEPS = 60
"""Most steps of each loss. Captures take 5 to 40."""
SETTLED = 0.001
"""Stops by which no gain changes any more."""

# Weight that pulls gains to 1, as a share of a photo's own. Otherwise all gains of a group that has no point in common
# with the others could move together, and the equations would have no single solution.
_PULL = 1e-9
_LARGEST = 31.0  # Stops; no colour is so far from another.
_KEY_STEP = 64.0  # Between the keys of segments, more than twice as much

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Observations:
    """K colours of points in photos. No point is observed twice in one photo."""

    views: Ints  # Indices of photos. [K]
    points: Ints  # Indices of points. [K]
    stops: Floats  # log₂ of linear light of each channel, finite. [K, 3]

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
    """Find the gains of photos and the points' colours. Nothing is random.

    Groups of photos that have no point in common have gains that are right among themselves alone.
    """
    observations = _thinned(observations, num_views)
    shared, counts = _of_known_photos(observations, num_views, num_points)
    known = counts > 0
    if not known.any():
        no_gains = np.zeros((num_views, 3))
        return Exposures(no_gains, known, np.full((num_points, 3), np.nan), 0.0, 0.0, 0.0, 0.0)
    stops = _fitted_gains(shared, num_views)
    before = _distances(shared, np.zeros_like(stops), num_points)
    after = _distances(shared, stops, num_points)
    means = stops[known].mean(axis=1)
    # About the error of a gain if errors are normal; 1.48 times their median size is a deviation.
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
    return _centres(values, observations.points, num_points)


def mean_gains(views: Ints, points: Ints, stops: Floats, num_points: int) -> Floats:
    """Return the mean of log₂ of the gains of the photos that show each point; 0 if none does. [P, 3]

    Args:
        views: Photos of K pairs of a photo and a point that it shows. [K]
        points: Points of these pairs. [K]
        stops: log₂ of the gains of all photos. [V, 3]
        num_points: P.
    """
    counts = np.bincount(points, minlength=num_points)
    return _sums(points, stops[views], num_points) / np.maximum(counts, 1)[:, None]


def gains_of_others(observations: Observations, points: Floats, num_views: int) -> tuple[Floats, NDArray[np.bool_]]:
    """Return log₂ of the gains of photos that had no part in the points' colours [P, 3], and whether each is known.

    They are [V, 3] and [V]. A gain that is not known is 1.
    """
    values = observations.stops - points[observations.points]
    usable = np.isfinite(values).all(axis=1)
    views = observations.views[usable]
    known = np.bincount(views, minlength=num_views) >= FEWEST_POINTS
    stops = _centres(values[usable], views, num_views)
    return np.where(known[:, None], stops, 0.0), known


def _chosen(observations: Observations, chosen: NDArray[np.bool_]) -> Observations:
    """Return some of the observations, bool [K]."""
    return Observations(observations.views[chosen], observations.points[chosen], observations.stops[chosen])


def _thinned(observations: Observations, num_views: int) -> Observations:
    """Return all observations of every n-th point, about as many as the constants say."""
    most = max(MOST_OBSERVATIONS, OBSERVATIONS_OF_A_PHOTO * num_views)
    every = math.ceil(len(observations.views) / most)
    if every <= 1:
        return observations
    _, ranks = np.unique(observations.points, return_inverse=True)  # Points may be every n-th already.
    return _chosen(observations, ranks % every == 0)


def _of_known_photos(observations: Observations, num_views: int, num_points: int) -> tuple[Observations, Ints]:
    """Return the observations that tell photos from each other, and how many each photo has. [V]

    A photo has none unless it shares `FEWEST_POINTS` with other photos that have any.
    """
    while True:
        observations = _shared(observations, num_points)
        counts = np.bincount(observations.views, minlength=num_views)
        known = counts >= FEWEST_POINTS
        if (known == (counts > 0)).all():
            return observations, counts
        observations = observations.of_views(known)


def _shared(observations: Observations, num_points: int) -> Observations:
    """Return the observations of points that two photos or more see; only these tell photos from each other."""
    counts = np.bincount(observations.points, minlength=num_points)
    return _chosen(observations, counts[observations.points] >= 2)


def _fitted_gains(observations: Observations, num_views: int) -> Floats:
    """Fit gains to observations, which have at least one photo; log₂ of the gains, 0 for photos without any. [V, 3]

    Each channel's median over the photos with observations is 0.
    The sum of distances has one minimum, so it comes first. From there, Cauchy's loss leaves out what is far off.
    """
    equations = _Equations.of(observations)
    gains = np.zeros((equations.shape[0], 3))
    distances = np.ones(len(observations.views))  # All weigh the same in the first step.
    for weigh in (_weights_of_distance, _weights_of_cauchy):
        for _ in range(STEPS):
            moved, distances = equations.fitted(weigh(distances))
            change = np.abs(moved - gains).max()
            gains = moved
            if change < SETTLED:
                break
    stops = np.zeros((num_views, 3))
    stops[equations.photos] = gains
    return stops


def _weights_of_distance(distances: Floats) -> Floats:
    """Return weights with which squares of distances become distances. [K]"""
    return 1 / np.maximum(distances, FINEST)


def _weights_of_cauchy(distances: Floats) -> Floats:
    """Return weights with which squares of distances become Cauchy's loss. [K]"""
    return 1 / (np.square(distances) + NOISE**2)


@dataclass(frozen=True)
class _Equations:
    """One for each of K observations: light = gain of the photo + colour of the point, of n photos and m points."""

    photos: Ints  # Indices of the photos. [n]
    rows: Ints  # The photo of each observation, as a row of `photos`. [K]
    columns: Ints  # The point of each observation. [K]
    light: Floats  # log₂ of linear light. [K, 3]
    shape: tuple[int, int]  # n, m

    @staticmethod
    def of(observations: Observations) -> _Equations:
        photos, rows = np.unique(observations.views, return_inverse=True)
        points, columns = np.unique(observations.points, return_inverse=True)
        return _Equations(photos, rows, columns, observations.stops, (len(photos), len(points)))

    def fitted(self, weights: Floats) -> tuple[Floats, Floats]:
        """Return the gains of weighted least squares, with medians of 0, and the root mean square distances from it.

        Given gains, each point's colour is a weighted mean. With these in the place of the colours, the normal
        equations have photos alone. The weights [K] are > 0. Returns [n, 3] and [K].
        """
        photos, points = self.shape
        by_pair = csr_matrix((weights, (self.rows, self.columns)), shape=self.shape)
        of_points = np.bincount(self.columns, weights, points)
        of_photos = np.bincount(self.rows, weights, photos)
        means = _sums(self.columns, weights[:, None] * self.light, points) / of_points[:, None]
        differences = self.light - means[self.columns]
        right_side = _sums(self.rows, weights[:, None] * differences, photos)
        through_points = by_pair @ diags(1 / of_points) @ by_pair.T
        matrix = diags((1 + _PULL) * of_photos) - through_points
        gains = splu(matrix.tocsc()).solve(right_side)
        gains -= np.median(gains, axis=0)
        shift = _sums(self.columns, weights[:, None] * gains[self.rows], points) / of_points[:, None]
        residuals = differences - gains[self.rows] + shift[self.columns]
        distances = np.sqrt(np.square(residuals).mean(axis=1))
        return gains, distances


def _sums(segments: Ints, values: Floats, number: int) -> Floats:
    """Return the sum of each column of values [K, D] in each of so many segments. [number, D]"""
    columns = []
    for channel in values.T:
        columns.append(np.bincount(segments, channel, number))
    return np.stack(columns, axis=1)


def _centres(values: Floats, segments: Ints, number: int) -> Floats:
    """Return where Cauchy's loss of the values [K, D] in each of so many segments is least, next to their median.

    Empty segments have NaN. [number, D]
    """
    centres = _medians(values, segments, number)
    for _ in range(STEPS):
        distances = np.sqrt(np.square(values - centres[segments]).mean(axis=1))
        weights = _weights_of_cauchy(distances)
        of_segments = np.bincount(segments, weights, number)
        filled = of_segments > 0
        moved = np.full_like(centres, np.nan)
        moved[filled] = _sums(segments, weights[:, None] * values, number)[filled] / of_segments[filled][:, None]
        change = np.abs(moved - centres)[filled].max(initial=0.0)
        centres = moved
        if change < SETTLED:
            break
    return centres


def _distances(observations: Observations, stops: Floats, num_points: int) -> Floats:
    """Distances of observations' mean channels from their point's median, in stops, given gains [V, 3]. [K]"""
    values = observations.stops - stops[observations.views]
    means = values.mean(axis=1, keepdims=True)
    centres = _medians(means, observations.points, num_points)
    return np.abs(means - centres[observations.points])[:, 0]


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
