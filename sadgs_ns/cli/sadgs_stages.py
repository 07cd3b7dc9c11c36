"""The stages of `sadgs`: cameras, training, export and, if asked for, measures.

Each sees in the folder whether it was done before, shows on its line how far it is, and returns the last sentence.
"""

from __future__ import annotations

import contextlib
import os
import re
import shlex
from pathlib import Path
from typing import Any

from sadgs_ns.cli.added_photos import choose_run
from sadgs_ns.cli.division import parser_options
from sadgs_ns.cli.export import Export
from sadgs_ns.cli.photos_to_splat import PhotosToSplat
from sadgs_ns.cli.sadgs_options import FORMAT_NAMES, adapt_remedy
from sadgs_ns.cli.status_line import StatusLine
from sadgs_ns.data.layouts import find_cameras
from sadgs_ns.errors import InputError, RunError
from sadgs_ns.placing.plan import Summary

_PLACING = "sadgs_ns.cli.process:process"
_MEASURING = "sadgs_ns.cli.measuring:measure"


def place_cameras(work: PhotosToSplat, line: StatusLine) -> str:
    """Find the cameras of the photos as `sadgs-process` does, unless the source brings some."""
    if work.given is not None:
        return f"those of {work.given.file}; --cameras new finds others"
    _mention_cameras_above(work.source, line)
    settings = work.results.settings
    has_trained = settings.views is not None or work.results.checkpoint() is not None
    goes_on = work.options.anyway or has_trained
    if settings.few and goes_on and not work.added:
        return f"{settings.few}; done before"
    worker = work.worker("cameras", _PLACING)
    source = os.path.abspath(work.source)
    command = ["sadgs-process", source, str(work.results.scene), "--max-size", str(work.options.max_size)]
    progress = _CameraProgress(line)
    summary = Summary(**work.call(worker, line, progress.on_event, command, work.process))
    found = f"{progress.added}{summary.registered} of {summary.photos} photos registered"
    if summary.attempts:
        found += " after a second attempt"
    settings.few = None
    if summary.is_poor:
        settings.few = found
        work.results.write_settings()
        if not work.options.anyway:
            line.update(found)
            raise RunError(_explain_poor(found, summary, command))
        for reason in summary.faults:
            line.print(f"warning: the cameras are wrong, because {reason}.")
    if summary.registered < summary.photos:
        found += ", log/cameras.txt tells of the others"
    return found + progress.done_before


def _mention_cameras_above(source: Path, line: StatusLine) -> None:
    """Print that the folder above brings cameras, if the source is its folder of images."""
    if not source.name.startswith("images"):
        return
    with contextlib.suppress(InputError):  # It is about another folder.
        cameras = find_cameras(source.parent)
        if cameras:
            line.print(f"{cameras} is not used: `sadgs {shlex.quote(str(source.parent))}` takes these cameras.")


def _explain_poor(found: str, summary: Summary, command: list[str]) -> str:
    """Return the sentence on cameras that are wrong, or of too few photos."""
    if summary.faults:
        problem = f"{found}, but the cameras are wrong, because {'; and '.join(summary.faults)}; "
        remedies = "begin another --output with such photos; "
    else:
        problem = f"only {found}, so the splat would show only what these saw: "
        remedies = "take more photos between the others, with two thirds of overlap, and begin another --output; "
    if summary.larger_photos:
        remedies = f"begin another --output with {summary.larger_photos}; "
    if summary.matching != "exhaustive":
        exhaustive = shlex.join([*command, "--matching", "exhaustive"])
        remedies += f"or compare more pairs of them with `{exhaustive}`, and run this command again; "
    return f"{problem}{remedies}or go on with these with --anyway."


class _CameraProgress:
    """Shows on a line how far `sadgs-process` is."""

    def __init__(self, line: StatusLine) -> None:
        self._line = line
        self.added = ""  # The beginning of the status if photos were added
        self.done_before = ""  # Its end if there was nothing to do

    def on_event(self, event: str, **fields: Any) -> None:
        if event == "added":
            self.added = f"{fields['photos']}: "
        elif event in ("panoramas", "aside"):
            self._line.print(fields["sentence"])
        elif event == "unchanged":
            self.done_before = "; done before"
        elif event == "progress":
            self._line.update(f"{self.added}{fields['stage']} {fields['done']} of {fields['total']}")


def train(work: PhotosToSplat, line: StatusLine) -> str:
    """Train as `ns-train sadgs` does, or resume from the last checkpoint."""
    results = work.results
    if work.given is None:  # Given cameras are those that the folder was begun with.
        choose_run(results, work.train_options)
    trained = results.trained()
    if trained:
        return f"{trained}; done before"
    is_resumed = results.checkpoint() is not None
    results.settings.trained = None  # The folder of an earlier run may have been deleted.
    results.settings.measured = None
    if is_resumed:
        line.update("going on")
    else:
        line.update("starting")
        results.forget_exports_of_run()
        if work.given is not None:
            results.settings.files = work.given.stamp_images()
    results.write_settings()
    progress = _TrainingProgress(work, line)
    work.call(work.trainer(), line, progress.on_event, _train_command(work, is_resumed))
    if results.checkpoint() is None:
        raise RunError(f"training ended without a checkpoint; all that it printed is in {work.folder}/log.")
    trained = f"{progress.iterations} iterations, {progress.gaussians} Gaussians"
    results.settings.trained = trained
    results.write_settings()
    return trained


def _train_command(work: PhotosToSplat, is_resumed: bool) -> list[str]:
    """Return the command that trains, or trains on from the last checkpoint."""
    run = work.results.run
    logger = "none"
    if any(re.match("--steps[-_]per[-_]eval", option) for option in work.train_options):
        logger = "tensorboard"  # It logs the measures of held-out views.
    command = ["ns-train", "sadgs", "--data", os.path.abspath(work.data)]
    command += ["--output-dir", str(work.folder.absolute()), "--experiment-name", "training"]
    command += ["--timestamp", run.name, "--vis", logger]
    command += ["--steps-per-eval-image", "0", "--pipeline.effort", f"{work.options.effort:g}"]
    if is_resumed:
        command += ["--load-dir", str(run.absolute())]
    command += work.train_options
    measures = work.results.settings.measure
    if work.given is not None and measures is not None:
        command += parser_options(measures, work.train_options)
    return command


class _TrainingProgress:
    """Shows on a line how far training is, and starts the process for export while it runs."""

    def __init__(self, work: PhotosToSplat, line: StatusLine) -> None:
        self._work = work
        self._line = line
        self.iterations = ""
        self.gaussians = ""

    def on_event(self, event: str, **fields: Any) -> None:
        if event == "training begins":
            self.iterations = f"{fields['iterations']:,}"
        elif event == "warning":
            self._line.print(adapt_remedy(fields["sentence"], self._work.train_options))
        elif event == "iteration":
            self._work.exporter()  # Meanwhile it imports what export needs.
            status = f"iteration {fields['step']:,} of {self.iterations}"
            if fields["left"]:
                status += f", about {fields['left']} left"
            self._line.update(status)
        elif event == "progress":
            self._line.update(f"{fields['stage']} {fields['done']} of {fields['total']}")
        elif event == "training ends":
            self.gaussians = f"{fields['gaussians']:,}"


def export(work: PhotosToSplat, line: StatusLine) -> str:
    """Export the splat as `sadgs-export` does, in each format that has no file of the last checkpoint yet."""
    jobs = []
    progress = _ExportProgress(work, line)
    for name in work.formats:
        output = work.results.splat(name)
        if work.results.has_current_splat(name):
            progress.finished.append(f"{output}; done before")
        else:
            title = None
            if name == "html":
                title = work.title
            # The folder may have been renamed since config.yml noted where the scene is.
            jobs.append(Export(work.results.run, output, data=work.data, title=title))
    for name in FORMAT_NAMES:
        output = work.results.splat(name)
        if name not in work.formats and output.is_file() and not work.results.has_current_splat(name):
            line.print(f"{output} is of an earlier splat: delete it, or make it anew with --formats {name}.")
    if jobs:
        line.update("starting")
        work.call(work.exporter(), line, progress.on_event, [], jobs)
    *others, last = progress.finished
    for sentence in others:
        line.finish(sentence)
    return last


class _ExportProgress:
    """Shows a line for each file."""

    def __init__(self, work: PhotosToSplat, line: StatusLine) -> None:
        self._work = work
        self._line = line
        self.finished: list[str] = []  # Sentences on files that are there and have no line yet

    def on_event(self, event: str, output: str) -> None:
        format_name = Path(output).name.removeprefix("splat.")
        if event == "export begins":
            while self.finished:
                self._line.finish(self.finished.pop(0))
            self._line.update(output)
            self._work.timeline.begin("export", format_name)
        elif event == "export ends":
            self._work.results.note_export(format_name)
            megabytes = Path(output).stat().st_size / 1e6
            self.finished.append(f"{output}, {megabytes:,.1f} MB")


def measure(work: PhotosToSplat, line: StatusLine) -> str:
    """Measure how well the run and its PLY show the views that were held out, unless that was done before."""
    settings = work.results.settings
    if settings.measured:
        suffix = "; done before"
    else:
        suffix = ""
        line.update("starting")

        def on_event(event: str, **fields: Any) -> None:
            if event == "progress":  # Training has printed the warnings, and the log has them again.
                line.update(f"{fields['stage']} {fields['done']} of {fields['total']}")

        worker = work.worker("measures", _MEASURING)
        run = work.results.run
        settings.measured = work.call(worker, line, on_event, [], run, work.data, work.results.splat("ply"))
        work.results.write_settings()
    assert settings.measured is not None
    *others, last = settings.measured
    for sentence in others:
        line.finish(sentence)
    return f"{last}{suffix}"
