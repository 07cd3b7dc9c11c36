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
    words = list(sys.argv[1:] if argv is None else argv)
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
        told, code = str(error), 2
    except (OSError, RunError) as error:
        told, code = str(error), 1
        if isinstance(error, OSError) and error.errno is not None:
            where, free = error.filename or folder or Path(), free_space(folder or Path())
            told = f"{where}: {reason(error)} ({free} free there); run the same command again to resume."
    except KeyboardInterrupt as stopped:
        told = "stopped; run the same command again to resume."
        code = 128 + (stopped.number if isinstance(stopped, Interrupted) else signal.SIGINT)
    print(f"{name}: {told}", file=sys.stderr)
    return code
