"""Python programs that tests run in processes of their own.

Importing nerfstudio takes ten seconds, so processes are forked from a server that has imported it and done nothing
else. The server is started for the first of them, once for each process of pytest.

The server and the processes see no GPU: our presets ask torch for one when they are imported, and CUDA does not work
in forks of a process that has asked.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from unittest import mock

IMPORTED = ["sadgs_ns.training.presets", "sadgs_ns.training.model"]
"""What nerfstudio imports for this package's methods."""
NS_TRAIN = "import sys; from nerfstudio.scripts.train import entrypoint; sys.argv[:] = {}; entrypoint()"
"""The program `ns-train`, to be completed with its name and arguments."""

HANGS = 600.0
"""Seconds after which a test takes for hanging what it waits for; on a busy machine a start takes minutes."""
_NO_GPU = {"CUDA_VISIBLE_DEVICES": ""}
_SERVER = multiprocessing.get_context("forkserver")
_SERVER.set_forkserver_preload([*IMPORTED, "nerfstudio.scripts.train"])  # Tests and `ns-train` take 3 s to import that.


def python(code: str, environment: Mapping[str, str] = os.environ, timeout: float = HANGS) -> Any:
    """Run a program as `python -W ignore -c` does.

    Args:
        code: The program.
        environment: Its environment, but for the GPUs. What libraries read when they are imported has the server's
            values.
        timeout: Seconds after which it is killed.

    Returns:
        As `subprocess.run` does, with the standard output and error as text.

    Raises:
        TimeoutExpired: As `subprocess.run`.
    """
    with tempfile.TemporaryDirectory() as folder:
        files = Path(folder, "output"), Path(folder, "errors")
        for file in files:
            file.touch()
        process = start(into_files, files, code, dict(environment))
        process.join(timeout)
        if process.is_alive():
            process.kill()
            raise subprocess.TimeoutExpired(code, timeout)
        return subprocess.CompletedProcess(code, process.exitcode, *(file.read_text("utf8") for file in files))


def start(function: Callable[..., None], *arguments: Any) -> Any:
    """Start a process that calls a function of a module.

    Returns:
        A `multiprocessing.Process`.
    """
    process = _SERVER.Process(target=function, args=arguments)
    with mock.patch.dict(os.environ, _NO_GPU):  # If this is the first process, it starts the server.
        process.start()
    return process


def in_terminal(terminal: str, code: str, environment: Mapping[str, str]) -> None:
    """Run a program with a terminal that controls it, so that it is sent SIGHUP when that is gone; for `start`.

    Args:
        terminal: The terminal's device.
        code: The program.
        environment: Its environment, but for the GPUs.
    """
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # Where the tests run under nohup, it is ignored, and would be here.
    os.setsid()
    descriptor = os.open(terminal, os.O_RDWR)  # It becomes the controlling one, since the process has none.
    for standard in (0, 1, 2):
        os.dup2(descriptor, standard)
    os.close(descriptor)
    _execute(code, environment)


def into_files(files: tuple[Path, Path], code: str, environment: Mapping[str, str]) -> None:
    """Run a program whose standard output and error are written to two files; for `start`."""
    for standard, file in zip((1, 2), files, strict=True):
        with file.open("wb") as opened:
            os.dup2(opened.fileno(), standard)
    _execute(code, environment)


def _execute(code: str, environment: Mapping[str, str]) -> None:
    """Run a program as the main one: an error ends it through `sys.excepthook`."""
    os.environ.clear()
    os.environ.update({**environment, **_NO_GPU})
    try:
        exec(compile(code, "<string>", "exec"), {"__name__": "__main__"})
    except Exception:
        sys.excepthook(*sys.exc_info())  # type: ignore[arg-type]
        sys.exit(1)
