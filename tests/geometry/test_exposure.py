"""Gains of photos are found from drawn colours of points, whose gains are known."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from sadgs_ns.geometry import exposure
from sadgs_ns.geometry.exposure import (
    FEWEST_POINTS,
    Observations,
    _Equations,
    fit_exposures,
    gains_of_others,
    points_at_median,
)

VIEWS = 12
POINTS = 800
TRACK = 5


def drawn(
    spread: float = 0.3, noise: float = 0.05, views: int = VIEWS, seed: int = 0
) -> tuple[Observations, np.ndarray, np.ndarray]:
    """Observations of points by five photos each, the gains [V, 3], whose median is 0, and the colours [P, 3]."""
    generator = np.random.default_rng(seed)
    gains = spread * generator.normal(size=(views, 1)) + 0.2 * spread * generator.normal(size=(views, 3))
    gains -= np.median(gains, axis=0)
    colors = generator.uniform(-5, -1, (POINTS, 3))
    seen = np.stack([generator.permutation(views)[:TRACK] for _ in range(POINTS)])
    points = np.repeat(np.arange(POINTS), TRACK)
    stops = gains[seen.ravel()] + colors[points] + noise * generator.normal(size=(POINTS * TRACK, 3))
    return Observations(seen.ravel(), points, stops), gains, colors


def test_known_gains_and_colours_are_found_and_the_median_gain_is_1():
    observations, gains, colors = drawn()
    found = fit_exposures(observations, VIEWS, POINTS)
    assert found.known.all()
    assert_allclose(found.stops, gains, atol=0.03)
    actual = np.median(found.stops, axis=0)
    assert_allclose(actual, 0, atol=1e-12)
    assert np.abs(found.points - colors).mean() < 0.05
    means = gains.mean(axis=1)
    assert found.deviation == pytest.approx(means.std(), abs=0.02)
    assert found.spread == pytest.approx(np.ptp(means), abs=0.04)
    assert found.residual_after < 0.4 * found.residual_before


@pytest.mark.hard_case("a fifth of all observations of exposure is wrong", "the gains stay within .05 stops")
def test_gains_withstand_a_fifth_of_wrong_observations():
    observations, gains, _ = drawn()
    generator = np.random.default_rng(1)
    wrong = generator.random(len(observations.views)) < 0.2
    observations.stops[wrong] += generator.uniform(-3, 3, (int(wrong.sum()), 3))
    actual = fit_exposures(observations, VIEWS, POINTS).stops
    assert_allclose(actual, gains, atol=0.05)


@pytest.mark.hard_case("a quarter of all observations shows gloss", "all gains are at most .03 stops off")
def test_gains_withstand_gloss_that_only_brightens():
    observations, gains, _ = drawn()
    generator = np.random.default_rng(4)
    glossy = generator.random(len(observations.views)) < 0.25
    observations.stops[glossy] += generator.uniform(1, 3, (int(glossy.sum()), 1))
    held_out = np.arange(VIEWS) >= 9
    found = fit_exposures(observations.of_views(~held_out), VIEWS, POINTS)
    others, known = gains_of_others(observations.of_views(held_out), found.points, VIEWS)
    assert known[held_out].all()
    stops = np.where(held_out[:, None], others, found.stops)
    difference = stops - gains
    assert_allclose(difference - np.median(difference[~held_out], axis=0), 0, atol=0.03)


@pytest.mark.hard_case("a photo that shares few points with others", "has a gain of 1, and moves no other gain")
def test_a_photo_with_few_points_has_a_gain_of_1_and_does_not_move_the_others():
    observations, gains, _ = drawn()
    fewest = FEWEST_POINTS - 1
    few = np.flatnonzero(observations.views == 3)[:fewest]
    kept = observations.views != 3
    kept[few] = True
    observations.stops[few] += 5
    found = fit_exposures(
        Observations(observations.views[kept], observations.points[kept], observations.stops[kept]), VIEWS, POINTS
    )
    others = np.arange(VIEWS) != 3
    assert found.known.tolist() == others.tolist()
    assert not found.stops[3].any()
    expected = gains[others] - np.median(gains[others], axis=0)
    actual = found.stops[others]
    assert_allclose(actual, expected, atol=0.05)


@pytest.mark.hard_case(
    "exposure changes slowly along a walk, where photos share points with their neighbours alone",
    "the gains stay within .05 stops",
)
def test_gains_that_change_slowly_along_a_walk_are_found():
    views = 60
    points_of_each = 150
    generator = np.random.default_rng(2)
    gains = 0.4 * np.sin(2 * np.pi * np.arange(views) / views)
    first = np.repeat(np.arange(views - 2), points_of_each)  # Each point is seen by three photos in a row.
    seen = np.stack([first, first + 1, first + 2], axis=1)
    points = np.repeat(np.arange(len(first)), 3)
    colors = generator.uniform(-5, -1, (len(first), 3))
    stops = gains[seen.ravel()][:, None] + colors[points] + 0.05 * generator.normal(size=(len(points), 3))
    found = fit_exposures(Observations(seen.ravel(), points, stops), views, len(first))
    expected = np.repeat(gains[:, None], 3, axis=1)
    assert_allclose(found.stops - np.median(found.stops - expected, axis=0), expected, atol=0.05)


@pytest.mark.hard_case("two groups of photos have no point in common", "each group's gains are right among themselves")
def test_groups_without_common_points_have_gains_of_their_own():
    observations, gains, _ = drawn()
    second = observations.views >= VIEWS // 2
    points = np.where(second, observations.points + POINTS, observations.points)
    found = fit_exposures(Observations(observations.views, points, observations.stops), VIEWS, 2 * POINTS)
    assert found.known.all()
    for group in (slice(0, VIEWS // 2), slice(VIEWS // 2, VIEWS)):
        difference = found.stops[group] - gains[group]
        assert_allclose(difference - difference.mean(axis=0), 0, atol=0.04)


def test_a_step_is_the_least_squares_of_gains_and_colours_together():
    observations, _, _ = drawn(noise=0.3)
    equations = _Equations.of(observations)
    count = len(observations.views)
    weights = np.random.default_rng(3).uniform(0.1, 2, count)
    actual, distances = equations.fitted(weights)
    # The obvious way: one unknown for each gain and each colour.
    matrix = np.zeros((count, VIEWS + POINTS))
    matrix[np.arange(count), observations.views] = 1
    matrix[np.arange(count), VIEWS + observations.points] = 1
    roots = np.sqrt(weights)[:, None]
    solution = np.linalg.lstsq(roots * matrix, roots * observations.stops, rcond=None)[0]
    expected = solution[:VIEWS] - np.median(solution[:VIEWS], axis=0)
    assert_allclose(actual, expected, atol=1e-5)
    residuals = observations.stops - matrix @ solution
    assert_allclose(distances, np.sqrt(np.square(residuals).mean(axis=1)), atol=1e-5)


def test_photos_with_one_exposure_have_no_spread_beyond_noise():
    observations, _, _ = drawn(spread=0.0)
    found = fit_exposures(observations, VIEWS, POINTS)
    assert found.deviation < 0.01
    assert found.spread < 0.03
    assert found.residual_after > 0.97 * found.residual_before


@pytest.mark.parametrize("count", [0, 1])
def test_without_common_points_all_gains_are_1(count: int):
    views = np.arange(3 * count)
    found = fit_exposures(Observations(views, np.zeros_like(views), np.zeros((len(views), 3))), 3, 1)
    assert not found.known.any()
    assert not found.stops.any()
    assert found.deviation == found.spread == 0
    assert np.isnan(found.points).all()


def test_photos_that_were_not_fitted_get_gains_by_the_points_colours():
    observations, gains, _ = drawn()
    fitted = np.arange(VIEWS) < 9
    stops = np.where(fitted[:, None], gains, 0.0)
    light = points_at_median(observations.of_views(fitted), stops, POINTS)
    found, known = gains_of_others(observations.of_views(~fitted), light, VIEWS)
    assert known.tolist() == (~fitted).tolist()
    expected = np.where(fitted[:, None], 0.0, gains)
    assert_allclose(found, expected, atol=0.03)


@pytest.mark.hard_case("a photo whose points are seen only by photos that share too few", "has a gain of 1 as well")
def test_a_photo_that_depends_on_photos_without_gains_has_none_either():
    observations, _, _ = drawn()
    # Photo 12 sees 30 new points, which photos 13 and 14 see, too, half each: too few for these.
    new = POINTS + np.arange(30)
    views = np.concatenate([observations.views, np.full(30, 12), np.repeat([13, 14], 15)])
    points = np.concatenate([observations.points, new, new])
    stops = np.concatenate([observations.stops, np.full((60, 3), -2.0)])
    found = fit_exposures(Observations(views, points, stops), 15, POINTS + 30)
    assert found.known.tolist() == 12 * [True] + 3 * [False]
    assert not found.stops[12:].any()


@pytest.mark.parametrize("stride", [1, 4])
def test_many_observations_are_thinned_out_by_points(stride: int, monkeypatch: pytest.MonkeyPatch):
    observations, gains, _ = drawn()
    observations = Observations(observations.views, stride * observations.points, observations.stops)
    monkeypatch.setattr(exposure, "MOST_OBSERVATIONS", len(observations.views) / 3)
    monkeypatch.setattr(exposure, "OBSERVATIONS_OF_A_PHOTO", 1)
    found = fit_exposures(observations, VIEWS, stride * POINTS)
    known = np.isfinite(found.points).all(axis=1)
    assert known.sum() == pytest.approx(POINTS / 3, abs=1)
    assert_allclose(found.stops, gains, atol=0.05)
