"""A function in another process: what is heard of it, how its end is told, and that it does not outlive its parent."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from helpers.forked_python import HANGS
from helpers.refusals import refusal
from sadgs_ns.interrupts import Interrupted, Interrupts
from sadgs_ns.worker import Worker, WorkerError


@pytest.fixture
def program(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Path]:
    """Writes a module whose `function` a worker calls, and returns the log."""
    monkeypatch.syspath_prepend(tmp_path)

    def write(code: str) -> Path:
        (tmp_path / "program.py").write_text(code)
        return tmp_path / "log.txt"

    return write


def run(log: Path, *arguments: Any, on_event: Callable[..., None] = print, saves: bool = False, command=()) -> Any:
    with Worker("program:function", log, saves=saves) as worker:
        return worker.run(*arguments, on_event=on_event, command=command)


def test_events_with_fields_are_heard_in_their_order_before_the_result(program):
    log = program(
        "import dataclasses\n"
        "from sadgs_ns.events import progress, report\n"
        "@dataclasses.dataclass\n"
        "class Sum: total: int\n"
        "def function(start, *numbers):\n"
        "    report('begins', start=start)\n"
        "    for i in range(3): progress('adding', i, 3)\n"
        "    return Sum(sum(numbers, start))\n"
    )
    heard = []
    result = run(log, 4, 1, 2, on_event=lambda event, **fields: heard.append((event, fields)))
    assert result == {"total": 7}
    steps = [("progress", {"stage": "adding", "done": i, "total": 3}) for i in range(3)]
    assert heard == [("begins", {"start": 4}), *steps]
    names = [path.name for path in log.parent.glob("log*")]
    assert names == ["log.txt"]


def test_without_a_listener_events_go_nowhere(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    from sadgs_ns import events

    monkeypatch.setenv(events.FILE, str(tmp_path / "gone"))
    events.report("anything", number=1)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        ("print('one'); print('error: It is [so].'); raise SystemExit(4)", (4, "It is [so]")),
        ("import sys; print('sadgs-x: no photos.', file=sys.stderr); print(); sys.exit(2)", (2, "no photos")),
        ("raise SystemExit(3)", (3, "it printed nothing")),
        ("raise KeyError('a')", (1, "KeyError: 'a'")),
        ("raise EOFError('the file is empty')", (1, "EOFError: the file is empty")),
        ("from sadgs_ns.errors import RunError; raise RunError('It failed.')", (1, "It failed")),
        (
            "print('╭─ Wrong ─╮\\n│ Wrong: --a │\\n│ or -b. │\\n│ ── │\\n│ Help │\\n╰────╯'); raise SystemExit(2)",
            (2, "Wrong: --a or -b"),
        ),
    ],
)
def test_a_failure_has_its_code_and_its_last_sentence(program, body: str, expected: tuple[int, str]):
    log = program(f"def function(): {body}")
    with pytest.raises(WorkerError) as failed:
        run(log, command=["some-program", "a b"])
    assert (failed.value.exitcode, str(failed.value)) == expected
    assert log.read_text("utf8").startswith("$ some-program 'a b'\n")


def test_wrong_input_is_an_error_of_the_same_kind(program):
    log = program("from sadgs_ns.errors import InputError\ndef function(): raise InputError('No photos.')")
    with refusal(r"^No photos\.$"):
        run(log)
    assert log.read_text("utf8") == "error: No photos.\n"


def test_a_worker_has_imported_before_its_arguments_come(program, tmp_path: Path):
    log = program("import heavy, sys\ndef function(*words): print('ran with', *words, *sys.argv)")
    (tmp_path / "heavy.py").write_text("print('imported')")
    with Worker("program:function", log) as worker:
        while "imported" not in log.read_text("utf8"):
            time.sleep(0.05)
        assert worker.run("a b", on_event=print, command=["x", "y z"]) is None
    assert log.read_text("utf8") == "imported\n$ x 'y z'\nran with a b x y z\n"
    with Worker("program:function", log):
        pass
    actual = log.read_text("utf8").count("ran with")
    assert actual == 1


def test_a_worker_ends_when_its_threads_and_what_is_due_at_its_exit_are_done(program):
    log = program(
        "import atexit, threading, time\n"
        "def write(): time.sleep(0.5); print('written', end=' ')\n"
        "def function():\n"
        "    atexit.register(print, 'exit')\n"
        "    threading.Thread(target=write).start()\n"
        "    return 3\n"
    )
    with Worker("program:function", log, saves=True) as worker:
        status = worker.run(on_event=print)
        assert status == 3
        assert log.read_text("utf8") == "written exit\n"


def test_a_worker_whose_import_failed_tells_why(program):
    log = program("raise SystemExit('error: Without numpy nothing works.')")
    with pytest.raises(WorkerError, match=r"^Without numpy nothing works$"):
        run(log, command=["program"])


@pytest.mark.hard_case("a signal to `sadgs`", "is passed on once, and the stage may save")
def test_a_signal_is_passed_on_once_and_the_function_may_save(program):
    log = program(
        "import signal, sys, time\n"
        "from sadgs_ns.events import report\n"
        "def save(*signal): time.sleep(0.5); print('saved'); sys.exit(143)\n"
        "def function():\n"
        "    signal.signal(signal.SIGTERM, save)\n"
        "    report('ready')\n"
        "    time.sleep(60)\n"
    )
    heard = []

    def hear(event: str) -> None:
        heard.append(event)
        if event == "ready":
            os.kill(os.getpid(), signal.SIGTERM)

    with pytest.raises(Interrupted, match="SIGTERM"), Interrupts(waiting=lambda: True):
        run(log, on_event=hear, saves=True)
    assert heard == ["ready", "stopping"]
    assert log.read_text("utf8") == "saved\n"


@pytest.mark.hard_case("the training of `sadgs` is killed", "one sentence; the same command resumes")
def test_a_function_that_is_killed_is_told_of(program):
    log = program("import os, signal\ndef function(): os.kill(os.getpid(), signal.SIGKILL)")
    with pytest.raises(WorkerError, match=r"^it was ended by SIGKILL, most likely for want of memory$") as failed:
        run(log)
    assert failed.value.exitcode == -signal.SIGKILL


@pytest.mark.hard_case("`sadgs` is killed", "the stage is stopped as by SIGTERM")
@pytest.mark.skipif(sys.platform != "linux", reason="needs /proc")
def test_a_function_does_not_outlive_the_command_that_is_killed(program, tmp_path: Path):
    log = program("import os, time\ndef function(): print(f'pid {os.getpid()}'); time.sleep(60)")
    parent = (
        f"import pathlib, sys; sys.path.insert(0, {str(tmp_path)!r})\n"
        "from sadgs_ns.worker import Worker\n"
        f"Worker('program:function', pathlib.Path({str(log)!r}), saves=True).run(on_event=print)"
    )
    command = subprocess.Popen([sys.executable, "-c", parent])
    found = None
    while found is None:
        assert command.poll() is None
        time.sleep(0.05)
        if log.exists():
            found = re.search(r"^pid (\d+)$", log.read_text("utf8"), re.MULTILINE)
    command.kill()
    command.wait()
    end = time.monotonic() + HANGS
    while Path(f"/proc/{found[1]}/stat").exists() and " Z " not in Path(f"/proc/{found[1]}/stat").read_text():
        assert time.monotonic() < end
        time.sleep(0.05)
