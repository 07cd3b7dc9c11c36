"""The capacities of tile lists that are foreseen: never a guess about what is not known, and a margin on what is."""

from __future__ import annotations

import random
import subprocess
import sys
from collections.abc import Sequence

import pytest

from sadgs_ns.render.tile_forecast import MARGIN, MOST_PAIRS, RECENT, TileForecast

SIZE = (640, 480)


class Counts:
    """Numbers that arrive when they are told to."""

    def __init__(self, *counts: int, arrived: bool = True) -> None:
        self.counts = list(counts)
        self.arrived = arrived

    def ready(self) -> bool:
        return self.arrived

    def wait(self) -> list[int]:
        self.arrived = True
        return self.counts


def render(
    forecast: TileForecast, views: Sequence[int], counts: Sequence[int], gaussians: int = 100
) -> tuple[int | None, list[int]]:
    """One step: its capacity, and the views that it must repeat."""
    capacity = forecast.capacity(views, SIZE, gaussians)
    forecast.rendered(views, SIZE, capacity, Counts(*counts))
    return capacity, forecast.overflowed()


def test_a_view_is_foreseen_from_its_second_visit_on_with_a_margin():
    forecast = TileForecast()
    actual = render(forecast, [3], [1_000_000])
    assert actual == (None, [])
    capacity, lost = render(forecast, [3], [1_000_000])
    assert capacity is not None
    assert not lost
    assert MARGIN * 1_000_000 < capacity <= MARGIN * 1_000_000 * 17 / 16 + 1


@pytest.mark.parametrize("coarse", [False, True])
def test_capacities_suffice_and_are_few(coarse: bool):
    capacities = []
    for pairs in range(100_000, 3_000_000, 10_007):
        forecast = TileForecast()
        forecast.round_to_powers = coarse
        render(forecast, [0], [pairs])
        capacity = forecast.capacity([0], SIZE, 100)
        assert capacity is not None
        assert MARGIN * pairs < capacity <= MARGIN * pairs * (3 / 2 if coarse else 17 / 16) + 1
        capacities.append(capacity)
    assert capacities == sorted(capacities)
    assert len(set(capacities)) == (11 if coarse else 72)


def test_views_that_are_rendered_together_add_up_and_one_unknown_makes_all_wait():
    forecast = TileForecast()
    render(forecast, [0, 1], [1_000_000, 3_000_000])
    assert forecast.capacity([0, 2], SIZE, 100) is None
    both = forecast.capacity([1, 0], SIZE, 100)
    one = forecast.capacity([1], SIZE, 100)
    assert both is not None
    assert one is not None
    assert both == pytest.approx(MARGIN * 4_000_000, rel=1 / 15)
    assert one == pytest.approx(MARGIN * 3_000_000, rel=1 / 15)


def test_a_view_in_another_size_is_another_view():
    forecast = TileForecast()
    render(forecast, [0], [1_000_000])
    assert forecast.capacity([0], (320, 240), 100) is None


def test_the_largest_growth_of_the_latest_visits_is_expected_of_the_others_and_a_loss_is_not():
    forecast = TileForecast()
    for view in range(12):
        render(forecast, [view], [1_000_000])
    render(forecast, [0], [1_200_000])
    render(forecast, [1], [500_000])
    capacity = forecast.capacity([2], SIZE, 100)
    assert capacity == pytest.approx(MARGIN * 1_200_000, rel=1 / 15)
    for view in range(2, 2 + RECENT):
        render(forecast, [view], [900_000])
    actual = forecast.capacity([11], SIZE, 100)
    expected = pytest.approx(MARGIN * 1_000_000, rel=1 / 15)
    assert actual == expected


def test_after_a_densification_it_waits_until_a_view_has_shown_what_changed():
    forecast = TileForecast()
    for view in range(3):
        render(forecast, [view], [1_000_000])
    assert render(forecast, [0], [1_500_000], gaussians=200)[0] is None
    actual = render(forecast, [1], [1_500_000], gaussians=200)[0]
    expected = pytest.approx(MARGIN * 1_500_000, rel=1 / 15)
    assert actual == expected


def test_a_change_tells_nothing_of_a_view_that_was_seen_before_an_earlier_densification():
    forecast = TileForecast()
    render(forecast, [0], [1_000_000])
    render(forecast, [1], [1_000_000], gaussians=200)
    render(forecast, [1], [2_000_000], gaussians=300)  # It does not know what 200 Gaussians changed.
    assert forecast.capacity([0], SIZE, 300) is None
    assert forecast.capacity([1], SIZE, 300) is not None


def test_an_overflow_names_the_views_once_and_the_next_attempt_fits():
    forecast = TileForecast()
    render(forecast, [4, 5], [1_000_000, 1_000_000])
    actual = render(forecast, [4, 5], [3_000_000, 1_000_000])[1]
    assert actual == [4, 5]
    assert render(forecast, [5, 4], [1_000_000, 3_000_000])[1] == []
    assert forecast.overflowed() == []


def test_what_has_not_arrived_is_not_waited_for_unless_asked():
    forecast = TileForecast()
    render(forecast, [0], [1_000_000])
    capacity = forecast.capacity([0], SIZE, 100)
    late = Counts(2_000_000, arrived=False)
    forecast.rendered([0], SIZE, capacity, late)
    forecast.rendered([1], SIZE, None, Counts(1_000_000))
    assert forecast.overflowed() == [], "in the order of the calls"
    assert forecast.capacity([1], SIZE, 100) is None, "in the order of the calls"
    assert forecast.overflowed(wait=True) == [0]
    assert forecast.capacity([0, 1], SIZE, 100) is not None


def test_what_arrives_after_a_densification_counts_as_seen_before_it():
    forecast = TileForecast()
    render(forecast, [0], [1_000_000])
    capacity = forecast.capacity([0], SIZE, 100)
    late = Counts(1_000_000, arrived=False)
    forecast.rendered([0], SIZE, capacity, late)
    assert forecast.capacity([0], SIZE, 200) is None
    forecast.overflowed(wait=True)
    assert forecast.capacity([0], SIZE, 200) is None


def test_a_view_that_was_nearly_empty_does_not_swell_the_others():
    forecast = TileForecast()
    render(forecast, [0, 1], [2, 1_000_000])
    render(forecast, [0], [200])
    actual = forecast.capacity([1], SIZE, 100)
    expected = pytest.approx(MARGIN * 1_200_000, rel=1 / 10)
    assert actual == expected
    assert forecast.capacity([0], SIZE, 100) == 4096


def test_very_long_lists_are_not_foreseen():
    forecast = TileForecast()
    render(forecast, [0], [MOST_PAIRS])
    assert forecast.capacity([0], SIZE, 100) is None


def test_few_different_capacities_occur():
    forecast = TileForecast()
    capacities = set()
    draw = random.Random(0)
    for _ in range(1000):
        capacities.add(render(forecast, [0], [draw.randint(900_000, 1_100_000)])[0])
    assert len(capacities) < 20


def test_it_is_made_of_python_alone():
    code = "import sys, sadgs_ns.render.tile_forecast; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0
