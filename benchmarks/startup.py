"""`python -m benchmarks startup --data FOLDER --output startup.jsonl`: what the code for a quick start brings.

A short training run is started as `sadgs` starts it (`training.run.start`) and as `ns-train sadgs` does, each with all
of that code and without a part of it. A user waits until the first step, and until the process has ended. Each way has
caches of compiled kernels of its own. They are empty in its first run, and its later runs find what that has left.

Where `sadgs` finds the cameras, most of the start runs meanwhile. So this is the wait of a user whose capture has them.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from benchmarks import results
from benchmarks.chain import now
from benchmarks.seconds import about
from benchmarks.side_by_side import environment_of, run_program
from benchmarks.table import grid
from sadgs_ns.events import TRACE

_CACHES = ("TRITON_CACHE_DIR", "TORCHINDUCTOR_CACHE_DIR", "CUDA_CACHE_PATH")
"""Variables that name the folders of compiled kernels."""
_SADGS = "from sadgs_ns.training.run.start import train; train()"
_NS_TRAIN = "from nerfstudio.scripts.train import entrypoint; entrypoint()"
_WITHOUT = {
    "deferred_imports": (
        "import sys, types; stand_in = types.ModuleType('sadgs_ns.training.run.deferred_imports'); "
        "stand_in.import_nerfstudio = lambda: None; sys.modules[stand_in.__name__] = stand_in"
    ),
    "compile_ahead": "from sadgs_ns.training.kernels_ahead import compile_ahead; compile_ahead.begin = lambda: None",
}
"""Programs that take a part of the code for a quick start out of a process, before anything else is imported."""
_LONGEST = 300.0
"""Seconds after which a run is ended."""


@dataclass(frozen=True)
class Way:
    """A way to start a run."""

    program: str
    without: str = ""  # Of `_WITHOUT`
    beside: str = ""  # Name of the way that has what this one lacks

    @property
    def code(self) -> str:
        """Return what the process runs."""
        if not self.without:
            return self.program
        return f"{_WITHOUT[self.without]}; {self.program}"


WAYS = {
    "sadgs": Way(_SADGS),
    "sadgs without deferred_imports": Way(_SADGS, "deferred_imports", "sadgs"),
    "sadgs without compile_ahead": Way(_SADGS, "compile_ahead", "sadgs"),
    "ns-train, so without start": Way(_NS_TRAIN, beside="sadgs"),
    "ns-train without compile_ahead": Way(_NS_TRAIN, "compile_ahead", "ns-train, so without start"),
}
"""The ways that are compared."""


def measure(way: Way, data: Path, iterations: int, work: Path, caches: Path) -> dict[str, float]:
    """Train in a process, and return the seconds until the first step (`wait`), until the last, and until its end.

    Raises subprocess.CalledProcessError or TimeoutExpired if it fails; what it printed is in `work/log`.
    """
    trace = work / "trace"
    trace.touch()
    environment = {**environment_of(None), TRACE: str(trace)}
    for variable in _CACHES:
        environment[variable] = str(caches / variable)
    words = ["sadgs", "--data", str(data), "--output-dir", str(work / "out"), "--vis", "none"]
    words += ["--max-num-iterations", str(iterations)]
    start = time.time()
    run_program(way.code, words, work, environment, _LONGEST)
    end = time.time()
    events = [json.loads(text) for text in trace.read_text("utf8").splitlines()]
    times = {event["event"]: event["time"] for event in events}
    seconds = {
        "wait": times["loop begins"] - start,
        "trained": times["loop ends"] - start,
        "seconds": end - start,
    }
    return {name: round(value, 3) for name, value in seconds.items()}


def markdown(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return a line for each way, with medians of its first and its later runs, and what they take more, in seconds."""
    lines = []
    for name, way in WAYS.items():
        cells = [name]
        for is_first in (True, False):
            for quantity in ("wait", "seconds"):
                own = _median(rows, name, is_first, quantity)
                other = _median(rows, way.beside, is_first, quantity)
                cells.append(_with_difference(own, other))
        if cells[1:] != ["–"] * 4:
            lines.append(cells)
    header = ["Started as", "first run: until the first step", "until the end", "later: first step", "end"]
    return grid(header, lines)


def _median(rows: Sequence[Mapping[str, Any]], way: str, is_first: bool, quantity: str) -> float | None:
    """Return the median of a quantity over runs of a way, or None if there are none."""
    found = [row for row in rows if row["status"] == "ok" and row["label"] == way and row["first"] == is_first]
    if not found:
        return None
    return statistics.median(row[quantity] for row in found)


def _with_difference(seconds: float | None, other: float | None) -> str:
    if seconds is None:
        return "–"
    if other is None:
        return f"{seconds:.1f}"
    return f"{seconds:.1f} ({seconds - other:+.1f})"


@dataclass
class Command:
    """Measure what a user waits for at the start of training, with and without the code for a quick start."""

    data: Path
    """capture with cameras, as `ns-train sadgs --data` takes it"""
    output: Path
    """JSON-lines file that the rows are added to"""
    iterations: int = 200
    """steps of each run"""
    later: int = 2
    """runs after the first one of each way"""
    ways: tuple[str, ...] = tuple(WAYS)
    """ways to start"""

    def __call__(self) -> int:
        """Measure; return 0, or 1 if a run failed."""
        data = self.data.resolve()
        if not data.exists():
            raise ValueError(f"--data {self.data} does not exist; give a capture with cameras.")
        for name in self.ways:
            if name not in WAYS:
                raise ValueError(f"--ways names {name!r}; give some of {', '.join(map(repr, WAYS))}.")
        machine = about()
        rows = []
        with tempfile.TemporaryDirectory() as folder:
            # The first process reads programs and photos from the disk; those that are measured find them in memory.
            self._run(data, self.ways[0], -1, Path(folder))
            for number in range(1 + self.later):
                for name in self.ways:
                    row = {**self._run(data, name, number, Path(folder)), **machine}
                    results.append(self.output, row)
                    print(line(row), flush=True)
                    rows.append(row)
        print(f"\n{markdown(rows)}")
        return int(any(row["status"] != "ok" for row in rows))

    def _run(self, data: Path, name: str, number: int, folder: Path) -> dict[str, Any]:
        """Return the row of a run, also of one that fails; the first run of each way has number 0."""
        way = f"way {list(WAYS).index(name)}"
        caches = folder / way
        if number < 0:
            caches = folder / "unmeasured"
        work = folder / f"{way}, run {number}"
        work.mkdir()
        identity = {"key": f"{data.name}/{name}/{number}", "scene": data.name, "label": name, "seed": number}
        row = {**identity, "first": number == 0, "date": now(), "iterations": self.iterations}
        try:
            return {**row, "status": "ok", "error": None, **measure(WAYS[name], data, self.iterations, work, caches)}
        except (subprocess.SubprocessError, KeyError) as error:
            log = (work / "log").read_text(errors="replace")
            print(log, file=sys.stderr)
            return {**row, "status": "failed", "error": f"{type(error).__name__}: see what it printed, on stderr."}


def line(row: Mapping[str, Any]) -> str:
    """Return a row in one line."""
    if row["status"] != "ok":
        return f"{row['key']}: failed: {row['error']}"
    return f"{row['key']}: {row['wait']:.2f} s until the first step, {row['seconds']:.2f} s in all"
