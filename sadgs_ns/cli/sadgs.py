"""`sadgs PHOTOS_OR_VIDEO`: one command from photos or a video to a splat that opens in a browser.

Its folder holds the cameras in `scene`, the run in `training`, all output in `log`, the splats, and the state of the
work in `settings.json`. Added photos join the scene, and another run takes the place of the earlier one.
"""

from __future__ import annotations

import re
import shutil
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from rich.console import Console

from sadgs_ns.cli.photos_to_splat import PhotosToSplat
from sadgs_ns.cli.program import exit_code, parse
from sadgs_ns.cli.sadgs_options import Sadgs, read_train_options
from sadgs_ns.cli.sadgs_stages import export, measure, place_cameras, train
from sadgs_ns.cli.status_line import StatusLine, clock
from sadgs_ns.events import span
from sadgs_ns.interrupts import Interrupts, redirect_on_broken_pipe

STAGES: dict[str, Callable[[PhotosToSplat, StatusLine], str]] = {
    "cameras": place_cameras,
    "training": train,
    "export": export,
    "measures": measure,
}
"""The stages in their order, by the names of their lines; measures only if they are asked for.

A stage sees by what lies in `folder` whether it was done before, updates its line, and returns the last sentence of its
line. It may raise InputError and RunError."""
_FIRST_PARTS = {"cameras": ("cameras", "checks"), "training": ("start", "imports"), "export": ("export", "checks")}
"""Stage and part of the time that begin with a stage, if others than itself."""
_LOCK_SECONDS = 10.0  # Time in which the last stage of a killed run may save


def make_splat(work: PhotosToSplat) -> list[Path]:
    """Do the stages that are not done yet, and return the splats; `exit_code` knows all errors of this."""
    with work.begin(_LOCK_SECONDS):
        for name, stage in STAGES.items():
            if name == "measures" and not work.options.measure:
                continue
            work.timeline.begin(*_FIRST_PARTS.get(name, (name, name)))
            with span(name), StatusLine(name, work.console) as line:
                try:
                    line.update(stage(work, line))
                except KeyboardInterrupt:
                    line.update("stopping")
                    raise
        for run in work.results.runs.glob("run*"):
            if run != work.results.run and re.fullmatch(r"run(-\d+)?", run.name):
                shutil.rmtree(run)
    return [work.results.splat(name) for name in work.formats]


def main(argv: Sequence[str] | None = None) -> int:
    """Make a splat and return the exit code, as `exit_code` says."""
    start = time.monotonic()
    if argv is None:
        argv = sys.argv[1:]
    words = list(argv)
    train_options: list[str] = []
    if "--" in words:
        end = words.index("--")
        train_options = words[end + 1 :]
        words = words[:end]
    if "-h" in train_options or "--help" in train_options:
        from sadgs_ns.training.run.train_options import read_options  # It imports torch.

        read_options(train_options)  # It prints the help and exits.
    options = parse(Sadgs, "sadgs", words)
    console = Console(highlight=False)
    redirect_on_broken_pipe(console)

    def run() -> int:
        with Interrupts(waiting=lambda: True):
            work = PhotosToSplat(options, train_options, console)
            read_train_options(train_options)
            splats = make_splat(work)
        _print_end(work, splats, time.monotonic() - start)
        return 0

    return exit_code("sadgs", options.output, run)


def _print_end(work: PhotosToSplat, splats: Sequence[Path], seconds: float) -> None:
    """Print where the time went, and what to open."""
    result = f"The splat is {splats[0]}."
    for splat in splats:
        if splat.suffix == ".html":
            result = f"Open {splat.resolve().as_uri()}"
    if work.options.profile:
        print(work.timeline.table())
    print(f"{'of it':<19}{work.timeline}")
    print(f"{'in all':<9}{clock(seconds):>8}  {result}")
