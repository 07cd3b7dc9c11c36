"""Runs COLMAP in a process of its own.

COLMAP aborts the whole process at an error in one of its threads, such as a full disk or a failed download, and ignores
signals while it works. pycolmap also replaces Pillow's zlib: Pillow crashes writing a PNG if it is loaded later.
"""

from __future__ import annotations

import contextlib
import re
import shutil
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from sadgs_ns.errors import RunError, free_space
from sadgs_ns.placing.options import Report
from sadgs_ns.worker import Worker, WorkerError

_FULL_DISK = re.compile("no space left|disk is full|disk I/O error|file too large|failed to write", re.IGNORECASE)
_FULL_BELOW = 8 * 2**20  # Free bytes under which a disk counts as full
_LOG_PREFIX = re.compile(r"^([IWEF]\d{8} .*?\] |\s*what\(\):\s*)?(\[[\w.]+:\d+\] )?(Check failed: (\S+\(\) )?)?")
_ERROR_LINE = re.compile(r"^[EF]\d{8} |^\s*what\(\): |Error: ")


@contextlib.contextmanager
def start_colmap() -> Iterator[Worker]:
    """Start the process of COLMAP, which imports what it needs, and kill it when the context is left."""
    with (
        tempfile.TemporaryDirectory() as folder,
        Worker("sadgs_ns.placing.colmap_process:make_model", Path(folder) / "colmap.txt") as worker,
    ):
        yield worker


def make_model(colmap: Worker, *arguments: Any, folder: Path, report: Report) -> Any:
    """Call `reconstruct.make_model`, which writes to `folder`, in the process of COLMAP, as `Worker.run` does.

    Raise an InputError of the function, OSError if the disk is full, or RunError if it fails otherwise.
    """
    present_stage = "its start"

    def on_event(event: str, stage: str, done: int, total: int) -> None:
        nonlocal present_stage
        present_stage = stage
        report(stage, done, total)

    try:
        return colmap.run(*arguments, on_event=on_event)
    except WorkerError as error:
        raise _explain(error, present_stage, folder) from None


def _explain(error: WorkerError, stage: str, folder: Path) -> OSError | RunError:
    """Return the exception for the end of COLMAP's process, whose message names the stage and the remedy."""
    if _FULL_DISK.search(error.output) or shutil.disk_usage(folder).free < _FULL_BELOW:
        problem = f"{folder} could not be written while COLMAP worked on {stage} ({free_space(folder)} free there)"
        return OSError(f"{problem}: make room, and run the same command again to resume.")
    if error.exitcode == -signal.SIGKILL:
        problem = f"COLMAP was killed while it worked on {stage}, most likely for want of memory"
        remedy = "close other programs, or give it smaller photos, and run the same command again to resume"
        return RunError(f"{problem}: {remedy}.")
    cause = f"exit code {error.exitcode}"
    for line in error.output.splitlines():
        if _ERROR_LINE.search(line):
            cause = _LOG_PREFIX.sub("", line).strip()
    return RunError(f"COLMAP failed while it worked on {stage} ({cause}); run the same command to try again.")
