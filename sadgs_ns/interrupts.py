"""Let SIGINT, SIGTERM and SIGHUP stop a run between two steps, and let it print elsewhere once its output is gone."""

from __future__ import annotations

import os
import signal
import stat
import sys
import threading
from collections.abc import Callable
from typing import Any

from rich.console import Console

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Signals that ask a run to stop. The last one comes when a terminal is gone, for instance because ssh was cut off."""


class Interrupted(KeyboardInterrupt):
    """A signal asked the run to stop; it stands between two steps."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.number = number


class Interrupts:
    """A context in which the first of `SIGNALS` makes `poll` raise, and a second SIGINT or SIGTERM acts as usual.

    Signals that the program handles or ignores are left alone. While `waiting` returns True, nobody polls, and signals
    raise at once. A process that `started` this one sends SIGTERM when it is interrupted, so then a second is ignored.
    """

    def __init__(self, waiting: Callable[[], bool], started: bool = False) -> None:
        self._waiting = waiting
        self._repeated = {signal.SIGHUP, signal.SIGTERM} if started else {signal.SIGHUP}
        self._previous: dict[int, Any] = {}
        self.received: int | None = None  # the first signal that has come

    def __enter__(self) -> Interrupts:
        self.received = None
        if threading.current_thread() is threading.main_thread():
            default = (signal.SIG_DFL, signal.default_int_handler)
            handlers = {number: signal.getsignal(number) for number in SIGNALS}
            self._previous = {number: old for number, old in handlers.items() if old in default}
            for number in self._previous:
                signal.signal(number, self._handle)
        return self

    def __exit__(self, *_: object) -> None:
        for number, previous in self._previous.items():
            signal.signal(number, previous)
        self._previous = {}

    def poll(self) -> None:
        """Raise Interrupted if a signal has come."""
        if self.received is not None:
            raise Interrupted(self.received)

    def _handle(self, number: int, frame: object) -> None:
        if self.received is not None:
            return  # When a connection drops, the shell sends one SIGHUP and the kernel another.
        self.received = number
        for another in self._previous.keys() - self._repeated:
            signal.signal(another, self._previous[another])
        if number == signal.SIGHUP:
            discard_broken_output()
        if self._waiting():
            self.poll()


def discard_broken_output() -> None:
    """Discard output to a terminal or pipe that is gone: printing there would raise before the run is saved."""
    for descriptor in (1, 2):
        if not os.isatty(descriptor) and not stat.S_ISREG(os.fstat(descriptor).st_mode):
            _discard(descriptor)


def redirect_on_broken_pipe(console: Console) -> None:
    """Once nobody reads standard output any more, have its console print to standard error, or else nowhere.

    `head` ends when it has read enough, and `tee` by the same Ctrl-C as the program before it. rich would then end the
    program, wherever it is, with exit code 1 and without a word.
    """

    def print_elsewhere() -> None:
        descriptor = console.file.fileno()
        errors_are_elsewhere = sys.stderr is not None and not os.path.sameopenfile(descriptor, 2)
        _discard(descriptor)
        console.file.flush()  # The file has kept what could not be written, and so has rich.
        if errors_are_elsewhere:
            os.dup2(2, descriptor)
        with console:  # On leaving, rich prints what it has kept, and calls this function again if that fails.
            pass

    console.on_broken_pipe = print_elsewhere


def _discard(descriptor: int) -> None:
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, descriptor)
    os.close(nowhere)
