"""`python -m benchmarks PROTOCOL.yaml --scenes ROOT --output results.jsonl`: run a benchmark, or what is left of it.

Every run is a process of its own, so that none inherits another's memory, caches or random state.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import importlib
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from benchmarks import command_lines, gate, protocol, results
from benchmarks.protocol import Job
from benchmarks.results import Result
from benchmarks.table import markdown

POLL_SECONDS = 0.2
KILL_SECONDS = 10.0
"""How long a run may take to end when it is asked to, before it is killed."""
TORCHRUN_SECONDS = 40.0
"""The same of a run on several GPUs: torchrun kills its processes, which have sessions of their own, after 30 s."""

COMMANDS = {
    "report": ("report", "the plots and the page of a results file"),
    "views": ("view_table", "the PSNR of each held-out view, how far it is from others, and where it collapses"),
    "documents": ("documents", "the tables of README and docs, and some figures, from the rows of docs/results"),
    "kernels": ("approximations", "what each shortcut in the frequency analysis gets wrong, beside what it costs"),
    "step": ("step", "the parts of a training step, with and without our Triton kernels (CUDA)"),
    "parts": ("parts", "the parts of a training step of a finished run, each by itself (CUDA)"),
    "growth": ("growth", "a training step of more and more Gaussians, and of larger images, beside gsplat's (CUDA)"),
    "validation": ("validation", "copies of scenes whose validation views are held out, for choosing constants"),
    "exposures": ("exposures", "a copy of a scene whose photos have known exposures, for measuring models of colours"),
    "memory": ("memory", "the memory plan beside the real peaks of training steps (CUDA)"),
    "shards": ("shards", "a training step of Gaussians that are spread over several devices, with torchrun"),
    "formats": ("formats", "what the files that sadgs-export writes take and lose, on a run's held-out views"),
}
"""What `python -m benchmarks` does besides running a protocol, and the module that does it."""

Launch = Callable[[Job, "str | None", Path], "subprocess.Popen[bytes]"]
"""Starts a job on a GPU (None: any; "0+1": two) in a folder, where `result.json` and `log` appear."""


def devices_of(gpu: str | None) -> list[str]:
    """The GPUs that a run takes together, "0+1" being two; none are named where any will do."""
    return [] if gpu is None else gpu.split("+")


@dataclasses.dataclass
class _Run:
    job: Job
    gpu: str | None
    process: subprocess.Popen[bytes]
    folder: tempfile.TemporaryDirectory[str]

    def result(self, log: Path) -> Result:
        """What the process, which has ended, measured; the output of one that failed goes to the log."""
        written = Path(self.folder.name, "result.json")
        code = self.process.returncode
        if written.exists():
            measured = json.loads(written.read_text())
        else:
            measured = {"status": "failed", "error": f"the run ended with code {code} and no result; see {log}."}
        output = Path(self.folder.name, "log")
        if measured["status"] == "failed" and output.exists():
            with log.open("a") as file:
                file.write(f"=== {self.job.key}\n{output.read_text(errors='replace')}\n")
        row = self.job.row
        identity = {"scene": self.job.scene.name, "label": row.label, "method": row.method, "seed": self.job.seed}
        return {"key": self.job.key, **identity, "overrides": row.overrides, **measured}

    def stop(self) -> None:
        """End the process and what it started."""
        try:
            os.killpg(self.process.pid, signal.SIGTERM)
            self.process.wait(TORCHRUN_SECONDS if len(devices_of(self.gpu)) > 1 else KILL_SECONDS)
        except ProcessLookupError:
            pass
        except subprocess.TimeoutExpired:
            os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()


def launcher(root: Path, images: Path | None = None) -> Launch:
    """Starts jobs with `benchmarks.run`, on scenes in a folder, with another for images of held-out views."""

    def launch(job: Job, gpu: str | None, folder: Path) -> subprocess.Popen[bytes]:
        folders = {"root": str(root), "images": None if images is None else str(images)}
        spec = json.dumps({**dataclasses.asdict(job), **folders}, default=str)
        command = ["-m", "benchmarks.run", "--spec", spec, "--out", str(folder / "result.json")]
        devices = devices_of(gpu)
        if len(devices) > 1:
            torchrun = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(len(devices))]
            command = [*torchrun, *command]
        command = [sys.executable, *command]
        # The checkout is where the run imports this from, whatever folder the benchmark was started in.
        paths = [str(Path(__file__).resolve().parents[1]), *filter(None, [os.environ.get("PYTHONPATH")])]
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(paths)}
        if gpu is not None:
            environment["CUDA_VISIBLE_DEVICES"] = ",".join(devices)
        with (folder / "log").open("wb") as log:
            # A session of its own, so that a compiler the run started can be ended with it.
            return subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,  # no prompt of nerfstudio's may wait for somebody
                stdout=log,
                stderr=subprocess.STDOUT,
                env=environment,
                start_new_session=True,
            )

    return launch


def run_all(
    jobs: Sequence[Job],
    launch: Launch,
    finished: Callable[[Result], None],
    log: Path,
    gpus: Sequence[str | None] = (None,),
    jobs_per_gpu: int = 1,
    time_limit: float = float("inf"),
) -> int:
    """Run jobs in their order, some at a time on each GPU; whatever ends this early also ends the runs.

    Args:
        finished: Called with each result as its run ends.
        log: Takes the output of runs that fail.
        time_limit: Seconds after which no run starts.

    Returns:
        How many jobs were not started because of the time limit.
    """
    deadline = time.monotonic() + time_limit
    pending, running = deque(jobs), list[_Run]()
    free = deque(gpu for _ in range(jobs_per_gpu) for gpu in gpus)
    try:
        while running or (pending and time.monotonic() < deadline):
            while pending and free and time.monotonic() < deadline:
                folder = tempfile.TemporaryDirectory(prefix="benchmarks-", ignore_cleanup_errors=True)
                job, gpu = pending.popleft(), free.popleft()
                running.append(_Run(job, gpu, launch(job, gpu, Path(folder.name)), folder))
            for run in [run for run in running if run.process.poll() is not None]:
                finished({**run.result(log), "jobs_per_gpu": jobs_per_gpu})
                running.remove(run)
                free.append(run.gpu)
                run.folder.cleanup()
            time.sleep(POLL_SECONDS if running else 0)
    finally:
        for run in running:
            run.stop()
            run.folder.cleanup()
    return len(pending)


def unfinished(jobs: Sequence[Job], done: Sequence[Result]) -> list[Job]:
    """Jobs with no result that is ok."""
    keys = {result["key"] for result in done if result["status"] == "ok"}
    return [job for job in jobs if job.key not in keys]


def line(result: Result) -> str:
    """A finished run in one line."""
    name = f"{result['scene']} {result['label']} seed {result['seed']}"
    if result["status"] != "ok":
        return f"{name}: failed: {result['error']}"
    lpips = "" if result["lpips"] is None else f", LPIPS {result['lpips']:.4f}"
    peak = "" if result["peak_gb"] is None else f", {result['peak_gb']:.2f} GB"
    return (
        f"{name}: loop {result['loop_seconds']:.1f} s, PSNR {result['psnr']:.2f}, SSIM {result['ssim']:.4f}{lpips}, "
        f"{result['gaussians']:,} Gaussians{peak}"
    )


def progress_bar(total: int, done: int, **options: Any) -> tuple[Progress, TaskID]:
    """A bar over all runs, and its task.

    The time left is estimated from the runs that have ended since it was made, on all GPUs together.

    Args:
        done: Runs that had ended before.
        options: Of rich's Progress.
    """
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    left = (TextColumn("left"), TimeRemainingColumn())
    # rich would estimate from the last 30 s, in which at most one run ends.
    progress = Progress(*columns, *left, speed_estimate_period=float("inf"), **options)
    task = progress.add_task("Runs", total=total, completed=done)
    progress.advance(task, 0)  # the moment from which the first run counts
    return progress, task


def _selected(arguments: argparse.Namespace) -> list[Job]:
    """The protocol's jobs that are asked for, all checked before the first one runs."""
    from benchmarks.datasets import runnable

    chosen = protocol.load(arguments.protocol)
    jobs = chosen.jobs()
    try:
        jobs = [job for job in jobs if re.search(arguments.only, f"{job.scene.name}/{job.row.label}/{job.seed}")]
    except re.error as error:
        raise ValueError(f"--only {arguments.only!r} is not a regular expression ({error}).") from error
    if not jobs:
        raise ValueError(f"--only {arguments.only!r} leaves no run; it is searched for in scene/label/seed.")
    if arguments.images is not None and arguments.images.exists() and not arguments.images.is_dir():
        raise ValueError(f"--images {arguments.images} is a file; give a folder.")
    if arguments.jobs_per_gpu < 1:
        raise ValueError(f"--jobs-per-gpu must be 1 or more, not {arguments.jobs_per_gpu}.")
    return runnable(jobs, arguments.scenes, chosen.source, arguments.skip_missing)


@contextlib.contextmanager
def _sigterm_exits() -> Iterator[None]:
    """Meanwhile SIGTERM ends the program by an exception, which also ends the runs."""
    previous = signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, previous)


def main(argv: Sequence[str] | None = None) -> int:
    """Run a benchmark.

    Returns:
        Exit code: 0, 1 if a run failed or the gate found a regression, 2 if the input is wrong, 130 after an interrupt.
    """
    argv = sys.argv[1:] if argv is None else argv
    if argv and argv[0] in COMMANDS:
        getattr(command_lines, argv[0])().parse_args(
            argv[1:]
        )  # It ends with help or an error before the slow imports below.
        return importlib.import_module(f"benchmarks.{COMMANDS[argv[0]][0]}").main(argv[1:])
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks",
        description="Run a benchmark, or what is left of it.",
        epilog="\n".join(
            ["other commands, each with --help:", *(f"  {n}: {what}" for n, (_, what) in COMMANDS.items())]
        ),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("protocol", type=Path, help="YAML file of scenes, rows and seeds")
    parser.add_argument("--scenes", type=Path, required=True, metavar="ROOT", help="folder that holds the scenes")
    parser.add_argument("--output", type=Path, required=True, help="JSON-lines file; runs already in it are skipped")
    parser.add_argument(
        "--gpus", metavar="0,1", help="GPUs to use (default: the first visible one); 0+1 trains one splat on both"
    )
    parser.add_argument("--jobs-per-gpu", type=int, default=1, help="times are only comparable with 1, the default")
    parser.add_argument("--only", default="", metavar="REGEX", help="only runs whose scene/label/seed match")
    parser.add_argument("--time-limit", type=float, default=float("inf"), metavar="SECONDS", help="then start no run")
    parser.add_argument("--images", type=Path, metavar="FOLDER", help="write some held-out views of each run as PNG")
    parser.add_argument("--skip-missing", action="store_true", help="run the scenes that are there")
    group = parser.add_mutually_exclusive_group()
    group.add_argument("--gate", type=Path, metavar="BASELINE.json", help="exit with 1 if results are worse than these")
    group.add_argument("--update-baseline", type=Path, metavar="BASELINE.json", help="write the results' values there")
    parser.add_argument("--reference", metavar="LABEL", help="row whose loop seconds are 1 in the column Ratio")
    arguments = parser.parse_args(argv)
    try:
        for baseline in (arguments.gate, arguments.update_baseline):
            if baseline is not None and (baseline == arguments.gate or baseline.exists()):
                gate.read(baseline)  # its errors now rather than after hours
        jobs = _selected(arguments)
    except ValueError as error:
        print(f"python -m benchmarks: {error}", file=sys.stderr)
        return 2

    gpus = arguments.gpus.split(",") if arguments.gpus else (None,)
    devices = {max(len(devices_of(gpu)), 1) for gpu in gpus}
    done = results.read(arguments.output)
    devices |= {result["devices"] for result in done if result.get("devices") is not None}
    if len(devices) > 1:
        print(
            "python -m benchmarks: a file holds runs on equally many devices: give --gpus as many for each run, and "
            f"another --output than {arguments.output} if that has runs on others.",
            file=sys.stderr,
        )
        return 2
    todo = unfinished(jobs, done)
    if arguments.images is not None:
        keys = {job.key for job in jobs} - {job.key for job in todo}
        without = sum("images" not in result for result in done if result["key"] in keys)
        if without:
            print(f"{without} finished runs have no images; delete their lines to run them again.", flush=True)
    log = arguments.output.with_suffix(".log")
    progress, task = progress_bar(len(jobs), len(jobs) - len(todo), disable=not sys.stdout.isatty())
    with _sigterm_exits(), progress:

        def finished(result: Result) -> None:
            results.append(arguments.output, result)
            print(line(result), flush=True)
            progress.advance(task)

        arguments.output.parent.mkdir(parents=True, exist_ok=True)
        images = None if arguments.images is None else arguments.images.resolve()
        launch = launcher(arguments.scenes.resolve(), images)
        try:
            left = run_all(todo, launch, finished, log, gpus, arguments.jobs_per_gpu, arguments.time_limit)
        except KeyboardInterrupt:
            return 130
    if left:
        print(f"{left} runs were not started within the time limit; the same command continues.")
    latest = {result["key"]: result for result in results.read(arguments.output)}
    rows = [latest[job.key] for job in jobs if job.key in latest]
    print(markdown(rows, arguments.reference))
    bad = any(row["status"] != "ok" for row in rows)
    if arguments.gate is not None:
        bad |= not gate.judge(arguments.gate, jobs, rows)
    if arguments.update_baseline is not None:
        try:
            gate.renew(arguments.update_baseline, jobs, rows)
        except ValueError as error:
            print(f"python -m benchmarks: {error}", file=sys.stderr)
            bad = True
    return int(bad)


if __name__ == "__main__":
    sys.exit(main())
