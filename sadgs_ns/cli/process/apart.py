"""COLMAP runs in a process of its own.

COLMAP aborts the whole process where it meets an error in one of its threads, such as a full disk or a failed
download, and does not listen to signals while it works. In a process of its own it can be ended at any time, and its
end becomes an error like others. pycolmap's library also replaces the zlib that Pillow brings: Pillow crashes when it
writes a PNG and was loaded after pycolmap.
"""

from __future__ import annotations

import multiprocessing
import os
import pkgutil
import re
import shutil
import signal
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from sadgs_ns.errors import InputError, RunError, free_space

Report = Callable[[str, int, int], None]
"""Called with a stage's name, how much of it is done, and how much there is to do."""
_FULL_DISK = re.compile("no space left|disk is full|disk I/O error|file too large|failed to write", re.IGNORECASE)
_FULL_BELOW = 8 * 2**20
"""Free bytes under which a disk counts as full."""
_LOG_PREFIX = re.compile(r"^([IWEF]\d{8} .*?\] |\s*what\(\):\s*)?(\[[\w.]+:\d+\] )?(Check failed: (\S+\(\) )?)?")
_ERROR_LINE = re.compile(r"^[EF]\d{8} |^\s*what\(\): |Error: ")


def run_apart(function: str, *arguments: Any, folder: Path, report: Report) -> Any:
    """Call a function in another process, which is ended when this function is left by an exception.

    Args:
        function: A function as `module:name`, whose module only that process imports. Its last argument is a `Report`.
        arguments: Its other arguments.
        folder: Where the function writes; errors name it.
        report: Called in this process.

    Returns:
        What the function returns.

    Raises:
        InputError: If the function raises it.
        OSError: If the disk is full.
        RunError: If the function raises anything else, or if its process ends.
    """
    context = multiprocessing.get_context("spawn")  # a fork would copy the locks of threads that it does not copy
    receiving, sending = context.Pipe(duplex=False)
    log, written = context.Pipe(duplex=False)
    process = context.Process(target=_serve, args=(sending, written, function, arguments), daemon=True)
    stage, lines = "its start", b""
    sources: list[Any] = [receiving, log]
    try:
        # The terminal sends its signals to both processes. They are blocked in the child, which inherits this mask.
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM, signal.SIGHUP})
        try:
            process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        sending.close()
        written.close()
        while sources:
            for ready in wait(sources):
                if ready is log:
                    text = os.read(log.fileno(), 65536)
                    lines = (lines + text)[-65536:]
                    if not text:
                        sources.remove(log)
                    continue
                try:
                    kind, content = receiving.recv()
                except EOFError:
                    sources.remove(receiving)
                    continue
                if kind == "progress":
                    stage = content[0]
                    report(*content)
                elif kind == "result":
                    return content
                else:
                    raise content
        process.join()
    finally:
        if process.pid is not None:
            process.kill()
            process.join()
        receiving.close()
        log.close()
    raise _error_of(process.exitcode, lines.decode(errors="replace"), stage, folder)


def _error_of(exitcode: int | None, log: str, stage: str, folder: Path) -> Exception:
    """Return the error that says why a process ended before its work was done."""
    told = [_LOG_PREFIX.sub("", line).strip() for line in log.splitlines() if _ERROR_LINE.search(line)]
    existing = next((path for path in (folder, *folder.absolute().parents) if path.exists()), Path("/"))
    if _FULL_DISK.search(log) or shutil.disk_usage(existing).free < _FULL_BELOW:
        return OSError(
            f"{folder} could not be written while COLMAP worked on {stage} ({free_space(folder)} free there): "
            "make room, and the same command goes on."
        )
    if exitcode == -signal.SIGKILL:
        return RunError(
            f"COLMAP was killed while it worked on {stage}, most likely for want of memory: close other programs, or "
            "give it smaller photos; the same command goes on."
        )
    why = f"({told[-1]})" if told else f"(exit code {exitcode})"
    return RunError(f"COLMAP failed while it worked on {stage} {why}; the same command tries it again.")


def _serve(sending: Connection, written: Connection, function: str, arguments: tuple) -> None:
    """Call the function and send what it reports and returns; this runs in the other process."""
    os.dup2(written.fileno(), 2)
    threading.Thread(target=_end_with_parent, daemon=True).start()

    def report(*step: Any) -> None:
        sending.send(("progress", step))

    try:
        sending.send(("result", pkgutil.resolve_name(function)(*arguments, report)))
    except InputError as error:
        sending.send(("error", error))


def _end_with_parent() -> None:
    """End this process, whatever it is doing, when its parent is gone."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    wait([parent.sentinel])
    os._exit(1)
