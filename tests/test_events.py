"""The trace, to which all processes of a command add their events and spans."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

from sadgs_ns import events
from sadgs_ns.worker import Worker


@pytest.fixture
def trace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    path = tmp_path / "trace"
    path.touch()
    monkeypatch.setenv(events.TRACE, str(path))
    return path


def lines_of(trace: Path) -> list[dict]:
    return [json.loads(line) for line in trace.read_text().splitlines()]


def test_a_span_has_its_begin_and_end_also_where_it_fails(trace: Path):
    with pytest.raises(ValueError, match="no"), events.span("outer"):
        with events.span("inner", function="f"):
            events.report("halfway", share=0.5)
        raise ValueError("no")
    halfway, inner, outer = lines_of(trace)
    assert halfway["event"] == "halfway"
    assert halfway["share"] == 0.5
    assert inner["event"] == "span"
    assert inner["name"] == "inner"
    assert inner["function"] == "f"
    assert outer["begin"] <= inner["begin"] <= halfway["time"] <= inner["time"] <= outer["time"]
    actual = {line["process"] for line in (halfway, inner, outer)}
    assert actual == {os.getpid()}


def test_the_events_of_other_processes_are_in_the_same_trace(trace: Path, tmp_path: Path, monkeypatch):
    code = "from sadgs_ns.events import report\ndef function():\n    report('inside')\n"
    (tmp_path / "program.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    heard = []
    with Worker("program:function", tmp_path / "log.txt") as worker:
        worker.run(on_event=lambda event, **fields: heard.append(event))
    imports, inside = lines_of(trace)[:2]
    assert heard == ["inside"]
    assert imports["name"] == "imports"
    assert imports["function"] == "program:function"
    assert inside["event"] == "inside"
    assert inside["process"] == imports["process"] != os.getpid()


def test_without_a_trace_nothing_is_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv(events.TRACE, str(tmp_path / "none"))
    with events.span("part"):
        events.report("event")
    assert not list(tmp_path.iterdir())
