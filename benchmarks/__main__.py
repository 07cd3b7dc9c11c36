"""`python -m benchmarks PROTOCOL.yaml --scenes ROOT --output results.jsonl`: run a benchmark, or what is left of it.

Every run is a process of its own, so that none inherits another's memory, caches or random state.
"""

from __future__ import annotations

import dataclasses
import importlib
import itertools
import json
import re
import subprocess
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import tyro
from tyro.conf import Positional

from benchmarks import gate, protocol, results
from benchmarks.protocol import Job
from benchmarks.results import Result
from benchmarks.side_by_side import append_output, devices_of, environment_of, run_side_by_side, sigterm_exits
from benchmarks.table import markdown

COMMANDS = {
    "table": ("table_command:Command", "the table of a results file, and a plot of quality against time"),
    "views": ("view_table:Command", "the PSNR of each held-out view, and where it is far below"),
    "documents": ("documents:Command", "the tables and figures of the documents, from the rows of docs/results"),
    "step": ("step:Command", "the parts of a training step, with and without our Triton kernels (CUDA)"),
    "kernels": ("kernel_share:Command", "what each Triton kernel brings: steps with its twin in its place (CUDA)"),
    "validation": ("validation:Command", "copies of scenes whose validation views are held out"),
    "captures": ("captures:Command", "where the tables' captures come from, and whether a folder holds them"),
    "chain": ("chain:Command", "from photos to the exported file, compared with the original photos"),
    "cameras": ("cameras:Command", "how accurately cameras are placed, with several seeds and losses"),
    "seconds": ("seconds:Command", "what a user waits for: the parts of a command side by side"),
    "startup": ("startup:Command", "what the code for a quick start brings: the wait for the first step"),
    "hashes": ("hashes:Command", "hashes of what short runs and kernels compute, to compare two commits"),
    "exposures": ("exposures:Command", "a copy of a scene whose photos have known exposures"),
    "gains": ("known_gains:Command", "how accurately gains of exposure are found, given known ones"),
    "evidence": ("moved:Command", "pictures of what a run finds to have moved, and why"),
    "disturbed": ("disturbed:Command", "copies of scenes in which things stand before some photos, and their masks"),
}
"""What is done besides running a protocol, and the class that does it."""

Launch = Callable[[Job, "str | None", Path], "subprocess.Popen[bytes]"]
"""Starts a job on a GPU (None: any; "0+1": two) in a folder, where `result.json` and `log` appear."""


def _result(job: Job, code: int, folder: Path, log: Path) -> Result:
    """Return the measurements of a process that has ended; if it failed, its output is added to the log."""
    written = folder / "result.json"
    error = f"the run ended with code {code} and no result; see {log}."
    measured = {"status": "failed", "error": error}
    if written.exists():
        measured = json.loads(written.read_text())
    if measured["status"] == "failed" and (folder / "log").exists():
        append_output(job.key, folder, log)
    identity = {"scene": job.scene.name, "label": job.row.label, "method": job.row.method, "seed": job.seed}
    return {"key": job.key, **identity, "overrides": job.row.overrides, **measured}


def launcher(root: Path) -> Launch:
    """Starts jobs with `benchmarks.run`, on scenes in a folder."""

    def launch(job: Job, gpu: str | None, folder: Path) -> subprocess.Popen[bytes]:
        spec = json.dumps({**dataclasses.asdict(job), "root": str(root)}, default=str)
        command = ["-m", "benchmarks.run", "--spec", spec, "--out", str(folder / "result.json")]
        devices = devices_of(gpu)
        if len(devices) > 1:
            torchrun = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(len(devices))]
            command = [*torchrun, *command]
        command = [sys.executable, *command]
        with (folder / "log").open("wb") as log:
            # No prompt of nerfstudio's may wait for somebody, and a compiler that the run started can be ended with it.
            apart = partial(subprocess.Popen, stdin=subprocess.DEVNULL, start_new_session=True)
            return apart(command, stdout=log, stderr=subprocess.STDOUT, env=environment_of(gpu))

    return launch


def run_all(
    jobs: Sequence[Job],
    launch: Launch,
    finished: Callable[[Result], None],
    log: Path,
    gpus: Sequence[str | None] = (None,),
    jobs_per_gpu: int = 1,
) -> None:
    """Run jobs in their order, some at a time on each GPU; an exception ends all runs.

    Args:
        jobs: What is run.
        launch: Starts a job.
        finished: Is called with each result when its run ends.
        log: The output of runs that fail is added to this file.
        gpus: Where the jobs run, as for `Launch`.
        jobs_per_gpu: How many run at a time on each.
    """

    def ended(job: Job, code: int, folder: Path) -> None:
        finished({**_result(job, code, folder, log), "jobs_per_gpu": jobs_per_gpu})

    run_side_by_side(jobs, launch, ended, gpus, jobs_per_gpu)


def unfinished(jobs: Sequence[Job], done: Sequence[Result]) -> list[Job]:
    """Jobs with no result that is ok."""
    keys = {result["key"] for result in done if result["status"] == "ok"}
    return [job for job in jobs if job.key not in keys]


def line(result: Result) -> str:
    """A finished run in one line."""
    name = f"{result['scene']} {result['label']} seed {result['seed']}"
    if result["status"] != "ok":
        return f"{name}: failed: {result['error']}"
    parts = [f"loop {result['loop_seconds']:.1f} s", f"PSNR {result['psnr']:.2f}", f"SSIM {result['ssim']:.4f}"]
    if result["lpips"] is not None:
        parts.append(f"LPIPS {result['lpips']:.4f}")
    parts.append(f"{result['gaussians']:,} Gaussians")
    if result["peak_gb"] is not None:
        parts.append(f"{result['peak_gb']:.2f} GB")
    return f"{name}: {', '.join(parts)}"


@dataclasses.dataclass
class Benchmark:
    """Run a benchmark, or what is left of it."""

    protocol: Positional[Path]
    """YAML file of scenes, rows and seeds"""
    scenes: Path
    """folder that holds the scenes"""
    output: Path
    """JSON-lines file; runs already in it are skipped"""
    gpus: str | None = None
    """such as 0,1 (default: the first visible one); 0+1 trains one splat on both"""
    jobs_per_gpu: int = 1
    """times are only comparable with 1"""
    only: str = ""
    """regular expression: only runs whose scene/label/seed match"""
    aligned: bool = False
    """also measure held-out views after aligning their cameras on the frozen Gaussians, 60 steps each"""
    gate: Path | None = None
    """baseline in JSON: exit with 1 if results are worse"""
    reference: str | None = None
    """label of the row that the columns Ratio and Matched compare with"""

    def selected(self) -> list[Job]:
        """Return the protocol's jobs that the options select; raise ValueError if an option or a scene is wrong."""
        from benchmarks.datasets import check

        loaded = protocol.load(self.protocol)
        jobs = []
        for job in loaded.jobs():
            run = f"{job.scene.name}/{job.row.label}/{job.seed}"
            try:
                is_selected = re.search(self.only, run)
            except re.error as error:
                raise ValueError(f"--only {self.only!r} is not a regular expression ({error}).") from error
            if not is_selected:
                continue
            if self.aligned:
                row = dataclasses.replace(job.row, aligned=True)
                job = dataclasses.replace(job, row=row)
            jobs.append(job)
        if not jobs:
            raise ValueError(f"--only {self.only!r} leaves no run; it is searched for in scene/label/seed.")
        if self.jobs_per_gpu < 1:
            raise ValueError(f"--jobs-per-gpu must be 1 or more, not {self.jobs_per_gpu}.")
        check(jobs, self.scenes, loaded.source)
        return jobs

    def __call__(self) -> int:
        """Run it; returns 0, 1 if a run failed or the gate found a regression, 130 after an interrupt."""
        if self.gate is not None:
            gate.read(self.gate)  # its errors now rather than after hours
        jobs = self.selected()
        gpus: Sequence[str | None] = (None,)
        if self.gpus:
            gpus = self.gpus.split(",")
        devices = {max(len(devices_of(gpu)), 1) for gpu in gpus}
        done = results.read(self.output, missing_ok=True)
        devices |= {result["devices"] for result in done if result.get("devices") is not None}
        if len(devices) > 1:
            raise ValueError(
                "a file holds runs on equally many devices: give --gpus as many for each run, and another --output "
                f"than {self.output} if that has runs on others."
            )
        todo = unfinished(jobs, done)
        log = self.output.with_suffix(".log")
        number = itertools.count(len(jobs) - len(todo) + 1)

        def finished(result: Result) -> None:
            results.append(self.output, result)
            print(f"{next(number)}/{len(jobs)}  {line(result)}", flush=True)

        self.output.parent.mkdir(parents=True, exist_ok=True)
        with sigterm_exits():
            try:
                run_all(todo, launcher(self.scenes.resolve()), finished, log, gpus, self.jobs_per_gpu)
            except KeyboardInterrupt:
                return 130
        latest = {result["key"]: result for result in results.read(self.output)}
        rows = [latest[job.key] for job in jobs if job.key in latest]
        print(markdown(rows, self.reference))
        bad = any(row["status"] != "ok" for row in rows)
        if self.gate is not None:
            bad |= not gate.judge(self.gate, jobs, rows)
        return int(bad)


def main(argv: Sequence[str] | None = None) -> int:
    """Run a protocol or one of COMMANDS, and return its exit code, 2 if the input is wrong."""
    if argv is None:
        argv = sys.argv[1:]
    name = "python -m benchmarks"
    words = list(argv)
    if words and words[0] in COMMANDS:
        target = words.pop(0)
        name = f"{name} {target}"
        module, _, attribute = COMMANDS[target][0].partition(":")
        kind = getattr(importlib.import_module(f"benchmarks.{module}"), attribute)
        description = None
    else:
        kind = Benchmark
        others = "\n".join(f"  {other}: {summary}" for other, (_, summary) in COMMANDS.items())
        description = f"{Benchmark.__doc__} Other commands, each with --help:\n\n{others}"
    command = tyro.cli(kind, prog=name, description=description, args=words, config=(tyro.conf.FlagCreatePairsOff,))
    try:
        return command()
    except (ValueError, OSError) as error:
        print(f"{name}: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
