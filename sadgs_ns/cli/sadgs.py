"""`sadgs PHOTOS_OR_VIDEO`: one command from photos or a video to a splat that opens in a browser.

Its folder holds the cameras in `scene`, the run in `training`, all output in `log`, the splats, and the state of the
work in `settings.json`. Added photos join the scene, and another run takes the place of the earlier one.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shlex
import shutil
import sys
import time
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from sadgs_ns.cli.export import Export
from sadgs_ns.cli.process import Process
from sadgs_ns.cli.program import exit_code, parse
from sadgs_ns.cli.sadgs_options import (
    FORMAT_NAMES,
    SET_OPTIONS,
    Sadgs,
    choose_formats,
    find_given_cameras,
    with_dashes,
)
from sadgs_ns.cli.status_line import StatusLine, Timeline, clock
from sadgs_ns.data.coordinates import FRAME_KEYS, TRANSFORMS_NAME
from sadgs_ns.data.layouts import find_cameras
from sadgs_ns.errors import InputError, RunError, WriteError
from sadgs_ns.files import locked, read_settings, write_json
from sadgs_ns.interrupts import Interrupts, redirect_on_broken_pipe
from sadgs_ns.method.schedule import MOST_EFFORT
from sadgs_ns.placing.folder import images_of
from sadgs_ns.placing.options import check_size
from sadgs_ns.placing.plan import Summary
from sadgs_ns.placing.scene import Scene
from sadgs_ns.placing.stamps import changes_of, photo_stamps
from sadgs_ns.placing.video import count_frames
from sadgs_ns.worker import OnEvent, Worker, WorkerError

_TRAINING, _EXPORT = "sadgs_ns.training.run.start:train", "sadgs_ns.cli.exporting:export_all"
_LOCK_SECONDS = 10.0  # Time in which the last stage of a killed run may save
_FIRST_PARTS = {"cameras": ("cameras", "checks"), "training": ("start", "imports"), "export": ("export", "checks")}
"""Stage and part of the time that begin with a stage, if others than itself."""


class PhotosToSplat:
    """One run of the command, with options for ns-train; raises InputError before anything is written."""

    def __init__(self, options: Sadgs, train_options: Sequence[str], console: Console) -> None:
        source = Path(os.path.realpath(options.source))
        name = f"{(source.name if source.is_dir() else source.stem) or 'photos'}-splat"
        self.source, self.folder = options.source, options.output or Path(name)
        self.options, self.train_options, self.console = options, train_options, console
        self._formats = sorted(choose_formats(options.formats, console), key=lambda name: name == "html")
        self._camera_file = find_given_cameras(options, train_options)
        self._scene, self._runs = self.folder / "scene", self.folder / "training" / "sadgs"
        self._data = self.source if self._camera_file else self._scene
        self._capture = self.source if source.is_dir() else self.source.parent
        self.timeline = Timeline()
        self._exporter: Worker | None = None
        if not 0 < options.effort <= MOST_EFFORT:
            raise InputError(f"--effort must be in (0, {MOST_EFFORT}].")
        check_size(options.max_size)
        for option in train_options:
            name = option.partition("=")[0].lstrip("-").replace("_", "-")
            if option.startswith("--") and name in SET_OPTIONS:
                raise InputError(f"--{name} is set by sadgs itself: leave it out, or use ns-train.")
        self._read_settings()
        for path in (self.source, self.folder):
            if not str(path).isprintable():
                raise InputError(f"{str(path)!a} has unprintable characters in its name: rename it.")
        if self.source.is_file() and not self._camera_file:
            count_frames(self.source)
        self._process = Process(self.source, self._scene, max_size=options.max_size)
        self._added = 0 if self._camera_file else Scene(self._process).added

    def _read_settings(self) -> None:
        """Read the settings that the folder was begun with, and replace those that nothing depends on yet.

        Raise InputError if the others differ from the options, or the folder is something else.
        """
        folder, options = self.folder, self.options
        asked = {"source": os.path.realpath(self.source), "--cameras": "new", "--max-size": options.max_size}
        if self._camera_file:
            asked["--cameras"] = f"{self._camera_file} (checksum {zlib.crc32(self._camera_file.read_bytes()):08x})"
        asked |= {"--effort": options.effort, "options of ns-train": list(self.train_options)}
        self._settings = begun = read_settings(folder / "settings.json", folder)
        if not begun and (folder.is_file() or (folder.is_dir() and any(folder.iterdir()))):
            raise InputError(f"{folder} exists and is not a folder that sadgs began; give another --output.")
        decided = ["source", "--cameras"] if begun else []
        decided += ["--max-size"] if (self._scene / "transforms.json").exists() else []
        decided += ["--effort", "options of ns-train"] if self._checkpoint() else []
        differing = [name for name in decided if begun.get(name) != asked[name]]
        told = [f"{name} was {_shown(begun.get(name))}, is {_shown(asked[name])}" for name in differing]
        if self._camera_file and self._checkpoint():
            changes = changes_of(self._capture, begun.get("files", {}), images_of(self._camera_file, self._capture))
            told += [f"images {change}" for change in changes.values()]
        if told:
            begun_as = f"{folder} was begun with other settings ({'; '.join(told)})"
            raise InputError(f"{begun_as}; give another --output or delete it.")
        self._settings = begun | asked

    def _note(self, **settings: Any) -> None:
        self._settings |= settings
        write_json(self.folder / "settings.json", self._settings)

    @property
    def _run(self) -> Path:
        return self._runs / self._settings.get("run", "run")

    def _checkpoint(self) -> Path | None:
        return max(self._run.glob("nerfstudio_models/step-*.ckpt"), default=None)

    def make(self) -> list[Path]:
        """Do the stages that are not done yet, and return the splats; `exit_code` knows all errors of this."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise WriteError(self.folder, error) from error
        # A stage has the lock, too, and keeps it until it has saved where this process was killed.
        refusal = f"another sadgs works in {self.folder}; wait for it, or stop it."
        with locked(self.folder, refusal, _LOCK_SECONDS) as self._lock, contextlib.ExitStack() as self._workers:
            self._read_settings()  # Another run may have gone on meanwhile.
            if "views" in self._settings and not (self._scene / "transforms.json").exists():  # Somebody deleted it.
                self._settings |= {"views": None, "trained": None, "run": f"run-{int(time.time())}"}
            self._note()
            # Meanwhile it imports what training needs.
            self._trainer = self.worker("training", _TRAINING) if self._added or not self._trained() else None
            for name, stage in STAGES.items():
                self.timeline.begin(*_FIRST_PARTS.get(name, (name, name)))
                with StatusLine(name, self.console) as line:
                    try:
                        line.update(stage(self, line))
                    except KeyboardInterrupt:
                        line.update("stopping")
                        raise
            for other in self._runs.glob("run*"):
                if other != self._run and re.fullmatch(r"run(-\d+)?", other.name):
                    shutil.rmtree(other)
            return [self.folder / f"splat.{name}" for name in self._formats]

    def _views(self) -> list[str]:
        """Return the scene's images in the order in which nerfstudio divides them."""
        described = json.loads((self._scene / "transforms.json").read_bytes())
        return sorted((frame["file_path"] for frame in described["frames"]), key=Path)

    def _choose_run(self) -> None:
        """Begin another run if photos were added since the present one began."""
        views, before = self._views(), self._settings.get("views")
        if views == before:
            return
        if before:
            self._keep_frame_and_split(before)
        begun = bool(before and self._checkpoint())
        self._note(views=views, **({"run": f"run-{len(views)}", "trained": None} if begun else {}))

    def _keep_frame_and_split(self, before: Sequence[str]) -> None:
        """Write into the scene how the present run moved its images, `before`, and which of them it held out.

        The added photos are divided as nerfstudio would, unless an option divides them. Without a run nothing is kept.
        """
        from nerfstudio.data.utils.dataparsers_utils import get_train_eval_split_fraction

        file = self._scene / "transforms.json"
        described = json.loads(file.read_bytes())
        if FRAME_KEYS[0] not in described:
            if not self._checkpoint():
                return
            moved = json.loads((self._run / TRANSFORMS_NAME).read_bytes())
            described |= dict(zip(FRAME_KEYS, (moved["transform"], moved["scale"]), strict=True))
        if not any(re.match("--(eval|train|test)", option) for option in self.train_options):
            trained, held_out = described.get("train_filenames", []), described.get("test_filenames", [])
            known = {*trained, *held_out}
            for names in (before, self._views()):
                new = [name for name in names if name not in known]
                for_training, for_tests = get_train_eval_split_fraction(new, 0.9)
                trained, held_out = trained + [new[i] for i in for_training], held_out + [new[i] for i in for_tests]
                known.update(new)
            described |= {"train_filenames": trained, "val_filenames": held_out, "test_filenames": held_out}
        write_json(file, described)

    def worker(self, stage: str, function: str) -> Worker:
        """Start a process that imports `function`, as `module:name`, and prints into the log of the stage."""
        worker = Worker(function, self.folder / "log" / f"{stage}.txt", [self._lock], saves=True)
        return self._workers.enter_context(worker)

    def call(self, worker: Worker, line: StatusLine, on_event: OnEvent, command: Sequence[str], *arguments: Any) -> Any:
        """Call a worker's function as `Worker.run` does, and name the log where it fails."""

        def listen(event: str, **fields: Any) -> None:
            self.timeline.follow(event, **fields)
            line.update(event) if event == "stopping" else on_event(event, **fields)

        try:
            return worker.run(*arguments, on_event=listen, command=command)
        except (InputError, WorkerError) as error:
            line.update("failed")
            problem = f"{worker.log.stem}: {str(error).rstrip('.')}. All that it printed is in {worker.log}"
            if isinstance(error, InputError) or error.exitcode == 2:
                raise InputError(f"{problem}.") from None
            raise RunError(f"{problem}; run the same command again to resume.") from None

    def _find_cameras(self, line: StatusLine) -> str:
        if self._camera_file:
            return f"those of {self._camera_file}; --cameras new finds others"
        with contextlib.suppress(InputError):  # It is about another folder.
            if self.source.name.startswith("images") and (other := find_cameras(self.source.parent)):
                line.print(f"{other} is not used: `sadgs {shlex.quote(str(self.source.parent))}` takes these cameras.")
        if (few := self._settings.get("few")) and (self.options.anyway or self._checkpoint()) and not self._added:
            return f"{few}; done before"
        added, done_before = "", ""

        def on_event(event: str, **fields: Any) -> None:
            nonlocal added, done_before
            if event == "added":
                added = f"{fields['photos']}: "
            elif event in ("panoramas", "aside"):
                line.print(fields["told"])
            elif event == "unchanged":
                done_before = "; done before"
            elif event == "progress":
                line.update(f"{added}{fields['stage']} {fields['done']} of {fields['total']}")

        worker = self.worker("cameras", "sadgs_ns.cli.process:process")
        source = os.path.abspath(self.source)
        command = ["sadgs-process", source, str(self._scene), "--max-size", str(self.options.max_size)]
        summary = Summary(**self.call(worker, line, on_event, command, self._process))
        again = " after a second attempt" if summary.attempts else ""
        found = f"{added}{summary.registered} of {summary.photos} photos registered{again}"
        self._settings.pop("few", None)
        if summary.is_poor:
            self._note(few=found)
            if not self.options.anyway:
                line.update(found)
                command += ["--matching", "exhaustive"]
                again = f"or compare more pairs of them with `{shlex.join(command)}`, and run this command again; "
                raise RunError(
                    f"only {found}, so the splat would show only what these saw: take more photos between the others, "
                    "with two thirds of overlap, and begin another --output; "
                    f"{again * (summary.matching != 'exhaustive')}or go on with these with --anyway."
                )
        missing = "" if summary.registered == summary.photos else ", log/cameras.txt tells of the others"
        return found + missing + done_before

    def _trained(self) -> str | None:
        """Return the sentence of a finished training."""
        return self._settings.get("trained") if self._checkpoint() else None

    def _train(self, line: StatusLine) -> str:
        if not self._camera_file:  # These are those that the folder was begun with.
            self._choose_run()
        if trained := self._trained():
            return f"{trained}; done before"
        total, count = "", ""

        def on_event(event: str, **fields: Any) -> None:
            nonlocal total, count
            if event == "training begins":
                total = f"{fields['iterations']:,}"
            elif event == "warning":
                line.print(with_dashes(fields["told"], self.train_options))
            elif event == "iteration":
                # Meanwhile it imports what export needs.
                self._exporter = self._exporter or self.worker("export", _EXPORT)
                left = f", about {fields['left']} left" if fields["left"] else ""
                line.update(f"iteration {fields['step']:,} of {total}{left}")
            elif event == "progress":
                line.update(f"{fields['stage']} {fields['done']} of {fields['total']}")
            elif event == "training ends":
                count = f"{fields['gaussians']:,}"

        begun = bool(self._checkpoint())
        self._note(trained=None)  # The folder of an earlier run may have been deleted.
        line.update("going on" if begun else "starting")
        if self._camera_file and not begun:
            self._note(files=photo_stamps(self._capture, images_of(self._camera_file, self._capture)))
        command = ["ns-train", "sadgs", "--data", os.path.abspath(self._data)]
        command += ["--output-dir", str(self.folder.absolute()), "--experiment-name", "training"]
        measures = any(re.match("--steps[-_]per[-_]eval", option) for option in self.train_options)
        command += ["--timestamp", self._run.name, "--vis", "tensorboard" if measures else "none"]  # for the measures
        command += ["--steps-per-eval-image", "0", "--pipeline.effort", f"{self.options.effort:g}"]
        command += ["--load-dir", str(self._run.absolute())] if begun else []
        worker = self._trainer or self.worker("training", _TRAINING)
        self.call(worker, line, on_event, [*command, *self.train_options])
        if not self._checkpoint():
            raise RunError(f"training ended without a checkpoint; all that it printed is in {self.folder}/log.")
        told = f"{total} iterations, {count} Gaussians"
        self._note(trained=told)
        return told

    def _export(self, line: StatusLine) -> str:
        checkpoint, jobs, told = self._checkpoint(), [], []
        outputs = {name: self.folder / f"splat.{name}" for name in (*self._formats, *FORMAT_NAMES)}
        for name, output in outputs.items():
            if checkpoint and output.is_file() and output.stat().st_mtime >= checkpoint.stat().st_mtime:
                told += [f"{output}; done before"] if name in self._formats else []
            elif name in self._formats:  # The folder may have been renamed since config.yml noted where the scene is.
                jobs.append(Export(self._run, output, data=self._data))
            elif output.is_file():
                line.print(f"{output} is of an earlier splat: delete it, or make it anew with --formats {name}.")

        def on_event(event: str, output: str) -> None:
            if event == "export begins":
                while told:
                    line.finish(told.pop(0))
                line.update(output)
                self.timeline.begin("export", Path(output).name.removeprefix("splat."))
            elif event == "export ends":
                told.append(f"{output}, {Path(output).stat().st_size / 1e6:,.1f} MB")

        if jobs:
            line.update("starting")
            self.call(self._exporter or self.worker("export", _EXPORT), line, on_event, [], jobs)
        *others, last = told
        for sentence in others:
            line.finish(sentence)
        return last


STAGES: dict[str, Callable[[PhotosToSplat, StatusLine], str]] = {
    "cameras": PhotosToSplat._find_cameras,
    "training": PhotosToSplat._train,
    "export": PhotosToSplat._export,
}
"""The stages in their order, by the names of their lines. A stage sees by what lies in `folder` whether it was done
before, updates its line, and returns the line's last sentence. It may raise InputError and RunError."""


def _shown(value: Any) -> str:
    return (shlex.join(value) or "none") if isinstance(value, list) else str(value)


def main(argv: Sequence[str] | None = None) -> int:
    """Make a splat and return the exit code, as `exit_code` says."""
    words, console, start = list(sys.argv[1:] if argv is None else argv), Console(highlight=False), time.monotonic()
    end = words.index("--") if "--" in words else len(words)
    train_options = words[end + 1 :]
    if not {"-h", "--help"}.isdisjoint(train_options):
        from sadgs_ns.training.run.start import read_options  # It imports torch.

        read_options(train_options)  # It prints the help and exits.
    options = parse(Sadgs, "sadgs", words[:end])
    redirect_on_broken_pipe(console)

    def run() -> int:
        with Interrupts(waiting=lambda: True):
            work = PhotosToSplat(options, train_options, console)
            made = work.make()
        page = next((path for path in made if path.suffix == ".html"), None)
        shown = f"Open {page.resolve().as_uri()}" if page else f"The splat is {made[0]}."
        if options.profile:
            print(work.timeline.table())
        print(f"{'of it':<19}{work.timeline}")
        print(f"{'in all':<9}{clock(time.monotonic() - start):>8}  {shown}")
        return 0

    return exit_code("sadgs", options.output, run)
