"""Run processes side by side, some at a time on each GPU, and end them and what they started if the program ends."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TypeVar

POLL_SECONDS = 0.2
KILL_SECONDS = 40.0
"""How long a run may take to end when it is asked to, before it is killed: torchrun kills its processes, which have
sessions of their own, after 30 s."""

Job = TypeVar("Job")


def devices_of(gpu: str | None) -> list[str]:
    """Return the GPUs that a run takes together, "0+1" being two; none are named where any will do."""
    if gpu is None:
        return []
    return gpu.split("+")


def environment_of(gpu: str | None, site: str | Path | None = None) -> dict[str, str]:
    """Return the environment of a process that imports from this checkout, wherever it starts, and sees these GPUs.

    With `site` it imports from that folder first, as of another version of the package.
    """
    paths = [str(Path(__file__).resolve().parents[1])]
    if site:
        paths.insert(0, str(site))
    before = os.environ.get("PYTHONPATH")
    if before:
        paths.append(before)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
    if gpu is not None:
        environment["CUDA_VISIBLE_DEVICES"] = ",".join(devices_of(gpu))
    return environment


def run_program(
    code: str, words: Sequence[str], work: Path, environment: dict[str, str], timeout: float | None = None
) -> None:
    """Run Python code with arguments in a folder, and append what it prints to `log` there.

    Raises subprocess.CalledProcessError if it fails, and TimeoutExpired after so many seconds.
    """
    with (work / "log").open("ab") as log:
        subprocess.run(
            [sys.executable, "-c", code, *words],
            cwd=work,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
            check=True,
            timeout=timeout,
        )


def append_output(key: str, work: Path, log: Path) -> None:
    """Append to a log what the programs of a run printed into `log` in its folder, under the run's key."""
    output = (work / "log").read_text(errors="replace")
    with log.open("a") as file:
        file.write(f"=== {key}\n{output}\n")


def run_side_by_side(
    jobs: Sequence[Job],
    launch: Callable[[Job, str | None, Path], subprocess.Popen[bytes]],
    ended: Callable[[Job, int, Path], None],
    gpus: Sequence[str | None] = (None,),
    jobs_per_gpu: int = 1,
) -> None:
    """Run jobs in their order, some at a time on each GPU; an exception ends all their processes.

    Args:
        jobs: What `launch` knows how to start.
        launch: Starts a job's process, in a session of its own, on a GPU (None: any; "0+1": two) with an empty folder.
        ended: Takes a job, its exit code and its folder, which is deleted afterwards.
        gpus: Where the processes run.
        jobs_per_gpu: How many run at a time on each.
    """
    pending = deque(jobs)
    free = deque(gpu for _ in range(jobs_per_gpu) for gpu in gpus)
    running: list[tuple[subprocess.Popen[bytes], Job, str | None, Path]] = []
    with tempfile.TemporaryDirectory(prefix="benchmarks-", ignore_cleanup_errors=True) as work:
        try:
            while running or pending:
                while pending and free:
                    job = pending.popleft()
                    gpu = free.popleft()
                    folder = Path(tempfile.mkdtemp(dir=work))
                    running.append((launch(job, gpu, folder), job, gpu, folder))
                for run in [run for run in running if run[0].poll() is not None]:
                    process, job, gpu, folder = run
                    ended(job, process.returncode, folder)
                    running.remove(run)
                    free.append(gpu)
                    shutil.rmtree(folder, ignore_errors=True)
                time.sleep(POLL_SECONDS if running else 0)
        finally:
            for process, *_ in running:
                stop(process)


def stop(process: subprocess.Popen[bytes]) -> None:
    """End a process that has a session of its own, with all processes of that session.

    They get SIGTERM, and SIGKILL if the process itself has not ended after KILL_SECONDS.
    """
    try:
        os.killpg(process.pid, signal.SIGTERM)
        process.wait(KILL_SECONDS)
    except ProcessLookupError:  # All have ended.
        pass
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


@contextlib.contextmanager
def sigterm_exits() -> Iterator[None]:
    """Let SIGTERM raise SystemExit within this context, so that `run_side_by_side` ends its processes."""
    previous = signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous)
