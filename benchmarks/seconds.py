"""`python -m benchmarks seconds PROTOCOL.yaml --photos ROOT --output rows.jsonl --label NAME`: what a user waits for.

It runs `sadgs`, or `sadgs-process` alone, as a user does, several times one after the other. All processes of the
command add the beginnings and ends of their parts to a file (`sadgs_ns.events.TRACE`). From these come a table and a
picture of parts side by side, which show what runs together, and what waits for what. It needs no network.

The first run reads photos and programs from the disk, if nothing has read them before, and later ones find them in
memory. With `--cold` kernels are compiled again in each run.
"""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from benchmarks import results, seconds_plot
from benchmarks.cameras import machine
from benchmarks.chain import now
from benchmarks.photo_captures import PhotoCommand, exit_status, load_protocol, photos_of, write_row, written_row
from benchmarks.plots import save
from benchmarks.run import software
from benchmarks.seconds_table import Part, markdown
from benchmarks.side_by_side import append_output, environment_of, run_program
from sadgs_ns.events import TRACE

PROGRAMS = {"sadgs": "sadgs_ns.cli.sadgs", "sadgs-process": "sadgs_ns.cli.process"}
"""The commands that are measured, and their modules."""
_PROCESSES = {
    "sadgs_ns.cli.process:process": "cameras",
    "sadgs_ns.placing.colmap_process:make_model": "COLMAP",
    "sadgs_ns.training.run.start:train": "training",
    "sadgs_ns.cli.exporting:export_all": "export",
}
"""Names of the processes that a command starts, by the functions that they call."""
_MARKS = {
    "imported": "data and model",
    "training begins": "kernels and start",
    "loop begins": "iterations",
    "loop ends": "saving",
    "training ends": None,
    "export begins": "file",
    "export ends": None,
}
"""Events of which each ends the part before it in its process, and the part that it begins."""
_CACHES = ("TRITON_CACHE_DIR", "CUDA_CACHE_PATH")
"""Variables that name the folders of compiled kernels."""


@dataclass(frozen=True)
class Protocol:
    """What this benchmark runs."""

    captures: dict[str, str]  # Folders of photos below a root, by the captures' names
    every: dict[str, int] = field(default_factory=dict)  # n for captures whose every n-th photo alone is taken
    runs: int = 3  # How often each is measured


@dataclass(frozen=True)
class Run:
    """One run of a command on a capture."""

    capture: str
    folder: str  # Of its photos
    every: int  # Every n-th of them is taken
    number: int  # Of the run, from 0 on
    label: str
    program: str  # Of `PROGRAMS`
    words: tuple[str, ...]  # Further options of the command
    is_cold: bool
    site: str  # Folder with another version of the package, "" for this checkout

    @property
    def key(self) -> str:
        """Name of this run among the rows of a file."""
        return f"{self.capture}/{self.label}/{self.number}"

    def row(self, date: str, **measured: Any) -> dict[str, Any]:
        """Return the run's row."""
        identity = {"key": self.key, "scene": self.capture, "label": self.label, "seed": self.number}
        return {**identity, "date": date, "program": self.program, "cold": self.is_cold, **measured}


def load(path: Path) -> Protocol:
    """Read a protocol. Raises ValueError, one sentence, if it is not as `Protocol` says."""
    return load_protocol(path, Protocol, "captures")


def parts_of(lines: Sequence[str], program: str, start: float) -> list[Part]:
    """Return the parts of a command in the order of their beginnings.

    Args:
        lines: The lines of the file that `TRACE` names.
        program: The name of the process that started the others.
        start: When the command was started, in seconds since the epoch; the parts count from there.
    """
    events = [json.loads(line) for line in lines]
    names = {event["process"]: _PROCESSES.get(event["function"], "") for event in events if "function" in event}
    parts = []
    begun: dict[int, tuple[str, float]] = {}  # The part of each process that a mark has begun
    for event in events:
        process = names.get(event["process"]) or program
        seconds = event["time"] - start
        if event["event"] == "span":
            parts.append(Part(process, event["name"], event["begin"] - start, seconds))
        elif event["event"] in _MARKS:
            previous = begun.pop(event["process"], None)
            if previous is not None:
                parts.append(Part(process, previous[0], previous[1], seconds))
            following = _MARKS[event["event"]]
            if following is not None:
                begun[event["process"]] = (following, seconds)
    return sorted(parts, key=lambda part: part.begin)


def measure(run: Run, work: Path) -> dict[str, Any]:
    """Run the command in a folder, and return its seconds, parts and number of photos.

    Call this once in a process: the seconds of all cores are those of all commands that the process has run. Raises
    subprocess.CalledProcessError if the command fails; what it printed is in `work/log`.
    """
    photos = Path(run.folder)
    if run.every > 1:
        photos = link_photos(photos, run.every, work / "photos")
    trace = work / "trace"
    trace.touch()
    environment = {**environment_of(None, run.site), TRACE: str(trace)}
    if run.is_cold:
        for variable in _CACHES:
            environment[variable] = str(work / variable)
    code = f"import sys; from {PROGRAMS[run.program]} import main; sys.exit(main())"
    words = [str(photos), str(work / "out"), *run.words]
    if run.program == "sadgs":
        words.insert(1, "--output")
    start_time = time.time()  # By the clock of the trace
    begin = time.perf_counter()
    run_program(code, words, work, environment)
    seconds = time.perf_counter() - begin
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    parts = parts_of(trace.read_text("utf8").splitlines(), run.program, start_time)
    rounded = [[part.process, part.name, round(part.begin, 3), round(part.end, 3)] for part in parts]
    return {
        "seconds": round(seconds, 3),
        "cpu_seconds": round(used.ru_utime + used.ru_stime, 3),  # Of all processes of the command
        "photos": len(photos_of(photos)),
        "parts": rounded,
    }


def link_photos(photos: Path, every: int, folder: Path) -> Path:
    """Make a folder of links to every n-th photo of another, and return it."""
    folder.mkdir()
    for name in photos_of(photos)[::every]:
        (folder / name.replace("/", "-")).symlink_to(photos / name)
    return folder


def row_of(run: Run, work: Path, log: Path) -> dict[str, Any]:
    """Measure a run, and return its row; if the run fails, its output is added to a log."""
    date = now()
    try:
        measured = measure(run, work)
    except subprocess.CalledProcessError as error:
        append_output(run.key, work, log)
        return run.row(date, status="failed", error=f"{run.program} ended with code {error.returncode}; see {log}.")
    return run.row(date, status="ok", error=None, **measured, **about())


def about() -> dict[str, Any]:
    """Return what rows say of the machine and its software."""
    import torch

    gpu = None
    if torch.cuda.is_available():
        gpu = torch.cuda.get_device_name()
    return {**machine(), "gpu": gpu, "versions": software()}


@dataclass
class Command(PhotoCommand):
    """Measure how long a user waits from photos to the file, and for which parts, or what is left of it."""

    runs: int = 0
    """runs of each capture; the default is the protocol's"""
    only: tuple[str, ...] = ()
    """captures to measure; the default is all"""
    cameras: bool = False
    """measure sadgs-process alone, which needs no GPU"""
    formats: str = "ply"
    """formats that sadgs exports"""
    cold: bool = False
    """compile kernels again in each run, as after installing"""
    site: Path | None = None
    """folder with another version of the package, whose commands run; the default is this checkout"""
    plots: Path | None = None
    """folder for a picture of each capture and label"""

    def chosen(self) -> list[Run]:
        """Return the runs that are asked for; raise ValueError if there is no such capture or folder."""
        protocol = load(self.protocol)
        names = list(self.only) or list(protocol.captures)
        program = "sadgs"
        options = ("--formats", self.formats)
        if self.cameras:
            program = "sadgs-process"
            options = ()
        site = ""
        if self.site is not None:
            site = str(self.site.resolve())
        runs = []
        for name in names:
            if name not in protocol.captures:
                raise ValueError(f"--only names {name!r}; the protocol has {', '.join(protocol.captures)}.")
            folder = str(self.folder_of(protocol.captures[name]))
            for number in range(self.runs or protocol.runs):
                run = Run(
                    capture=name,
                    folder=folder,
                    every=protocol.every.get(name, 1),
                    number=number,
                    label=self.label,
                    program=program,
                    words=options,
                    is_cold=self.cold,
                    site=site,
                )
                runs.append(run)
        return runs

    def __call__(self) -> int:
        """Run them one after the other; return 0, 1 if one failed, or 130 after an interrupt."""
        runs = self.chosen()
        done = self.done_keys()
        todo = [run for run in runs if run.key not in done]
        log = self.output.with_suffix(".log").resolve()

        def launch(run: Run, gpu: str | None, work: Path) -> subprocess.Popen[bytes]:
            command = [sys.executable, "-m", "benchmarks.seconds", json.dumps(asdict(run)), str(work), str(log)]
            return subprocess.Popen(command, env=environment_of(gpu), start_new_session=True)

        def ended(run: Run, code: int, work: Path) -> None:
            problem = f"the process ended with code {code} and no row; it said why."
            row = written_row(work, lambda: run.row(now(), status="failed", error=problem))
            results.append(self.output, row)
            print(line(row), flush=True)

        if not self.run(todo, launch, ended):
            return 130
        rows = results.read(self.output)
        print(f"\n{markdown(rows)}")
        if self.plots is not None:
            for name, figure in seconds_plot.figures(rows):
                self.plots.mkdir(parents=True, exist_ok=True)
                save(figure, self.plots / f"{name}.png")
        return exit_status(rows, {run.key for run in runs})


def line(row: Mapping[str, Any]) -> str:
    """Return a row in one line."""
    if row["status"] != "ok":
        return f"{row['key']}: failed: {row['error']}"
    return f"{row['key']}: {row['photos']} photos, {row['seconds']:.1f} s, {row['cpu_seconds']:.1f} s on all cores"


def main() -> None:
    """Measure one run in this process and write its row; the command starts it."""
    described, folder, log = sys.argv[1:]
    fields = json.loads(described)
    run = Run(**{**fields, "words": tuple(fields["words"])})
    work = Path(folder)
    row = row_of(run, work, Path(log))
    write_row(work, row)


if __name__ == "__main__":
    main()
