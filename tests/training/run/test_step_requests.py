"""What processes ask of each other in a step, as one whole number that they join by a bitwise or."""

from __future__ import annotations

import signal

import pytest

from sadgs_ns.interrupts import SIGNALS
from sadgs_ns.training.run.step_requests import StepRequests


@pytest.mark.parametrize("save", [False, True])
@pytest.mark.parametrize("signals", [(), (signal.SIGTERM,), SIGNALS])
def test_requests_are_the_same_after_their_way_as_a_number(save: bool, signals: tuple[int, ...]):
    requests = StepRequests(save, signals)
    assert StepRequests.decode(requests.encode()) == requests


def test_the_numbers_of_several_processes_hold_what_any_of_them_asks_for():
    asked = [StepRequests(), StepRequests(save=True), StepRequests(signals=(signal.SIGHUP,))]
    flags = 0
    for requests in (*asked, StepRequests(signals=(signal.SIGINT,))):
        flags |= requests.encode()
    expected = StepRequests(save=True, signals=(signal.SIGINT, signal.SIGHUP))
    assert StepRequests.decode(flags) == expected


def test_a_process_that_asks_for_nothing_sends_zero():
    assert StepRequests().encode() == 0
    assert StepRequests.decode(0) == StepRequests()
