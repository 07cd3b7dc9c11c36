"""Functions of all commands: a command line that tyro reads, and an exit code."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TypeVar

import tyro

from sadgs_ns.errors import InputError, RunError, free_space, reason
from sadgs_ns.interrupts import Interrupted

Options = TypeVar("Options")


def parse(options: type[Options], name: str, argv: Sequence[str] | None) -> Options:
    """Read what follows a command, by default that of the process, or print help, version or an error and exit.

    `options` is a dataclass; its docstring and those of its fields are the help. The exit code is 2 after an error.
    """
    if argv is None:
        argv = sys.argv[1:]
    words = list(argv)
    if "--version" in words:
        print(f"{name} {version('sadgs_ns')}")
        raise SystemExit(0)
    description = f"{' '.join((options.__doc__ or '').split())} --version prints the version."
    return tyro.cli(options, prog=name, description=description, args=words, config=(tyro.conf.FlagCreatePairsOff,))


def exit_code(name: str, folder: Path | None, run: Callable[[], int]) -> int:
    """Run a command that can be resumed, print the sentence of an error, and return the exit code.

    It is `run`'s; 1 if it failed or could not write; 2 for wrong input; 130, 143 or 129 for SIGINT, SIGTERM or SIGHUP.
    """
    try:
        return run()
    except InputError as error:
        sentence = str(error)
        code = 2
    except RunError as error:
        sentence = str(error)
        code = 1
    except OSError as error:
        sentence = _explain(error, folder or Path())
        code = 1
    except KeyboardInterrupt as stop:
        sentence = "stopped; run the same command again to resume."
        number = signal.SIGINT
        if isinstance(stop, Interrupted):
            number = stop.number
        code = 128 + number
    print(f"{name}: {sentence}", file=sys.stderr)
    return code


def _explain(error: OSError, folder: Path) -> str:
    """Return a sentence on an error of the operating system, or our own if the error was raised with one."""
    if error.errno is None:
        return str(error)
    where = error.filename or folder
    return f"{where}: {reason(error)} ({free_space(folder)} free there); run the same command again to resume."
