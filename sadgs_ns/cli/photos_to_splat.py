"""`sadgs PHOTOS_OR_VIDEO`: one command from photos or a video to a splat that opens in a browser.

Its folder holds the cameras in `scene`, the run in `training`, all that was printed in `log`, the splats, and
`settings.json`, by which the command knows the folder again and what of it is done.

Where photos were added since, their cameras are added to the scene, whose other cameras stay, and another run is
trained, in the frame of the one before, which is removed when the splats of the new one are written.
"""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import json
import math
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rich.console import Console

from sadgs_ns.atomic import atomic_path
from sadgs_ns.cli.process.command import MIN_SIZE, photos_added
from sadgs_ns.cli.process.photos import find_photos
from sadgs_ns.cli.process.video import VIDEO_SUFFIXES
from sadgs_ns.cli.stage import Line, clock, prepared, run_stage
from sadgs_ns.data.coordinates import FRAME_KEYS, TRANSFORMS_NAME
from sadgs_ns.errors import InputError, RunError, WriteError, free_space, reason
from sadgs_ns.formats import FORMATS, MESH
from sadgs_ns.plugin.interrupts import Interrupted, Interrupts
from sadgs_ns.plugin.lost_output import print_elsewhere_once_unread

_OURS = ("data", "output-dir", "experiment-name", "timestamp", "vis", "load-dir", "load-checkpoint", "load-config")
"""Options of ns-train that this command sets."""
_CAMERAS, _TRAINING, _EXPORT = "sadgs_ns.cli.process.command", "nerfstudio.scripts.train", "sadgs_ns.cli.export"
"""The stages' modules."""
_LOCK_SECONDS = 10.0
"""Time that a killed run's last stage is given to save."""
_STEP = re.compile(r"^(\S.*) (\d+)/(\d+)$")
_ROUGHLY = re.compile(r" pairs to match: (roughly .*) on \d+ processor")
_ADDED = re.compile(r"^(\d+ photos? added to \d+)\.$")
_REGISTERED = re.compile(r"^(\d+) of (\d+) photos registered")
_CHOSEN = re.compile(r" training views of .*: ([\d,]+) iterations of \d+ view")
_ROW = re.compile(r"^(\d+) \(\d+\.\d+%\)")
_COUNT = re.compile(r"^What can be done with these ([\d,]+) Gaussians")
_EXPORTED = re.compile(r": [\d,]+ Gaussians, ([\d.,]+ MB), in the frame of")
"""What the stages print of how far they are."""
_ON_CPU = (
    "torch finds no GPU on this machine, so training runs on the CPU, which is for small scenes: a GPU with CUDA is "
    "about a hundred times as fast."
)


@dataclass
class PhotosToSplat:
    """One run of the command; `make` does all of it.

    Raises:
        InputError: If the source, the folder or an option cannot be used; nothing is written then.
    """

    source: Path
    """A folder of photos, or a video."""
    folder: Path
    """What is made lies here. It is made if it does not exist, and what an earlier run did in it stays."""
    interrupts: Interrupts
    """Polled between what can be stopped."""
    effort: float = 1.0
    """As `pipeline.effort`, > 0."""
    max_size: int = 1600
    """Longest side of the photos in training in px; 0 keeps them as they are."""
    formats: Sequence[str] = ("ply",)
    """Ends of the splats' names without their first point; a page is made last."""
    anyway: bool = False
    """Whether to go on where fewer than half of the photos registered."""
    options: Sequence[str] = ()
    """More options for ns-train."""
    console: Console = field(default_factory=Console)
    """Where the stages' lines are printed."""

    def __post_init__(self) -> None:
        self._scene, self._settings_file = self.folder / "scene", self.folder / "settings.json"
        self._runs = self.folder / "training" / "sadgs"
        self._settings: dict[str, Any] = {}
        self._asked: dict[str, Any] = {"source": os.path.realpath(self.source), "--max-size": self.max_size}
        self._asked |= {"--effort": self.effort, "options of ns-train": list(self.options)}
        for option in self.options:
            name = option.partition("=")[0].lstrip("-").replace("_", "-")
            if option.startswith("--") and name in _OURS:
                raise InputError(f"--{name} is set by sadgs itself: leave it out, or use ns-train.")
        self._settings = self._read_settings()
        self._check_source()

    def _check_source(self) -> None:
        for path in (self.source, self.folder):
            if not str(path).isprintable():
                raise InputError(f"{str(path)!a} has unprintable characters in its name: rename it.")
        if self.source.is_file():
            if self.source.suffix.lower() not in VIDEO_SUFFIXES:
                kinds = ", ".join(sorted(VIDEO_SUFFIXES))
                raise InputError(f"{self.source} is neither a folder of photos nor a video ({kinds}).")
        else:
            find_photos(self.source, self._scene)

    def _read_settings(self) -> dict[str, Any]:
        """Return the settings that the folder was begun with, with what is not decided yet as it is asked for now.

        Raises:
            InputError: If they are others than those asked for, or the folder is something else.
        """
        folder, file = self.folder, self._settings_file
        if not file.exists():
            if folder.is_file() or (folder.is_dir() and any(folder.iterdir())):
                raise InputError(f"{folder} exists and is not a folder that sadgs began; give another --output.")
            return dict(self._asked)
        try:
            begun = dict(json.loads(file.read_text("utf8")))
        except ValueError as error:
            raise InputError(f"{file} is damaged ({reason(error)}): delete {folder} and begin again.") from error
        self._settings = begun
        decided = ["source"]
        decided += ["--max-size"] if (self._scene / "transforms.json").exists() else []
        decided += ["--effort", "options of ns-train"] if self._checkpoint() else []
        changes = [
            f"{name} was {_shown(begun.get(name))}, is {_shown(self._asked[name])}"
            for name in decided
            if begun.get(name) != self._asked[name]
        ]
        if changes:
            raise InputError(
                f"{folder} was begun with other settings ({'; '.join(changes)}); give another --output or delete it."
            )
        return begun | self._asked

    def _note(self, **settings: Any) -> None:
        self._settings |= settings
        with atomic_path(self._settings_file) as partial:
            partial.write_text(json.dumps(self._settings), "utf8")

    @property
    def _run(self) -> Path:
        """The present run's folder."""
        return self._runs / self._settings.get("run", "run")

    def _checkpoint(self) -> Path | None:
        """Return the run's latest checkpoint, if it has any."""
        return max(self._run.glob("nerfstudio_models/step-*.ckpt"), default=None)

    def make(self) -> list[Path]:
        """Do what is not done yet, and return the splats.

        Raises:
            InputError: If a stage cannot use what it is given.
            Interrupted: If a signal came; what the stages did is saved.
            OSError: If a file cannot be written.
            RunError: If a stage fails, or few photos registered.
        """
        with self._alone() as lock:
            self._lock, self._settings = lock, self._read_settings()  # Another run may have gone on meanwhile.
            self._note()
            with contextlib.ExitStack() as stack:
                training = None
                # Importing nerfstudio takes some 12 s, in which cameras can be found.
                if not self._trained() or self._photos_added():
                    training = stack.enter_context(prepared(_TRAINING, self._log("training"), lock))
                self._make_cameras()
                self._choose_run()
                self._train(training)
            made = [self._export(name) for name in sorted(self.formats, key=lambda name: name == "html")]
            for other in self._runs.glob("run*"):
                if other != self._run and re.fullmatch(r"run(-\d+)?", other.name):
                    shutil.rmtree(other)
            return made

    def _photos_added(self) -> bool:
        """Whether photos were added since the cameras were found."""
        return bool(photos_added(self.source, self._scene))

    def _views(self) -> list[str]:
        """Return the scene's images, in the order in which nerfstudio chooses those that it holds out."""
        described = json.loads((self._scene / "transforms.json").read_bytes())
        return sorted((frame["file_path"] for frame in described["frames"]), key=Path)

    def _choose_run(self) -> None:
        """Begin another run where photos were added since the present one began."""
        views, before = self._views(), self._settings.get("views")
        if views == before:
            return
        if before:
            self._keep_frame_and_split(before)
        begun = bool(before and self._checkpoint())
        self._note(views=views, **({"run": f"run-{len(views)}", "trained": None} if begun else {}))

    def _keep_frame_and_split(self, before: Sequence[str]) -> None:
        """Note in the scene how the first run moved the data, and that what it held out is held out again.

        Of the photos that were added as many are held out as nerfstudio would. Where an option says which views are
        held out, that option decides. Before a run has begun there is nothing to keep.

        Args:
            before: The images of the present run.
        """
        from nerfstudio.data.utils.dataparsers_utils import get_train_eval_split_fraction

        file = self._scene / "transforms.json"
        described = json.loads(file.read_bytes())
        if FRAME_KEYS[0] not in described:
            if not self._checkpoint():
                return
            moved = json.loads((self._run / TRANSFORMS_NAME).read_bytes())
            described |= dict(zip(FRAME_KEYS, (moved["transform"], moved["scale"]), strict=True))
        if not any(re.match("--(eval|train|test)", option) for option in self.options):
            trained, held_out = described.get("train_filenames", []), described.get("test_filenames", [])
            known = {*trained, *held_out}
            for names in (before, self._views()):
                new = [name for name in names if name not in known]
                for_training, for_tests = get_train_eval_split_fraction(new, 0.9)
                trained, held_out = trained + [new[i] for i in for_training], held_out + [new[i] for i in for_tests]
                known.update(new)
            described |= {"train_filenames": trained, "val_filenames": held_out, "test_filenames": held_out}
        with atomic_path(file) as partial:
            partial.write_text(json.dumps(described), "utf8")

    @contextlib.contextmanager
    def _alone(self) -> Iterator[int]:
        """Keep other runs away from the folder, as long as this one or a stage of it lives.

        Raises:
            InputError: If another run works there.
            WriteError: If the folder cannot be made.
        """
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise WriteError(self.folder, error) from error
        lock, end = os.open(self.folder, os.O_RDONLY), time.monotonic() + _LOCK_SECONDS
        try:
            while True:
                try:
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    break
                except BlockingIOError as error:
                    if time.monotonic() > end:
                        raise InputError(f"another sadgs works in {self.folder}; wait for it, or stop it.") from error
                    self.interrupts.poll()
                    time.sleep(0.2)
            yield lock
        finally:
            os.close(lock)

    def _log(self, stage: str) -> Path:
        return self.folder / "log" / f"{stage}.txt"

    def _stage(
        self,
        line: Line,
        log: str,
        module: str,
        arguments: Sequence[str],
        hear: Callable[[str], None],
        process: subprocess.Popen[bytes] | None = None,
    ) -> None:
        """Run a stage to its end, and raise as `make` does."""
        path = self._log(log)
        code, sentence = run_stage(module, arguments, path, line, hear, self.interrupts, self._lock, process)
        if code == 0:
            return
        line.tell("failed")
        told = f"{log}: {sentence}. All that it printed is in {path}"
        raise InputError(f"{told}.") if code == 2 else RunError(f"{told}, and the same command goes on.")

    def _make_cameras(self) -> None:
        added, found, others, roughly, finished, more_pairs = "", "", "", "", False, False

        def hear(printed: str) -> None:
            nonlocal added, found, others, roughly, finished, more_pairs
            if more := _ADDED.match(printed):
                added = f"{more[1]}: "
            elif step := _STEP.match(printed):
                line.tell(f"{added}{step[1]} {step[2]} of {step[3]}{roughly}")
            elif duration := _ROUGHLY.search(printed):
                roughly = f" ({duration[1]} in all)"
            elif registered := _REGISTERED.match(printed):
                found = added + registered[0]
                others = "" if registered[1] == registered[2] else ", log/cameras.txt tells of the others"
            finished |= printed.endswith(" is finished; delete it to make it again.")
            more_pairs |= printed.startswith("warning: ") and " --matching exhaustive" in printed

        with Line("cameras", self.console) as line:
            done = self.anyway or self._checkpoint()
            if self._settings.get("few") and done and not self._photos_added():
                line.tell(f"{self._settings['few']}; done before")
                return
            arguments = [os.path.abspath(self.source), str(self._scene), "--max-size", str(self.max_size)]
            try:
                self._stage(line, "cameras", _CAMERAS, arguments, hear)
            except RunError:
                if not (found and (self._scene / "transforms.json").exists()):
                    raise
                self._note(few=found)
                line.tell(found)
                if not self.anyway:
                    raise self._few_registered(more_pairs) from None
            else:
                self._settings.pop("few", None)
            line.tell(found + others + "; done before" * finished)

    def _few_registered(self, more_pairs: bool) -> RunError:
        command = shlex.join(["sadgs-process", str(self.source), str(self._scene), "--matching", "exhaustive"])
        again = f"or compare more pairs of them with `{command}`, and give the same command again; " * more_pairs
        return RunError(
            f"only {self._settings['few']}, so the splat would show only what these saw: take more photos between the "
            f"others, with two thirds of overlap, and begin another --output; {again}or go on with these with --anyway."
        )

    def _trained(self) -> str | None:
        """Return what a finished training said of itself."""
        return self._settings.get("trained") if self._checkpoint() else None

    def _train(self, process: subprocess.Popen[bytes] | None) -> None:
        """Train in a process that has been prepared for it, if there is one."""
        total, count = "", ""

        def hear(printed: str) -> None:
            nonlocal total, count
            if printed.startswith("This run trains on the CPU"):
                line.say(_ON_CPU)
            elif chosen := _CHOSEN.search(printed):
                total = chosen[1]
            elif row := _ROW.match(printed):
                cells = re.split(r" {2,}", printed)
                left = f", about {cells[-1]} left" if len(cells) == 6 else ""
                line.tell(f"iteration {int(row[1]):,} of {total}{left}")
            elif gaussians := _COUNT.match(printed):
                count = gaussians[1]

        with Line("training", self.console) as line:
            if trained := self._trained():
                line.tell(f"{trained}; done before")
                return
            begun = bool(self._checkpoint())
            line.tell("going on" if begun else "starting")
            arguments = ["sadgs", "--data", str(self._scene.absolute()), "--output-dir", str(self.folder.absolute())]
            arguments += ["--experiment-name", "training", "--timestamp", self._run.name, "--vis", "tensorboard"]
            arguments += ["--steps-per-eval-image", "0", "--pipeline.effort", f"{self.effort:g}"]
            arguments += ["--load-dir", str(self._run.absolute())] if begun else []
            self._stage(line, "training", _TRAINING, [*arguments, *self.options], hear, process)
            if not self._checkpoint():
                raise RunError(f"training ended without a checkpoint; all that it printed is in {self.folder}/log.")
            told = f"{total} iterations, {count} Gaussians"
            self._note(trained=told)
            line.tell(told)

    def _export(self, name: str) -> Path:
        output, checkpoint, size = self.folder / f"splat.{name}", self._checkpoint(), ""

        def hear(printed: str) -> None:
            nonlocal size
            if exported := _EXPORTED.search(printed):
                size = exported[1]

        with Line("export", self.console) as line:
            if checkpoint and output.is_file() and output.stat().st_mtime >= checkpoint.stat().st_mtime:
                line.tell(f"{output}; done before")
                return output
            line.tell(str(output))
            self._stage(line, "export", _EXPORT, [str(self._run), "--output", str(output)], hear)
            line.tell(f"{output}, {size}")
        return output


def _default_folder(source: Path) -> Path:
    """Return the folder that is named after the photos or the video, in the working directory."""
    source = Path(os.path.realpath(source))
    return Path(f"{(source.name if source.is_dir() else source.stem) or 'photos'}-splat")


def _shown(value: Any) -> str:
    return (shlex.join(value) or "none") if isinstance(value, list) else str(value)


def _parse(argv: Sequence[str]) -> argparse.Namespace:
    """Return the options, of which `options` are those for ns-train; exit with code 2 if one is wrong."""
    formats = [suffix[1:] for suffix in (*FORMATS, MESH)]
    known = ", ".join(formats)
    parser = argparse.ArgumentParser(
        prog="sadgs",
        description="From photos or a video to a splat that opens in a browser: cameras (sadgs-process), training "
        "(ns-train sadgs) and export (sadgs-export), each of which also is a command of its own. The same command goes "
        "on where an earlier one stopped, and does nothing twice.",
        epilog="What follows after -- goes to ns-train as it is, as in `sadgs photos -- --max-num-iterations 500`.",
    )
    parser.add_argument("source", type=Path, metavar="PHOTOS_OR_VIDEO", help="folder of photos, or a video")
    parser.add_argument(
        "--output", "-o", type=Path, metavar="FOLDER",
        help="folder for all that is made (default: the source's name and -splat, in the working directory)",
    )  # fmt: skip
    parser.add_argument(
        "--effort", type=float, default=1.0, metavar="X",
        help="how much training: 0.5 is a draft, 2 resolves more (default %(default)g)",
    )  # fmt: skip
    parser.add_argument(
        "--max-size", type=int, default=1600, metavar="PX",
        help=f"longest side of the photos, at least {MIN_SIZE}, 0 to keep it (default %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--formats", metavar="A,B", help=f"what is exported, of {known} (default html,ply; ply where Node.js is not)"
    )
    parser.add_argument("--anyway", action="store_true", help="go on where fewer than half of the photos registered")
    words = list(argv)
    end = words.index("--") if "--" in words else len(words)
    given = parser.parse_args(words[:end])
    given.options = words[end + 1 :]
    if not 0 < given.effort < math.inf:
        parser.error("--effort must be more than 0")
    if given.max_size != 0 and given.max_size < MIN_SIZE:
        parser.error(f"--max-size must be at least {MIN_SIZE} px, or 0 to keep the photos' size")
    if given.formats is not None:
        given.formats = list(dict.fromkeys(given.formats.split(",")))
        if unknown := [name for name in given.formats if name not in formats]:
            parser.error(f"--formats knows {known}, and not {unknown[0]!r}")
    return given


def _formats(asked: list[str] | None, console: Console) -> list[str]:
    """Return the formats to export.

    Raises:
        InputError: If a page is asked for and Node.js is not there.
    """
    has_node = shutil.which("npx") is not None
    if asked is None:
        if not has_node:
            console.print("Node.js (22 or newer) is not installed, without which no page is made: a PLY is.")
        return ["html", "ply"] if has_node else ["ply"]
    if "html" in asked and not has_node:
        raise InputError("a page is made with the help of Node.js: install version 22 or newer, or leave html out.")
    return asked


def main(argv: Sequence[str] | None = None) -> int:
    """Make a splat and return the exit code.

    It is 0 when all is done, 1 where a stage failed, fewer than half of the photos registered or a file could not be
    written, 2 if the input is wrong, and 130, 143 or 129 after SIGINT, SIGTERM or SIGHUP.
    """
    given, console, start = _parse(sys.argv[1:] if argv is None else argv), Console(highlight=False), time.monotonic()
    print_elsewhere_once_unread(console)
    folder: Path | None = given.output
    try:
        folder = folder or _default_folder(given.source)
        with Interrupts(waiting=lambda: False) as interrupts:
            formats = _formats(given.formats, console)
            work = PhotosToSplat(
                given.source, folder, interrupts, given.effort, given.max_size, formats, given.anyway, given.options,
                console,
            )  # fmt: skip
            made = work.make()
    except InputError as error:
        print(f"sadgs: {error}", file=sys.stderr)
        return 2
    except (OSError, RunError) as error:
        told = str(error)
        if isinstance(error, OSError) and not isinstance(error, WriteError) and folder is not None:
            where = error.filename or folder
            told = f"{where}: {reason(error)} ({free_space(folder)} free there); the same command goes on."
        print(f"sadgs: {told}", file=sys.stderr)
        return 1
    except KeyboardInterrupt as stopped:
        print("sadgs: stopped; the same command goes on.", file=sys.stderr)
        return 128 + (stopped.number if isinstance(stopped, Interrupted) else signal.SIGINT)
    page = next((path for path in made if path.suffix == ".html"), None)
    shown = f"Open {page.resolve().as_uri()}" if page else f"The splat is {made[0]}."
    print(f"{'in all':<9}{clock(time.monotonic() - start):>8}  {shown}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
