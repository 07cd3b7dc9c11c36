"""The length of a run, the views of a step and the windows of densification, as they follow from the capture."""

from __future__ import annotations

import pytest

from sadgs_ns.method.schedule import (
    DENSIFICATION_SHARE,
    MOST_VIEWS,
    Schedule,
    Windows,
    between_one_and_four,
    dropout,
    growth_threshold,
    schedule,
    windows,
)


@pytest.mark.parametrize(
    ("num_views", "expected"),
    [
        (17, Schedule(2850, 1)),  # 2,850 visits
        (48, Schedule(2200, 2)),  # 4,400
        (109, Schedule(2484, 3)),  # 7,450, which are not a multiple of 3
        (525, Schedule(7063, 4)),  # 28,250
    ],
)
def test_visits_grow_with_the_views_and_steps_take_more_views_where_they_can(num_views: int, expected: Schedule):
    assert schedule(num_views) == expected


@pytest.mark.parametrize("num_views", [1, 2, 3, 20, 100, 1000, 10_000])
@pytest.mark.parametrize("effort", [0.01, 0.5, 1.0, 2.0, 4.0])
def test_every_schedule_renders_what_the_effort_asks_for(num_views: int, effort: float):
    derived = schedule(num_views, effort=effort)
    factor = effort
    if effort > 1 and num_views <= 20:
        factor = effort**0.5
    visits = factor * (2000 + 50 * num_views)
    assert 1 <= derived.views_per_iteration <= min(MOST_VIEWS, num_views)
    rendered = derived.iterations * derived.views_per_iteration
    assert visits <= rendered < visits + derived.views_per_iteration
    assert derived.iterations >= min(2000, visits) or num_views < derived.views_per_iteration


@pytest.mark.parametrize(
    ("num_views", "factors"),
    [(20, [0.5, 2**0.5, 2]), (50, [0.5, 2**0.5, 2]), (70, [0.5, 2**0.75, 4**0.75]), (90, [0.5, 2, 4])],
)
def test_effort_above_1_adds_fewer_visits_where_views_are_few(num_views: int, factors: list[float]):
    visits = []
    for effort in (1.0, 0.5, 2.0, 4.0):
        derived = schedule(num_views, effort=effort)
        visits.append(derived.iterations * derived.views_per_iteration)
    actual = [more / visits[0] for more in visits[1:]]
    expected = pytest.approx(factors, rel=2e-3)
    assert actual == expected


def test_effort_lets_more_grow_where_views_are_many_and_a_draft_as_much():
    actual = [growth_threshold(effort, 100) for effort in (0.1, 0.5, 1.0)]
    assert actual == [1.0, 1.0, 1.0]
    actual = [growth_threshold(effort, 100) for effort in (2, 4, 8)]
    expected = pytest.approx([0.801, 0.642, 0.514], abs=1e-3)
    assert actual == expected
    actual = [growth_threshold(4, views) for views in (3, 20, 40, 60)]
    expected = pytest.approx([1, 1, 0.801, 0.642], abs=1e-3)
    assert actual == expected


@pytest.mark.parametrize(
    ("num_views", "rates"),
    [(8, [0.082, 0.182, 0.232, 0.25]), (26, [0, 0.058, 0.108, 0.158]), (127, [0, 0, 0.020, 0.051])],
)
def test_gaussians_are_left_out_where_each_view_is_rendered_often(num_views: int, rates: list[float]):
    derived = [dropout(schedule(num_views, effort=effort), num_views) for effort in (0.5, 1, 2, 4)]
    assert derived == pytest.approx(rates, abs=1e-3)
    assert derived == sorted(derived)


def test_a_run_of_a_few_iterations_leaves_nothing_out():
    actual = dropout(Schedule(5, 1), 100)
    assert actual == 0


def test_what_is_set_by_hand_stays():
    assert schedule(100, iterations=123) == Schedule(123, 3)
    assert schedule(100, views_per_iteration=2) == Schedule(3500, 2)
    assert schedule(100, iterations=123, views_per_iteration=7, effort=4) == Schedule(123, 7)
    assert schedule(3, iterations=123, views_per_iteration=7) == Schedule(123, 3), "no view twice in a step"


def test_windows_are_the_released_codes_at_3000_iterations_and_in_proportion_elsewhere():
    assert windows(3000) == Windows(500, 100, 100, 1600, 1200, 10)
    for iterations in (60, 599, 600, 712, 2000, 7063, 30_000):
        derived = windows(iterations)
        part = derived.absgs_every
        assert part == pytest.approx(iterations / 30, abs=0.5)
        multiples = (derived.structure_every, derived.refine_start_iter, derived.refine_stop_iter)
        assert multiples == (5 * part, part, 16 * part)
        assert derived.reset_every == (12 * part if iterations >= 600 else 0)
        assert derived.eta_every == max(round(0.1 * part), 1)
        assert derived.refine_stop_iter == pytest.approx(DENSIFICATION_SHARE * iterations, rel=0.1)


@pytest.mark.parametrize("iterations", [1, 2, 5, 20, 29, 31])
def test_windows_of_the_shortest_runs_lie_within_them(iterations: int):
    derived = windows(iterations)
    assert derived.refine_stop_iter <= iterations * 19 // 30
    assert min(derived.structure_every, derived.absgs_every, derived.refine_start_iter, derived.eta_every) >= 1


def test_windows_that_are_given_stay_but_for_an_end_too_late_to_recover_from():
    given = {"structure_every": 0, "absgs_every": 7, "refine_start_iter": 3, "reset_every": 0, "eta_every": 1}
    actual = windows(300, refine_stop_iter=50, **given)
    expected = Windows(0, 7, 3, 50, 0, 1)
    assert actual == expected
    assert windows(300, refine_stop_iter=300).refine_stop_iter == 190
    assert windows(300, refine_start_iter=200).refine_stop_iter == 0
    assert windows(300, refine_stop_iter=0).refine_stop_iter == 0


def test_factors_on_rates_go_from_one_view_to_four_and_no_further():
    actual = [between_one_and_four(views, 9.0) for views in (1, 2, 4, 8)]
    expected = pytest.approx([1.0, 3.0, 9.0, 9.0])
    assert actual == expected
    actual = [between_one_and_four(views, 0.25) for views in (1, 2, 4)]
    expected = pytest.approx([1.0, 0.5, 0.25])
    assert actual == expected
