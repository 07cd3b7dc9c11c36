"""The line of a stage, in a terminal and in a file."""

from __future__ import annotations

import io
import re
from collections.abc import Callable

import pytest
from rich.console import Console

from sadgs_ns.cli.status_line import StatusLine, clock


def printed_with(name: str, is_terminal: bool, act: Callable[[StatusLine], object]) -> str:
    """What a line prints meanwhile, without codes of the terminal."""
    printed = io.StringIO()
    console = Console(file=printed, force_terminal=is_terminal, highlight=False, width=80)
    with StatusLine(name, console) as line:
        act(line)
    return re.sub(r"\x1b\[[?\d;]*[a-zA-Z]", "", printed.getvalue())


@pytest.mark.parametrize("is_terminal", [True, False])
def test_the_last_status_stays_below_what_was_printed(is_terminal: bool):
    def act(line: StatusLine) -> None:
        line.update("features 1 of 9")
        line.print("There is no GPU.")
        line.update("done")

    text = printed_with("cameras", is_terminal, act)
    assert re.search(r"There is no GPU\.\r?\n(.*[\r\n])*cameras +\d:\d\d  done *\n$", text)
    assert is_terminal or text == "There is no GPU.\ncameras      0:00  done\n"


@pytest.mark.parametrize("is_terminal", [True, False])
def test_a_stage_of_several_parts_leaves_a_line_of_each(is_terminal: bool):
    def act(line: StatusLine) -> None:
        line.finish("splat.ply")
        line.update("splat.html")

    text = printed_with("export", is_terminal, act)
    lines = [line.rstrip() for line in re.split(r"[\r\n]+", text)]
    assert lines.index("export       0:00  splat.ply") < lines.index("export       0:00  splat.html")


def test_hours_are_shown_from_one_hour_on():
    actual = [clock(seconds) for seconds in (0.4, 61.6, 3599.6)]
    assert actual == ["0:00", "1:02", "1:00:00"]
