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
ITERATION_SHARES = (0.0, 0.2, 0.533, 0.75, 1.0)
TIME_SHARES = (0.0, 0.15, 0.668, 0.817, 1.0)
"""Shares of a run's iterations, and of its time that they take: they are longest while the most Gaussians are there."""
_DENSIFICATION_END = ITERATION_SHARES[2]  # Share of a run's iterations after which densification is over
_EARLY_FACTORS = (0.5, 2.0)
"""Bounds of the time left before that, in times that all iterations take as long as the latest. It was .61 to 1.51 of
these from 7 to 45 % of the iterations of eight captures on GPUs (docs/results.md)."""
_EARLY_SECONDS = 60.0  # Shortest time left for which bounds are shown
_MEASURED_SHARE = 0.35  # Share of a run's time after which the time left is shown; sooner it would be over 30 % off.


def note(text: str) -> None:
    """Print a line for the user, without wrapping it."""
    CONSOLE.print(text, markup=False, highlight=False, soft_wrap=True)


def warn(text: str) -> None:
    """Print a line in yellow, which `sadgs` shows, too."""
    if not CONSOLE.quiet:  # in all processes but the first
        report("warning", sentence=text)
    CONSOLE.print(text, markup=False, highlight=False, soft_wrap=True, style="yellow")


def duration(seconds: float) -> str:
    """Return a time as "40 s", "12 min" or "3 h 5 min"."""
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    if minutes < 100:
        return f"{minutes} min"
    return f"{minutes // 60} h {minutes % 60} min"


def duration_between(least: float, most: float) -> str:
    """Return bounds of a time, ≥ 60 s and far apart, as "40–160 s", "2–8 min" or "0.9–3.4 h"."""
    if most < 180:
        return f"{least:.0f}–{most:.0f} s"
    if most < 100 * 60:
        return f"{least / 60:.0f}–{most / 60:.0f} min"
    return f"{least / 3600:.1f}–{most / 3600:.1f} h"


def early_time_left(step: int, total: int, pace: float) -> str:
    """Return bounds of the time left where `time_left` cannot tell it; "" if less than a minute is left.

    The latest iterations took `pace` seconds each. On a CPU this part of a run takes minutes.
    """
    at_this_pace = pace * (total - 1 - step)
    if at_this_pace < _EARLY_SECONDS:
        return ""
    least, most = _EARLY_FACTORS
    return duration_between(least * at_this_pace, most * at_this_pace)


def time_left(first: int, step: int, total: int, seconds: float, recent: int = 0, pace: float = 0.0) -> float | None:
    """Return the seconds that a run of `total` iterations has left; None if it is too early to tell.

    The iterations after `first` until `step` took `seconds` in all, and those after `recent` took `pace` seconds each.
    The estimate was within 30 % on eight captures, on two hosts each, and later within 20 % (docs/results.md).
    """
    if recent > _DENSIFICATION_END * total:  # From there on, all iterations take about the same time.
        return pace * (total - 1 - step)
    before, done = np.interp([(first + 1) / total, (step + 1) / total], ITERATION_SHARES, TIME_SHARES)
    measured = done - before
    if measured < _MEASURED_SHARE:
        return None
    return float(seconds * (1 - done) / measured)


def cpu_notice(threads: int) -> str:
    """Return what a user should know who trains without a GPU, with so many threads of torch."""
    text = "This run trains on the CPU, which is for small scenes and tests: a GPU is about a hundred times as fast."
    if threads == 1:
        return text
    return (
        f"{text} It computes with {threads} threads; beside other work one is quicker: put OMP_NUM_THREADS=1 before "
        "the command."
    )


def next_commands(config: Path, gaussians: int, held_out: int) -> str:
    """Return the commands for a finished run, given its `config.yml`, its Gaussians and its held-out views."""
    file = shlex.quote(str(config))
    metrics = shlex.quote(str(config.with_name("eval.json")))
    splat = shlex.quote(str(config.with_name("splat.ply")))
    lines = [
        f"What can be done with these {gaussians:,} Gaussians:",
        f"  ns-viewer --load-config {file}",
        "    shows the Gaussians in a browser",
    ]
    if held_out:
        lines += [
            f"  ns-eval --load-config {file} --output-path {metrics}",
            "    compares held-out views with their photos",
        ]
    lines += [f"  sadgs-export {file} --output {splat}", "    writes the Gaussians for other programs"]
    return "\n".join(lines)


class ProgressTable(LocalWriter):
    """nerfstudio's table of progress with the loss, PSNR and number of Gaussians.

    A terminal shows the latest `max_log_size` rows in place, other output above them, and the banner, such as the
    viewer's address, below. Elsewhere, as in a file, every row is a line. Loss and PSNR are read for rows only.
    """

    def __init__(self, config: LocalWriterConfig, banner_messages: list[str] | None = None) -> None:
        super().__init__(config, banner_messages)
        self._banner = banner_messages or []
        self._rows: deque[str] = deque(maxlen=config.max_log_size or None)
        self._times: deque[tuple[int, float]] = deque(maxlen=10)  # Steps of the last rows, and when they were added
        self._first: tuple[int, float] | None = None  # Those of the first row
        self._live: Live | None = None
        if config.max_log_size > 0 and CONSOLE.is_interactive:
            self._live = Live(console=CONSOLE, auto_refresh=False)

    def write_stats_log(self, step: int) -> None:
        """Add a row if an iteration is due for one; nerfstudio calls this after each, and once after the last.

        nerfstudio gives the step of its first event. After a resumed run's first iteration that is the configuration's,
        which is 0, so the step is read from the iteration's own event. This iteration is the first moment of the
        run's times, and is reported even if no row is due, so that nobody waits for where the run goes on.
        """
        stored = {event["name"]: event for event in writer.EVENT_STORAGE}
        if EventName.ITER_TRAIN_TIME.value not in stored:  # Training is over.
            self.stop()
            return
        step = stored[EventName.ITER_TRAIN_TIME.value]["step"]
        is_due = step % writer.GLOBAL_BUFFER["steps_per_log"] == 0
        if not is_due and self._first is not None:
            return
        total = writer.GLOBAL_BUFFER["max_iter"]
        cells = []
        if is_due:
            cells = _cells({name: event["event"] for name, event in stored.items()})  # On CUDA this waits for the step.
        pace, left = self._timing(step, total, time.monotonic())
        report("iteration", step=step, left=left)
        if is_due:
            self._show(_line([f"{step} ({step / total:.2%})", *cells, pace, left]))

    def _timing(self, step: int, total: int, now: float) -> tuple[str, str]:
        """Add the time of a row, and return the time of an iteration and the time left, each "" if it is not known."""
        self._times.append((step, now))
        if self._first is None:
            self._first = self._times[0]
        first_step, first_time = self._first
        recent_step, recent_time = self._times[0]
        if step <= recent_step:
            return "", ""
        pace = (now - recent_time) / (step - recent_step)
        if pace < 1:
            shown_pace = f"{1000 * pace:.0f} ms"
        else:
            shown_pace = f"{pace:.1f} s"
        left = time_left(first_step, step, total, now - first_time, recent_step, pace)
        if left is None:
            return shown_pace, early_time_left(step, total, pace)
        return shown_pace, duration(left)

    def _show(self, row: str) -> None:
        """Print a row, or add it to the rows that a terminal shows in place."""
        header = [_line(list(COLUMNS)), "-" * sum(COLUMNS.values())]
        if self._live is None:
            lines = [row]
            if not self.has_printed:
                lines = [*self._banner, *header, row]
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
    return [
        _cell("{:.4f}", events.get("Train Loss")),
        _cell("{:.2f} dB", metrics.get("psnr")),
        _cell("{:,.0f}", metrics.get("gaussian_count")),
    ]


def _cell(form: str, value: Any) -> str:
    """Return a number or tensor in a format; "" if it is None."""
    if value is None:
        return ""
    return form.format(float(torch.as_tensor(value).detach()))


def _line(cells: list[str]) -> str:
    """Return a row of the table, whose cells are as wide as `COLUMNS`."""
    padded = [f"{cell:<{width}}" for cell, width in zip(cells, COLUMNS.values(), strict=True)]
    return "".join(padded).rstrip()


def remove_tables() -> None:
    """Remove the tables of finished runs from nerfstudio's list, and give the terminal back."""
    tables = [table for table in writer.EVENT_WRITERS if isinstance(table, ProgressTable)]
    for table in tables:
        table.stop()
        writer.EVENT_WRITERS.remove(table)
