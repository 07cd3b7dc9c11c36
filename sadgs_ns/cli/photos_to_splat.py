"""One run of `sadgs`: what its stages work on, and the processes that they start."""

from __future__ import annotations

import contextlib
import os
import shlex
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from sadgs_ns.cli.given_cameras import find_given_cameras
from sadgs_ns.cli.process import Process
from sadgs_ns.cli.sadgs_folder import SadgsFolder, Settings
from sadgs_ns.cli.sadgs_options import Sadgs, check_options, choose_formats
from sadgs_ns.cli.status_line import StatusLine, Timeline
from sadgs_ns.errors import InputError, RunError, WriteError
from sadgs_ns.files import check_encoding, locked
from sadgs_ns.placing.folder import is_result
from sadgs_ns.placing.scene import Scene
from sadgs_ns.placing.video import count_frames
from sadgs_ns.worker import OnEvent, Worker, WorkerError

_TRAINING = "sadgs_ns.training.run.start:train"
_EXPORT = "sadgs_ns.cli.exporting:export_all"


class PhotosToSplat:
    """One run of the command, with options for ns-train; raises InputError before anything is written.

    Attributes:
        options: The options of the command.
        train_options: The options for ns-train.
        console: Where the lines of the stages are printed.
        source: The photos or the video.
        title: The title of the page, which is the source's name.
        folder: The folder for all results.
        results: The same folder, with its settings.
        formats: The formats to export, in this order.
        given: The cameras that the source brings, or None to find new ones.
        data: What is trained on: the source with its cameras, or the scene of new ones.
        process: The options of `sadgs-process` for new cameras.
        added: How many photos were added since new cameras were found.
        timeline: Where the time went.
    """

    def __init__(self, options: Sadgs, train_options: Sequence[str], console: Console) -> None:
        self.options = options
        self.train_options = train_options
        self.console = console
        self.source = options.source
        self.title = _name_of(options.source)
        self.folder = options.output or _default_folder(options.source)
        self.results = SadgsFolder(self.folder)
        _check_source(options.source)
        self.formats = choose_formats(options.formats, options.measure, console)
        self.given = find_given_cameras(options, train_options)
        self.timeline = Timeline()
        check_options(options, train_options)
        self._read_settings()
        for path in (self.source, self.folder):
            if not str(path).isprintable():
                raise InputError(f"{str(path)!a} has unprintable characters in its name: rename it.")
            check_encoding(path)
        self.process = Process(self.source, self.results.scene, max_size=options.max_size)
        self.added = 0
        if self.given is not None:
            self.data = self.source
        else:
            if self.source.is_file():
                count_frames(self.source)  # It raises InputError if this is no video.
            self.data = self.results.scene
            self.added = Scene(self.process).added
        self._lock: int | None = None
        self._workers = contextlib.ExitStack()
        self._trainer: Worker | None = None
        self._exporter: Worker | None = None

    def _read_settings(self) -> None:
        cameras = "new"
        measure: bool | None = self.options.measure
        if self.given is not None:
            cameras = self.given.describe()
            if self.given.is_divided:
                measure = None
        chosen = Settings(
            source=os.path.realpath(self.source),
            cameras=cameras,
            max_size=self.options.max_size,
            effort=self.options.effort,
            train_options=list(self.train_options),
            measure=measure,
        )
        self.results.read_settings(chosen, self.given)

    @contextlib.contextmanager
    def begin(self, lock_seconds: float) -> Iterator[None]:
        """Lock the folder, write its settings, and start the process for training; leaving it ends all processes.

        Raise InputError if the folder does not become free in some seconds, WriteError if it cannot be made.
        """
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise WriteError(self.folder, error) from error
        # A stage has the lock, too, and keeps it until it has saved where this process was killed.
        refusal = f"another sadgs works in {self.folder}; wait for it, or stop it."
        with locked(self.folder, refusal, lock_seconds) as self._lock, self._workers:
            self._read_settings()  # Another run may have gone on meanwhile.
            settings = self.results.settings
            if not self.results.has_scene():
                settings.few = None
            if settings.views is not None and not self.results.has_scene():  # Somebody deleted it.
                settings.views = None
                settings.trained = None
                settings.measured = None
                settings.run = self.results.new_run_name(int(time.time()))
                settings.previous_run = None
            elif self.results.retraining:
                self.console.print(self.results.begin_another_run(), markup=False, soft_wrap=True)
            self.results.write_settings()
            if self.added or self.results.trained() is None:
                self._trainer = self.worker("training", _TRAINING)  # Meanwhile it imports what training needs.
            yield

    def trainer(self) -> Worker:
        """Return the process for training, and start it if it was not started yet."""
        if self._trainer is None:
            self._trainer = self.worker("training", _TRAINING)
        return self._trainer

    def exporter(self) -> Worker:
        """Return the process for export, and start it if it was not started yet."""
        if self._exporter is None:
            self._exporter = self.worker("export", _EXPORT)
        return self._exporter

    def worker(self, stage: str, function: str) -> Worker:
        """Start a process that imports `function`, as `module:name`, and prints into the log of the stage."""
        assert self._lock is not None, "the work has begun"
        worker = Worker(function, self.folder / "log" / f"{stage}.txt", [self._lock], saves=True)
        return self._workers.enter_context(worker)

    def call(self, worker: Worker, line: StatusLine, on_event: OnEvent, command: Sequence[str], *arguments: Any) -> Any:
        """Call a worker's function as `Worker.run` does, and name the log where it fails."""

        def listen(event: str, **fields: Any) -> None:
            self.timeline.follow(event, **fields)
            if event == "stopping":
                line.update(event)
            else:
                on_event(event, **fields)

        try:
            return worker.run(*arguments, on_event=listen, command=command)
        except (InputError, WorkerError) as error:
            line.update("failed")
            problem = f"{worker.log.stem}: {str(error).rstrip('.')}. All that it printed is in {worker.log}"
            if isinstance(error, InputError) or error.exitcode == 2:
                raise InputError(f"{problem}.") from None
            raise RunError(f"{problem}; run the same command again to resume.") from None


def _check_source(source: Path) -> None:
    """Raise InputError if the source is a folder of results, and say how to show it or to go on with it."""
    if not is_result(source):
        return
    settings = Settings.read(source / "settings.json", source)
    photos = "PHOTOS"
    if settings is not None and settings.source is not None:
        photos = shlex.quote(settings.source)
    shown = ""
    files = [source / f"splat.{name}" for name in ("html", "ply")]
    for file in [file for file in files if file.is_file()][:1]:
        shown = f"open {file} to see it, or "
    remedy = f"{shown}run `sadgs {photos} --output {shlex.quote(str(source))}` to go on with it"
    raise InputError(f"{source} is a result of sadgs, and no photos: {remedy}.")


def _default_folder(source: Path) -> Path:
    """Name the folder for the results after the source, in the working directory."""
    return Path(f"{_name_of(source)}-splat")


def _name_of(source: Path) -> str:
    """Return the name of photos' folder, or of a video without its suffix."""
    real = Path(os.path.realpath(source))
    name = real.stem
    if real.is_dir():
        name = real.name
    return name or "photos"
