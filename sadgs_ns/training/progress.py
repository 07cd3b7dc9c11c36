"""What a run says while it trains and when it is done: its progress, how long it will take, and what comes next."""

from __future__ import annotations

import shlex
import time
from collections import deque
from pathlib import Path
from typing import Any

import torch
from nerfstudio.configs.base_config import LocalWriterConfig
from nerfstudio.utils import writer
from nerfstudio.utils.rich_utils import CONSOLE
from nerfstudio.utils.writer import EventName, LocalWriter
from rich.live import Live
from rich.text import Text

from sadgs_ns.events import report

COLUMNS = {"Step (% Done)": 18, "Loss": 9, "PSNR": 10, "Gaussians": 12, "Iteration": 11, "Time left": 10}
"""Columns of the table, each with its width. A terminal of 80 characters holds them in one line."""
MEASURED_STEPS = 3
"""Number of iterations from which the length of the run is first estimated; the first iteration of all, which also
loads images, is none of them."""
MEASURED_SECONDS = 10.0
"""Time after which `MEASURED_STEPS` iterations suffice for the estimate, which otherwise comes with a row."""


def duration(seconds: float) -> str:
    """Return a time in words of at most two units, as "40 s", "12 min" or "3 h 5 min"."""
    if seconds < 99.5:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    if minutes < 100:
        return f"{minutes} min"
    return f"{minutes // 60} h {minutes % 60} min"


def cpu_notice(threads: int) -> str:
    """Return what somebody should know who trains without a GPU, with so many threads of torch."""
    text = (
        "This run trains on the CPU, which is for small scenes and tests: a GPU with CUDA is about a hundred times as "
        "fast. After the first iterations a line says how long the run will take."
    )
    if threads > 1:
        text += (
            f" It computes with {threads} threads; beside other work one is quicker: put OMP_NUM_THREADS=1 before the "
            "command."
        )
    return text


def next_commands(config: Path, gaussians: int) -> str:
    """Return the commands for a finished run: its `config.yml`, and the number of Gaussians that it ended with."""
    commands = {
        ("ns-viewer", "--load-config", str(config)): "shows the Gaussians in a browser",
        ("ns-eval", "--load-config", str(config), "--output-path", str(config.with_name("eval.json"))): (
            "compares held-out views with their photos"
        ),
        ("sadgs-export", str(config), "--output", str(config.with_name("splat.ply"))): (
            "writes the Gaussians for other programs"
        ),
    }
    lines = [f"  {shlex.join(command)}\n    {what}" for command, what in commands.items()]
    return "\n".join([f"What can be done with these {gaussians:,} Gaussians:", *lines])


class ProgressTable(LocalWriter):
    """nerfstudio's table of progress with the loss, PSNR and number of Gaussians.

    A terminal shows the latest rows in place, and what else is printed above them. Elsewhere, as in a file, every row
    is a line. Loss and PSNR, which are of the row's iteration, are read from the device for these rows alone.

    Args:
        config: nerfstudio's; `max_log_size` is the number of rows that stay in view, and 0 keeps all.
        banner_messages: Lines under the table, such as the viewer's address.
    """

    def __init__(self, config: LocalWriterConfig, banner_messages: list[str] | None = None) -> None:
        super().__init__(config, banner_messages)
        self._banner = banner_messages or []
        self._rows: deque[str] = deque(maxlen=config.max_log_size or None)
        self._times: deque[tuple[int, float]] = deque(maxlen=10)
        self._estimated = False
        in_place = config.max_log_size > 0 and CONSOLE.is_interactive
        self._live = Live(console=CONSOLE, auto_refresh=False) if in_place else None

    def write_stats_log(self, step: int) -> None:
        """Add a row if the step is due for one; nerfstudio calls this after every step, and once after the last."""
        events = {event["name"]: event["event"] for event in writer.EVENT_STORAGE}
        if EventName.ITER_TRAIN_TIME.value not in events:  # Training is over.
            self.stop()
            return
        due = step % writer.GLOBAL_BUFFER["steps_per_log"] == 0
        if due:
            cells = self._of_events(events)  # On CUDA this waits for the step, so the clock is read after it.
        now = time.monotonic()
        if not self._times:
            self._times.append((step, now))
        first, start = self._times[0]
        pace = (now - start) / (step - first) if step > first else None
        left = writer.GLOBAL_BUFFER["max_iter"] - step - 1
        # Nobody should have to wait for the next row of a table where so few iterations take so long.
        few_are_slow = step - first >= MEASURED_STEPS and now - start >= MEASURED_SECONDS
        if not self._estimated and pace is not None and (due or few_are_slow):
            self._estimated = True
            self._say_how_long(step - first, pace, left)
        if due:
            if first != step:
                self._times.append((step, now))
            done = f"{step} ({step / writer.GLOBAL_BUFFER['max_iter']:.2%})"
            timing = ["", ""] if pace is None else [_short(pace), duration(pace * left)]
            report("iteration", step=step, left=timing[1])
            self._show(_line([done, *cells, *timing]))

    @staticmethod
    def _of_events(events: dict[str, Any]) -> list[str]:
        """Return loss, PSNR and number of Gaussians, as far as nerfstudio handed them over."""
        metrics = events.get("Train Metrics Dict", {})
        values = events.get("Train Loss"), metrics.get("psnr"), metrics.get("gaussian_count")
        loss, psnr, gaussians = [None if value is None else float(torch.as_tensor(value).detach()) for value in values]
        return [
            "" if loss is None else f"{loss:.4f}",
            "" if psnr is None else f"{psnr:.2f} dB",
            "" if gaussians is None else f"{gaussians:,.0f}",
        ]

    @staticmethod
    def _say_how_long(steps: int, pace: float, left: int) -> None:
        """Print how long the `left` iterations take at the pace, in seconds, that was measured in so many steps."""
        if left > 0:
            CONSOLE.print(
                f"{steps} iterations after the first took {_short(pace)} each: at this pace the {left:,} that are left "
                f"take {duration(pace * left)}, and more where the number of Gaussians grows much.",
                highlight=False,
                soft_wrap=True,
            )

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


def _line(cells: list[str]) -> str:
    return "".join(f"{cell:<{width}}" for cell, width in zip(cells, COLUMNS.values(), strict=True)).rstrip()


def _short(seconds: float) -> str:
    return f"{1000 * seconds:.0f} ms" if seconds < 1 else f"{seconds:.1f} s"


def remove_tables() -> None:
    """Take the tables of progress of runs that are over from nerfstudio's list, and give the terminal back."""
    for table in [table for table in writer.EVENT_WRITERS if isinstance(table, ProgressTable)]:
        table.stop()
        writer.EVENT_WRITERS.remove(table)
