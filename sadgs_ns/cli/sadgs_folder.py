"""The folder of `sadgs`: the settings that it was begun with, how far the work is, and where its parts lie."""

from __future__ import annotations

import json
import os
import shlex
import time
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from sadgs_ns.cli.division import divides
from sadgs_ns.cli.given_cameras import GivenCameras
from sadgs_ns.cli.sadgs_options import FORMAT_NAMES
from sadgs_ns.errors import InputError
from sadgs_ns.files import read_settings, write_json

_CHECKPOINTS = "nerfstudio_models/step-*.ckpt"  # In a run's folder
_OPTION_NAMES = {
    "source": "source",
    "cameras": "--cameras",
    "max_size": "--max-size",
    "effort": "--effort",
    "train_options": "options of ns-train",
    "measure": "--measure",
}
"""Names of the settings that options decide, in sentences and as keys of settings.json; other keys are fields."""


@dataclass
class Settings:
    """The content of settings.json; fields that are None are left out there."""

    # What the options of the command decide
    source: str | None = None  # Path without links
    cameras: str | None = None  # "new", or the description of given cameras
    max_size: int | None = None
    effort: float | None = None
    train_options: list[str] | None = None
    measure: bool | None = None  # None if a given split, ns-train or an earlier version divides the views

    # How far the work is
    run: str = "run"  # The name of the present run's folder
    previous_run: str | None = None  # That of the run with other options on the same scene, which it follows
    views: list[str] | None = None  # The images of the scene for which the run was begun, in nerfstudio's order
    files: dict[str, list[int]] = field(default_factory=dict)  # Stamps of the images of given cameras
    exported: dict[str, str] = field(default_factory=dict)  # Run and checkpoint of the splat in each format
    trained: str | None = None  # The sentence of a finished training
    measured: list[str] | None = None  # The sentences on how well run and file show the held-out views
    few: str | None = None  # The sentence on the registered photos, if they are few or their cameras are wrong

    @classmethod
    def read(cls, file: Path, folder: Path) -> Settings | None:
        """Read the settings of a folder, None if it has none; raise InputError if they are damaged."""
        stored = read_settings(file, folder)
        if not stored:
            return None
        known = {}
        for settings_field in fields(cls):
            value = stored.get(_OPTION_NAMES.get(settings_field.name, settings_field.name))
            if value is not None:
                known[settings_field.name] = value
        return cls(**known)

    def write(self, file: Path) -> None:
        """Write the settings, so that they are complete or as they were before."""
        stored = {}
        for name, value in vars(self).items():
            if value is not None:
                stored[_OPTION_NAMES.get(name, name)] = value
        write_json(file, stored)


class SadgsFolder:
    """The folder of all results, and its settings.

    Attributes:
        path: The folder.
        scene: The folder of new cameras.
        runs: The folder of the runs.
        settings: What settings.json holds, or will hold when the work begins.
        retraining: The options that differ from those of the present run, which another run follows, as parts of a
            sentence; empty if that run goes on.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.scene = path / "scene"
        self.runs = path / "training" / "sadgs"
        self.settings = Settings()
        self.retraining: list[str] = []
        self._file = path / "settings.json"

    @property
    def run(self) -> Path:
        """The folder of the present run."""
        return self.runs / self.settings.run

    def read_settings(self, chosen: Settings, given: GivenCameras | None) -> None:
        """Read the settings that the folder was begun with, and replace those that another run can follow.

        Raise InputError if the others differ from those that the options have `chosen`, if images of given cameras
        changed since training began, if options of a training that was stopped differ, or if the folder is something
        else.
        """
        self.retraining = []
        begun = Settings.read(self._file, self.path)
        if begun is None:
            if self.path.is_file() or (self.path.is_dir() and any(self.path.iterdir())):
                raise InputError(f"{self.path} exists and is not a folder that sadgs began; give another --output.")
            self.settings = chosen
            return
        self.settings = begun
        has_run = begun.views is not None or self.checkpoint() is not None
        if begun.measure is None and has_run:  # An earlier version began it: its views stay divided as they are.
            chosen = replace(chosen, measure=None)
        if given is not None and begun.cameras is not None and given.is_described_by(begun.cameras):
            chosen = replace(chosen, cameras=begun.cameras)
        differences = self._differences(chosen)
        if given is not None and self.checkpoint():
            differences += given.changed_images(begun.files)
        if differences:
            problem = f"{self.path} was begun with other settings ({'; '.join(differences)})"
            raise InputError(f"{problem}; give another --output or delete it.")
        if self.checkpoint():
            self.retraining = self._named_differences(chosen, ["effort", "train_options"])
        if self.retraining and self.trained() is None:  # An option that was left out would cost an unfinished run.
            problem = f"training in {self.path} was stopped with other options ({'; '.join(self.retraining)})"
            remedy = f"give these to resume, or delete {self.runs} to train anew on the same cameras"
            raise InputError(f"{problem}; {remedy}.")
        self.settings = replace(begun, **{name: getattr(chosen, name) for name in _OPTION_NAMES})

    def _differences(self, chosen: Settings) -> list[str]:
        """Return the settings that differ and that something was made with, as parts of a sentence.

        Other options of training are not among them, unless they divide the views, which a scene notes once.
        """
        decided = ["source", "cameras"]
        if self.has_scene():
            decided.append("max_size")
        if self.checkpoint():
            decided.append("measure")
            if divides(self.settings.train_options or []) or divides(chosen.train_options or []):
                decided.append("train_options")
        return self._named_differences(chosen, decided)

    def _named_differences(self, chosen: Settings, names: list[str]) -> list[str]:
        """Return those of some settings that differ, as parts of a sentence."""
        differences = []
        for name in names:
            before = getattr(self.settings, name)
            now = getattr(chosen, name)
            if before != now:
                differences.append(f"{_OPTION_NAMES[name]} was {_shown(before)}, is {_shown(now)}")
        return differences

    def new_run_name(self, number: int) -> str:
        """Return a name for another run's folder, with this number or a larger one."""
        while (self.runs / f"run-{number}").exists():
            number += 1
        return f"run-{number}"

    def begin_another_run(self) -> str:
        """Begin a run with other options of training on the same scene, and return the sentence on it.

        The splats are moved to folders named after their runs first, so that they are kept also where the work ends
        before the settings are written.
        """
        sentence = f"Training begins anew on the same cameras ({'; '.join(self.retraining)})"
        moved_to = []
        for name in FORMAT_NAMES:
            splat = self.splat(name)
            if splat.is_file():
                run = _run_of(self.settings.exported.get(name, self.settings.run))
                kept = self.path / "earlier" / run
                kept.mkdir(parents=True, exist_ok=True)
                os.replace(splat, kept / splat.name)
                if kept not in moved_to:
                    moved_to.append(kept)
        if moved_to:
            sentence += f"; the earlier splat is kept in {' and '.join(map(str, moved_to))}"
        self.settings.exported = {}
        self.settings.previous_run = self.settings.run
        self.settings.run = self.new_run_name(int(time.time()))
        self.settings.trained = None
        self.settings.measured = None
        self.retraining = []
        return f"{sentence}."

    def write_settings(self) -> None:
        """Write settings.json."""
        self.settings.write(self._file)

    def has_scene(self) -> bool:
        """Return whether new cameras were found."""
        return (self.scene / "transforms.json").exists()

    def views(self) -> list[str]:
        """Return the scene's images in the order in which nerfstudio divides them."""
        described = json.loads((self.scene / "transforms.json").read_bytes())
        return sorted((frame["file_path"] for frame in described["frames"]), key=Path)

    def checkpoint(self) -> Path | None:
        """Return the last checkpoint of the present run."""
        return max(self.run.glob(_CHECKPOINTS), default=None)

    def last_run(self) -> Path | None:
        """Return the folder of the last run on this scene that saved a checkpoint, the present run's if it did."""
        for name in (self.settings.run, self.settings.previous_run):
            if name is not None and any((self.runs / name).glob(_CHECKPOINTS)):
                return self.runs / name
        return None

    def trained(self) -> str | None:
        """Return the sentence of a finished training, None if there is none or its checkpoint was deleted."""
        if self.checkpoint() is None:
            return None
        return self.settings.trained

    def splat(self, format_name: str) -> Path:
        """Return the file of the splat in a format."""
        return self.path / f"splat.{format_name}"

    def note_export(self, format_name: str) -> None:
        """Note that the splat in a format is of the last checkpoint."""
        checkpoint = self.checkpoint()
        assert checkpoint is not None, "there is one after training"
        self.settings.exported[format_name] = self._note_of(checkpoint)
        self.write_settings()

    def forget_exports_of_run(self) -> None:
        """Forget which splats are of the present run, which begins: its folder may have been deleted."""
        for name, note in list(self.settings.exported.items()):
            if _run_of(note) == self.settings.run:
                del self.settings.exported[name]

    def has_current_splat(self, format_name: str) -> bool:
        """Return whether a splat is of the last checkpoint, as was noted.

        Where nothing was noted, as by earlier versions, it is if it is not older than the checkpoint.
        """
        checkpoint = self.checkpoint()
        splat = self.splat(format_name)
        if checkpoint is None or not splat.is_file():
            return False
        noted = self.settings.exported.get(format_name)
        if noted is not None:
            return noted == self._note_of(checkpoint)
        return splat.stat().st_mtime >= checkpoint.stat().st_mtime

    def _note_of(self, checkpoint: Path) -> str:
        """Return what `exported` notes of a splat: the present run and its checkpoint."""
        return f"{self.settings.run}/{checkpoint.name}"


def _run_of(note: str) -> str:
    """Return the run in a note of `exported`."""
    return note.partition("/")[0]


def _shown(value: Any) -> str:
    if isinstance(value, list):
        return shlex.join(value) or "none"
    if isinstance(value, bool):
        return "given" if value else "not given"
    return str(value)
