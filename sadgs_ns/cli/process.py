"""`sadgs-process PHOTOS_OR_VIDEO OUT`: from photos to a scene that `ns-train sadgs --data OUT` reads, with pycolmap.

OUT holds `images/`, `transforms.json`, `sparse_pc.ply` and COLMAP's model in `sparse/0`. `OUT/work` holds what an
interrupted run needs to go on, and of a finished scene what photos that are added later need.
"""

from __future__ import annotations

import shlex
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from sadgs_ns import events
from sadgs_ns.cli.program import exit_code, parse
from sadgs_ns.interrupts import Interrupts
from sadgs_ns.placing.options import PlacingOptions, Report
from sadgs_ns.placing.place import place_photos
from sadgs_ns.placing.plan import Matching, Summary

_SECONDS_PER_LINE = 1.0  # Least time between two lines of a stage's progress in a file


@dataclass
class Process(PlacingOptions):
    """From photos or a video to a scene for sadgs."""

    source: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="PHOTOS_OR_VIDEO")]
    """Folder of photos or of videos, or a video."""
    out: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT")]
    """Folder for the scene; run the same command again to resume."""
    matching: Matching = "auto"
    """How pairs of photos are chosen; auto decides by their kind and number."""
    frames: int = 200
    """Frames to take of a video, at least 3."""
    max_size: Annotated[int, tyro.conf.arg(metavar="PX")] = 1600
    """Longest side of the result, at least 64, 0 to keep it."""
    camera_per_photo: bool = False
    """Every photo has its own zoom, which EXIF does not tell."""


def process(options: Process) -> Summary:
    """Make a scene as `place_photos` does, and report its progress in print and as events.

    Raise its errors, and Interrupted if a signal came: the work so far is kept.
    """
    columns = (TextColumn("{task.description:>24}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    progress = Progress(*columns, disable=not sys.stdout.isatty())
    try:
        with Interrupts(waiting=lambda: True):
            placed = place_photos(options, _reporter(progress), _say)
    finally:
        progress.stop()
    print(placed.summary)
    for doubt in placed.summary.doubts:
        _say("aside", f"warning: the cameras may be wrong, because {doubt}.")
    for sentence in placed.unused:
        _say("aside", sentence)
    return placed.summary


def _say(event: str, sentence: str, **fields: str) -> None:
    """Print a sentence, and report the event that it is about, with the sentence as a field."""
    print(sentence, flush=True)
    events.report(event, sentence=sentence, **fields)


def _reporter(progress: Progress) -> Report:
    """Return a function that shows each stage as a bar, or without a terminal as lines of numbers."""
    tasks: dict[str, TaskID] = {}
    printed = 0.0

    def report(stage: str, done: int, total: int) -> None:
        nonlocal printed
        events.progress(stage, done, total)
        progress.start()  # Before the first stage there is nothing to show.
        begins = stage not in tasks
        if begins:
            tasks[stage] = progress.add_task(stage, total=total)
        progress.update(tasks[stage], completed=done)
        if progress.disable:
            is_due = time.monotonic() >= printed + _SECONDS_PER_LINE
            if begins or done == total or is_due:
                print(f"{stage} {done}/{total}", flush=True)
                printed = time.monotonic()

    return report


def main(argv: Sequence[str] | None = None) -> int:
    """Make a scene and return the exit code, which is 1 also if few photos registered or the cameras are wrong."""
    options = parse(Process, "sadgs-process", argv)
    return exit_code("sadgs-process", options.out, lambda: _run(options))


def _run(options: Process) -> int:
    summary = process(options)
    out = shlex.quote(str(options.out))
    if not summary.is_poor:
        print(f"\nCheck machine and data before a long run:  sadgs-doctor {out}\nTrain:  ns-train sadgs --data {out}")
        return 0
    print(_explain_poor(summary, out), file=sys.stderr)
    return 1


def _explain_poor(summary: Summary, out: str) -> str:
    """Return the sentences on cameras that are wrong, or of too few photos, in a folder whose name is quoted."""
    remedy = "another folder with more photos between those that did not register, with two thirds of overlap"
    if summary.faults:
        problem = f"the cameras in {out} are wrong, because {'; and '.join(summary.faults)}."
        remedy = "another folder with such photos"
    else:
        problem = f"{out} shows only what {summary.registered} of {summary.photos} photos saw."
    if summary.larger_photos:
        remedy = f"another folder with {summary.larger_photos}"
    if summary.matching != "exhaustive":
        remedy = f"the same command with --matching exhaustive, which uses the features found so far; or {remedy}"
    return f"warning: {problem} Try {remedy}. This trains on what is there: ns-train sadgs --data {out}"
