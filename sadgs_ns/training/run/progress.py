"""Print a run's progress, the time that it will take, and the commands that can follow."""

from __future__ import annotations

import shlex
import time
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.configs.base_config import LocalWriterConfig
from nerfstudio.utils import writer
from nerfstudio.utils.rich_utils import CONSOLE
from nerfstudio.utils.writer import EventName, LocalWriter
from rich.live import Live
from rich.text import Text

from sadgs_ns.events import report

COLUMNS = {"Step (% Done)": 18, "Loss": 9, "PSNR": 10, "Gaussians": 12, "Iteration": 11, "Time left": 10}
"""Columns of the table and their widths, which fit a terminal of 80 characters."""
ITERATION_SHARES, TIME_SHARES = (0.0, 0.2, 0.533, 0.75, 1.0), (0.0, 0.15, 0.668, 0.817, 1.0)
"""Shares of a run's iterations, and of its time that they take: they are longest while the most Gaussians are there."""
_MEASURED_SHARE = 0.35  # Share of a run's time after which the time left is told; sooner it would be over 30 % off.


def note(text: str) -> None:
    """Print a line for the user, without wrapping it."""
    CONSOLE.print(text, markup=False, highlight=False, soft_wrap=True)


def warn(text: str) -> None:
    """Print a line in yellow, which `sadgs` shows, too."""
    if not CONSOLE.quiet:  # in all processes but the first
        report("warning", told=text)
    CONSOLE.print(text, markup=False, highlight=False, soft_wrap=True, style="yellow")


def duration(seconds: float) -> str:
    """Return a time as "40 s", "12 min" or "3 h 5 min"."""
    minutes = round(seconds / 60)
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60} min"


def time_left(first: int, step: int, total: int, seconds: float, recent: int = 0, pace: float = 0.0) -> float | None:
    """Return the seconds that a run of `total` iterations has left if those after `first` until `step` took `seconds`.

    Those after `recent` took `pace` each, as all do after densification. None is too early to tell. It was within 30 %
    on eight captures, on two hosts each, and then within 20 (docs/results.md).
    """
    if recent > ITERATION_SHARES[2] * total:
        return pace * (total - 1 - step)
    before, done = np.interp([(first + 1) / total, (step + 1) / total], ITERATION_SHARES, TIME_SHARES)
    return None if done - before < _MEASURED_SHARE else float(seconds * (1 - done) / (done - before))


def cpu_notice(threads: int) -> str:
    """Return what a user should know who trains without a GPU, with so many threads of torch."""
    text = "This run trains on the CPU, which is for small scenes and tests: a GPU is about a hundred times as fast."
    remedy = "beside other work one is quicker: put OMP_NUM_THREADS=1 before the command."
    return text if threads == 1 else f"{text} It computes with {threads} threads; {remedy}"


def next_commands(config: Path, gaussians: int) -> str:
    """Return the commands for a finished run, from the path of its `config.yml` and its number of Gaussians."""
    file, metrics, splat = (shlex.quote(str(config.with_name(n))) for n in (config.name, "eval.json", "splat.ply"))
    return (
        f"What can be done with these {gaussians:,} Gaussians:\n"
        f"  ns-viewer --load-config {file}\n"
        "    shows the Gaussians in a browser\n"
        f"  ns-eval --load-config {file} --output-path {metrics}\n"
        "    compares held-out views with their photos\n"
        f"  sadgs-export {file} --output {splat}\n"
        "    writes the Gaussians for other programs"
    )


class ProgressTable(LocalWriter):
    """nerfstudio's table of progress with the loss, PSNR and number of Gaussians.

    A terminal shows the latest `max_log_size` rows in place, other output above them, and the banner, such as the
    viewer's address, below. Elsewhere, as in a file, every row is a line. Loss and PSNR are read for rows only.
    """

    def __init__(self, config: LocalWriterConfig, banner_messages: list[str] | None = None) -> None:
        super().__init__(config, banner_messages)
        self._banner = banner_messages or []
        self._rows: deque[str] = deque(maxlen=config.max_log_size or None)
        self._times: deque[tuple[int, float]] = deque(maxlen=10)
        self._first: tuple[int, float] | None = None  # the first row
        in_place = config.max_log_size > 0 and CONSOLE.is_interactive
        self._live = Live(console=CONSOLE, auto_refresh=False) if in_place else None

    def write_stats_log(self, step: int) -> None:
        """Add a row if the step is due for one; nerfstudio calls this after every step, and once after the last."""
        events = {event["name"]: event["event"] for event in writer.EVENT_STORAGE}
        if EventName.ITER_TRAIN_TIME.value not in events:  # Training is over.
            self.stop()
            return
        if step % writer.GLOBAL_BUFFER["steps_per_log"] != 0:
            return
        cells = _cells(events)  # On CUDA this waits for the step.
        now = time.monotonic()
        self._times.append((step, now))
        self._first = self._first or self._times[0]
        total = writer.GLOBAL_BUFFER["max_iter"]
        timing = ["", ""]
        if step > self._times[0][0]:
            pace = (now - self._times[0][1]) / (step - self._times[0][0])
            left = time_left(self._first[0], step, total, now - self._first[1], self._times[0][0], pace)
            short = f"{1000 * pace:.0f} ms" if pace < 1 else f"{pace:.1f} s"
            timing = [short, "" if left is None else duration(left)]
        report("iteration", step=step, left=timing[1])
        self._show(_line([f"{step} ({step / total:.2%})", *cells, *timing]))

    def _show(self, row: str) -> None:
        header = [_line(list(COLUMNS)), "-" * sum(COLUMNS.values())]
        if self._live is None:
            lines = [row] if self.has_printed else [*self._banner, *header, row]
            CONSOLE.print("\n".join(lines), markup=False, highlight=False, soft_wrap=True)
        else:
            self._rows.append(row)
            self._live.start()
            self._live.update(Text("\n".join([*header, *self._rows, *self._banner])), refresh=True)
        self.has_printed = True

    def stop(self) -> None:
        """Leave the table as it is and give the terminal back."""
        if self._live is not None:
            self._live.stop()


def _cells(events: dict[str, Any]) -> list[str]:
    """Return loss, PSNR and number of Gaussians, each "" if nerfstudio did not hand it over."""
    metrics = events.get("Train Metrics Dict", {})
    values = {
        "{:.4f}": events.get("Train Loss"),
        "{:.2f} dB": metrics.get("psnr"),
        "{:,.0f}": metrics.get("gaussian_count"),
    }
    return ["" if v is None else form.format(float(torch.as_tensor(v).detach())) for form, v in values.items()]


def _line(cells: list[str]) -> str:
    return "".join(f"{cell:<{width}}" for cell, width in zip(cells, COLUMNS.values(), strict=True)).rstrip()


def remove_tables() -> None:
    """Remove the tables of finished runs from nerfstudio's list, and give the terminal back."""
    for table in [table for table in writer.EVENT_WRITERS if isinstance(table, ProgressTable)]:
        table.stop()
        writer.EVENT_WRITERS.remove(table)
