"""Run a function in another process, receive its events, and raise here what it raised there.

A library that crashes, runs out of memory or ignores signals, such as COLMAP, then ends only that process.
"""

from __future__ import annotations

import atexit
import itertools
import json
import os
import pickle
import pkgutil
import re
import shlex
import signal
import subprocess
import sys
import threading
import traceback as tracebacks
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from sadgs_ns import events
from sadgs_ns.errors import InputError, RunError, sentence_of
from sadgs_ns.interrupts import Interrupted

OnEvent = Callable[..., None]  # Called with an event's name and, by keyword, its fields
_POLL_SECONDS = 0.1
_KEPT_BYTES = 65536  # Size of the end of a failed process's output that is searched for the reason
_PROMPT = "$ "  # Stands before a command in a log
_PREFIX = re.compile(r"^(error|sadgs-[\w-]+): ")  # Commands put this before the sentence of an error


class WorkerError(RunError):
    """A function raised something else than an InputError, or its process ended; the sentence has no full stop.

    A negative `exitcode` is the signal that ended the process. `output` is the end of what it printed.
    """

    def __init__(self, sentence: str, exitcode: int, output: str) -> None:
        super().__init__(sentence)
        self.exitcode = exitcode
        self.output = output


class Worker:
    """A process that imports a function at once, and calls it when `run` brings the arguments.

    It has a session of its own, so that a terminal's Ctrl-C reaches it once, from here. It gets a SIGTERM if this
    process ends, and is killed when the context is left. Raise OSError if the log cannot be written.

    Args:
        function: As `module:name`.
        log: All that the process prints is added to this file.
        keep_open: File descriptors that it inherits, such as a lock's.
        saves: Whether it may save its work when it is interrupted. Otherwise it is killed.
    """

    def __init__(self, function: str, log: Path, keep_open: Sequence[int] = (), saves: bool = False) -> None:
        self.log = log
        self._events = log.with_suffix(".events")
        self._saves = saves
        log.parent.mkdir(parents=True, exist_ok=True)
        self._events.open("wb").close()
        code = f"import sys; sys.path[:] = {sys.path!r}; from {__name__} import main; main()"
        with log.open("ab") as output:
            self._start = output.tell()
            self._process = subprocess.Popen(
                [sys.executable, "-c", code, function],
                stdin=subprocess.PIPE,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                pass_fds=keep_open,
                env=os.environ | {"PYTHONUNBUFFERED": "1", events.FILE: str(self._events.absolute())},
            )

    def __enter__(self) -> Worker:
        return self

    def __exit__(self, *error: object) -> None:
        self._end(signal.SIGKILL)
        self._events.unlink(missing_ok=True)

    def run(self, *arguments: Any, on_event: OnEvent, command: Sequence[str] = ()) -> Any:
        """Call the function, and return its result as JSON holds it: a dataclass as a dictionary.

        Raise an InputError of the function, or WorkerError if it raises anything else or its process ends.

        Args:
            arguments: The function's; they are pickled.
            on_event: Called here with each event, and with "stopping" when the process is interrupted.
            command: The command line that does the same, for the log and the function's `sys.argv`.
        """
        assert self._process.stdin is not None
        if command:
            with self.log.open("ab") as log:
                log.write(f"{_PROMPT}{shlex.join(command)}\n".encode())
        try:
            with suppress(BrokenPipeError):  # Its import may have failed.
                self._process.stdin.write(pickle.dumps((list(command), arguments)))
                self._process.stdin.flush()
            return self._listen(on_event)
        except BaseException as error:
            if self._process.poll() is None and self._saves:
                with suppress(OSError):  # The terminal may be gone.
                    on_event("stopping")
                if isinstance(error, Interrupted):
                    self._end(error.number)
                else:
                    self._end(signal.SIGTERM)
            raise

    def _listen(self, on_event: OnEvent) -> Any:
        """Pass events on to `on_event` until the result comes, and return it; raise if the process ends without one."""
        error: dict[str, Any] | None = None
        rest = b""
        with self._events.open("rb") as file:
            while self._process.returncode is None:
                with suppress(subprocess.TimeoutExpired):
                    self._process.wait(_POLL_SECONDS)
                *lines, rest = (rest + file.read()).split(b"\n")
                for line in lines:
                    fields = json.loads(line)
                    event = fields.pop("event")
                    if event == "result":
                        if self._saves:  # Its threads may be writing.
                            self._process.wait()
                        return fields["value"]
                    if event == "error":
                        error = fields
                    else:
                        on_event(event, **fields)
        raise self._failure(error)

    def _failure(self, error: dict[str, Any] | None) -> InputError | WorkerError:
        """Return the exception for the end of the process without a result; `error` has the fields of its event."""
        if error is not None and error["is_input"]:
            return InputError(error["sentence"])
        with self.log.open("rb") as file:
            file.seek(max(self._start, self.log.stat().st_size - _KEPT_BYTES))
            output = file.read().decode(errors="replace")
        exitcode = self._process.returncode
        if exitcode < 0:
            name = signal.Signals(-exitcode).name
            sentence = f"it was ended by {name}"
            if name == "SIGKILL":
                sentence += ", most likely for want of memory"
        elif error is not None and error["sentence"]:
            sentence = error["sentence"]
        else:
            sentence = _last_sentence(output.splitlines())
        return WorkerError(sentence.rstrip("."), exitcode, output)

    def _end(self, number: int) -> None:
        """Send a signal and wait until the process has ended; Ctrl-C meanwhile kills it."""
        with suppress(ProcessLookupError):
            if self._process.poll() is None:
                os.killpg(self._process.pid, number)
        try:
            self._process.wait()
        except KeyboardInterrupt:
            os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
        finally:
            assert self._process.stdin is not None
            with suppress(BrokenPipeError):
                self._process.stdin.close()


def _last_sentence(lines: Sequence[str]) -> str:
    """Return the last sentence that a command printed; of a box, as around a wrong option, the first paragraph."""
    if lines and lines[-1].startswith("╰"):
        boxed = [line.strip("│ ") for line in lines if line.startswith("│ ")]
        paragraph = itertools.takewhile(lambda text: not text.startswith("──"), boxed)
        return " ".join(text for text in paragraph if text)
    for line in reversed(lines):
        if re.search(r"\w", line) and not line.startswith(_PROMPT):
            return _PREFIX.sub("", line.strip())
    return "it printed nothing"


def main() -> None:
    """Import the function that the command line names, and call it when its arguments come; runs in the worker."""
    returned = False

    def leave() -> None:
        """Exit without tearing down all modules, which takes torch most of a second."""
        if returned:
            sys.stdout.flush()
            os._exit(0)

    atexit.register(leave)  # As the first, it is called last, when no thread runs any more.
    # The arguments come by standard input, of which the function itself sees nothing.
    channel = os.dup(0)
    empty_input = os.open(os.devnull, os.O_RDONLY)
    os.dup2(empty_input, 0)
    try:
        with events.span("imports", function=sys.argv[1]):
            function = pkgutil.resolve_name(sys.argv[1])
        with os.fdopen(channel, "rb", closefd=False) as sent:
            try:
                command, arguments = pickle.load(sent)
            except EOFError:  # The parent does not call `run` any more.
                return
        if command:
            sys.argv = command
        threading.Thread(target=_end_with_parent, args=(channel,), daemon=True).start()
        result = function(*arguments)
        events.report("result", value=result)
        returned = True
    except KeyboardInterrupt:
        raise SystemExit(128 + signal.SIGINT) from None
    except Exception as error:
        sentence = sentence_of(error)
        if sentence is None:
            tracebacks.print_exc()
            sentence = tracebacks.format_exception_only(error)[-1].strip()
        else:
            print(f"error: {sentence}", file=sys.stderr)
        events.report("error", sentence=sentence, is_input=isinstance(error, InputError))
        raise SystemExit(1) from None


def _end_with_parent(channel: int) -> None:
    """Interrupt this process when its parent, which holds the other end of the channel, has ended."""
    os.read(channel, 1)
    os.kill(os.getpid(), signal.SIGTERM)
