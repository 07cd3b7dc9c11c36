"""Where a program prints once its terminal is gone, or nobody reads its output any more, so that it can go on."""

from __future__ import annotations

import os
import stat
import sys

from rich.console import Console


def discard_broken_output() -> None:
    """Discard output to a terminal or pipe that is gone, since printing there would raise before the run is saved."""
    for descriptor in (1, 2):
        if not os.isatty(descriptor) and not stat.S_ISREG(os.fstat(descriptor).st_mode):
            _discard(descriptor)


def redirect_on_broken_pipe(console: Console) -> None:
    """Have standard output's console print where errors go, or else nowhere, as soon as what read its output has ended.

    `head` ends when it has read enough, and `tee` ends by the same Ctrl-C as the program whose output it copies. rich
    would end the program then, wherever it is, with exit code 1 and without a word.
    """

    def print_elsewhere() -> None:
        descriptor = console.file.fileno()
        errors_are_elsewhere = sys.stderr is not None and not os.path.sameopenfile(descriptor, 2)
        _discard(descriptor)
        console.file.flush()  # rich has kept what could not be written, and so has the file.
        if errors_are_elsewhere:
            os.dup2(2, descriptor)
        with console:  # Its end prints what rich has kept, and calls this function again if that fails.
            pass

    console.on_broken_pipe = print_elsewhere


def _discard(descriptor: int) -> None:
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, descriptor)
    os.close(nowhere)
