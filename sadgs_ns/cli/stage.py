"""A stage of a longer command: a process of its own with its own log, and one line that says how far it is."""

from __future__ import annotations

import contextlib
import ctypes
import itertools
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType

from rich.console import Console
from rich.live import Live
from rich.text import Text

from sadgs_ns.errors import RunError
from sadgs_ns.plugin.interrupts import Interrupted, Interrupts

_POLL_SECONDS = 0.2
"""Time between two looks at what a process printed."""
_PREFIX = re.compile(r"^(error|sadgs-[\w-]+): ")
"""What commands put before the sentence with which they end."""
_SET_DEATH_SIGNAL = 1
"""Linux's PR_SET_PDEATHSIG."""
_PRCTL = ctypes.CDLL(None).prctl if sys.platform == "linux" else None


class Line:
    """The line of a stage: its name, the time it takes, and how far it is.

    A terminal shows it as it changes; elsewhere, as in a file, it is printed once, when the context ends.

    Args:
        name: The stage.
        console: Where it is printed.
    """

    def __init__(self, name: str, console: Console) -> None:
        self._name, self._console, self._told = name, console, ""
        self._live = Live(console=console, auto_refresh=False) if console.is_terminal else None

    def __enter__(self) -> Line:
        self._start = time.monotonic()
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if self._live is not None:
            self.refresh()
            self._live.stop()
        else:
            self._console.print(self._text(), soft_wrap=True)

    def tell(self, told: str) -> None:
        """Say how far the stage is."""
        self._told = told
        self.refresh()

    def say(self, sentence: str) -> None:
        """Print a sentence above the line."""
        self._console.print(Text(sentence), soft_wrap=True)

    def refresh(self) -> None:
        """Show the time that has passed."""
        if self._live is not None:
            self._live.update(self._text(), refresh=True)

    def _text(self) -> Text:
        passed = clock(time.monotonic() - self._start)
        return Text(f"{self._name:<9}{passed:>8}  {self._told}".rstrip(), no_wrap=True, overflow="ellipsis")


def clock(seconds: float) -> str:
    """Return a time as "1:02" or "1:00:02"."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02}:{rest:02}" if minutes >= 60 else f"{minutes}:{rest:02}"


@contextlib.contextmanager
def prepared(module: str, log: Path, inherited: int) -> Iterator[subprocess.Popen[bytes]]:
    """Start a process that imports a module, for a `run_stage` that comes later.

    Where it has got no command line until the context ends, it is ended.

    Args:
        module: What will be run as by `python -m`.
        log: All that it prints is added to this file.
        inherited: A file descriptor that the process keeps open.

    Raises:
        OSError: If the log cannot be written.
    """
    process = _start(["sadgs_ns.cli.ready", module], log, inherited, subprocess.PIPE)
    try:
        yield process
    finally:
        assert process.stdin is not None
        if not process.stdin.closed:
            process.terminate()
            process.stdin.close()
        process.wait()


def _start(words: Sequence[str], log: Path, inherited: int, stdin: int) -> subprocess.Popen[bytes]:
    """Start Python with a module and its arguments, which prints to a log, in a process group of its own."""
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("ab") as written:
        return subprocess.Popen(
            [sys.executable, "-m", *words],
            stdin=stdin,
            stdout=written,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            pass_fds=[inherited],
            env=os.environ | {"PYTHONUNBUFFERED": "1"},
            preexec_fn=_end_with_parent,
        )


def run_stage(
    module: str,
    arguments: Sequence[str],
    log: Path,
    line: Line,
    hear: Callable[[str], None],
    interrupts: Interrupts,
    inherited: int,
    process: subprocess.Popen[bytes] | None = None,
) -> tuple[int, str]:
    """Run a module's command line in a process of its own, and wait for its end.

    It has a group of its own, so that a terminal's Ctrl-C reaches it once, from here. On Linux it is stopped when this
    process is killed.

    Args:
        module: It is run as by `python -m`.
        arguments: The command line.
        log: All that it prints is added to this file, after the command.
        line: The stage's line.
        hear: Called with every line that it prints.
        interrupts: Where they say that a signal came, it is passed on, and the process may end as it likes.
        inherited: A file descriptor that the process keeps open.
        process: What `prepared` has started for this module and log; None starts another.

    Returns:
        Its exit code, and the sentence with which it ended.

    Raises:
        Interrupted: If a signal came.
        OSError: If the log cannot be written.
        RunError: If somebody killed the process.
    """
    command = [sys.executable, "-m", module, *arguments]
    log.parent.mkdir(parents=True, exist_ok=True)
    lines: list[str] = []
    with log.open("ab") as written, log.open(encoding="utf8", errors="replace") as read:
        written.write(f"$ {shlex.join(command)}\n".encode())
        written.flush()
        read.seek(0, os.SEEK_END)

        def listen() -> None:
            while printed := read.readline():
                if unfinished and not unfinished[-1].endswith("\n"):
                    printed = unfinished.pop() + printed
                if printed.endswith("\n"):
                    lines.append(printed.rstrip())
                    hear(lines[-1])
                else:
                    unfinished.append(printed)
            line.refresh()

        unfinished: list[str] = []
        if process is None or process.poll() is not None:  # One whose import failed fails again, and is heard.
            process = _start(command[2:], log, inherited, subprocess.DEVNULL)
        else:
            assert process.stdin is not None
            with suppress(BrokenPipeError), process.stdin:
                process.stdin.write(json.dumps(list(arguments)).encode() + b"\n")
        try:
            while process.poll() is None:
                interrupts.poll()
                listen()
                time.sleep(_POLL_SECONDS)
            listen()
        except BaseException as error:
            _stop(process, error, line)
            raise
    if process.returncode < 0:
        name = signal.Signals(-process.returncode).name
        why = ", most likely for want of memory" if name == "SIGKILL" else ""
        raise RunError(
            f"{module} was ended by {name}{why}; all that it printed is in {log}, and the same command goes on."
        )
    return process.returncode, _last_sentence(lines)


def _stop(process: subprocess.Popen[bytes], error: BaseException, line: Line) -> None:
    """Pass an interruption on and wait until the process has saved what it did; a second Ctrl-C kills it."""
    with suppress(ProcessLookupError):
        os.killpg(process.pid, error.number if isinstance(error, Interrupted) else signal.SIGTERM)
    try:
        with suppress(OSError):  # The terminal may be gone.
            line.tell("stopping")
        process.wait()
    except KeyboardInterrupt:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def _end_with_parent() -> None:
    """Have this process stopped when its parent is gone; the new process calls this before its program."""
    if _PRCTL is not None:
        _PRCTL(_SET_DEATH_SIGNAL, signal.SIGTERM)


def _last_sentence(lines: Sequence[str]) -> str:
    """Return what a command said last; of a box, as around a wrong option, its first paragraph."""
    if lines and lines[-1].startswith("╰"):
        boxed = [line.strip("│ ") for line in lines if line.startswith("│ ")]
        paragraph = itertools.takewhile(lambda text: not text.startswith("──"), boxed)
        return " ".join(text for text in paragraph if text).rstrip(".")
    last = next((line.strip() for line in reversed(lines) if re.search(r"\w", line)), "it printed nothing")
    return _PREFIX.sub("", last).rstrip(".")
