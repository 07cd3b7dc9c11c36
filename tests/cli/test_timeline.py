"""Where the time of `sadgs` goes, by a clock that the tests turn."""

from __future__ import annotations

import pytest

from sadgs_ns.cli import status_line
from sadgs_ns.cli.status_line import Timeline


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time, which stands still; its one element may be changed."""
    now = [1000.0]
    monkeypatch.setattr(status_line.time, "monotonic", lambda: now[0])
    return now


def test_each_part_lasts_until_the_next_begins(clock: list[float]):
    spent = Timeline()
    spent.begin("cameras", "checks")
    for seconds, event, fields in (
        (0.25, "progress", {"stage": "features"}),
        (3.0, "progress", {"stage": "features"}),
        (4.0, "progress", {"stage": "matches"}),
        (60.0, "added", {"photos": "3"}),
    ):
        clock[0] += seconds
        spent.follow(event, **fields)
    clock[0] += 1.0
    spent.begin("start", "imports")
    for seconds, event in ((0.5, "imported"), (1.5, "training begins"), (2.0, "loop begins"), (9.0, "loop ends")):
        clock[0] += seconds
        spent.follow(event)
    clock[0] += 1.0
    spent.begin("export", "ply")
    clock[0] += 2.0
    assert str(spent) == "cameras 1:08, start 0:04, training 0:10, export 0:02"
    expected = [
        "cameras     0.2 s  checks",
        "cameras     7.0 s  features",
        "cameras    61.0 s  matches",
        "start       0.5 s  imports",
        "start       1.5 s  data and model",
        "start       2.0 s  kernels",
        "training    9.0 s  iterations",
        "training    1.0 s  saving",
        "export      2.0 s  ply",
    ]
    assert spent.table().splitlines() == expected


def test_nothing_is_told_of_a_command_that_began_nothing():
    assert str(Timeline()) == ""
    assert Timeline().table() == ""
