"""The folder of a scene: what it was begun with, its lock, and what an interrupted run left in it."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from sadgs_ns.errors import InputError
from sadgs_ns.files import locked, read_settings, write_json
from sadgs_ns.placing.folder import find_source
from sadgs_ns.placing.options import PlacingOptions
from sadgs_ns.placing.plan import Summary
from sadgs_ns.placing.stamps import changes_of

_UNFINISHED = ("frames.partial", "photos.partial", "model.partial", "models", "undistorted")  # Made anew by each run


@dataclasses.dataclass
class SceneSettings:
    """The content of settings.json in a scene's work folder; fields that are None are left out there."""

    source: str | None = None  # Path without links
    photos: list[str] = dataclasses.field(default_factory=list)  # or videos of a folder; a single video has no name
    camera_per_photo: bool | None = None
    frames: int | None = None  # None for photos
    files: dict[str, list[int]] = dataclasses.field(default_factory=dict)
    """Stamps, by `photo_stamps`, of the photos and masks, or videos."""
    has_noted_masks: bool = False
    """Whether `files` has the masks, too, in which features lie that were found; a finished scene always has them."""
    bit_depth: int | None = None
    """Bits that the values of photos of 16 bits use; None until there are such, or if an earlier version began it."""
    max_size: int | None = None  # None until the scene is finished, because until then it may change
    finished: dict[str, Any] | None = None  # The fields of the finished scene's `Summary`
    model: str = "model"  # Folder of the finished scene's model, in the work folder

    @classmethod
    def read(cls, file: Path, folder: Path) -> SceneSettings | None:
        """Read the settings of a scene's folder, None if it has none yet; raise InputError if they are damaged."""
        stored = read_settings(file, folder)
        if not stored:
            return None
        known = {field.name for field in dataclasses.fields(cls)}
        return cls(**{key: value for key, value in stored.items() if key in known})

    def write(self, file: Path) -> None:
        """Write the settings, so that they are complete or as they were before."""
        write_json(file, {key: value for key, value in vars(self).items() if value is not None})


class Scene:
    """A scene's folder and the options for it; raises InputError if the scene was begun with others.

    Attributes:
        options: Of the present run.
        work: The folder for files that are needed to resume, or to add photos later.
        is_video: Whether the source is a video or a folder of videos.
        masks: The name of each photo's mask, for photos that have one.
        left_out: Sentences on files of the source that are not used.
        settings: What the present run makes the scene of.
        begun: What an earlier run noted, or None.
        finished: The fields of the finished scene's `Summary`, or None.
        added: How many photos were added since the scene was finished.
        base: The folder of the model that photos are added to, or None.
        model: The folder for the scene's model.
    """

    def __init__(self, options: PlacingOptions) -> None:
        self.options = options
        self.work = options.out / "work"
        self._settings_file = self.work / "settings.json"
        self._check_folder()
        photos, self.is_video, self.masks, self.left_out = find_source(options.source, options.out)
        self.settings = SceneSettings(os.path.realpath(options.source), photos, options.camera_per_photo)
        if self.is_video:
            self.settings.frames = options.frames
        self.begun = SceneSettings.read(self._settings_file, options.out)
        self.finished: dict[str, Any] | None = None
        self.added = 0
        self.base: Path | None = None
        self.model = self.work / self.settings.model
        if self.begun is not None:
            if (options.out / "transforms.json").exists():
                self.finished = self.begun.finished
            self._check_unchanged(self.begun)
            if self.finished:
                self._find_model(self.begun)

    @property
    def has_masks(self) -> bool:
        """Whether the scene's images have masks."""
        return (self.options.out / "masks").exists()

    def _check_folder(self) -> None:
        """Raise InputError if the folder holds files and is no scene."""
        out = self.options.out
        if not out.is_file():
            if self._settings_file.exists():
                return
            if all(path.is_dir() for path in out.rglob("*")):
                return
        raise InputError(f"{out} exists and is not a scene that sadgs-process began; give another folder.")

    def _check_unchanged(self, begun: SceneSettings) -> None:
        """Raise InputError if the source or the settings differ from those that the scene was begun with."""
        remedy = ""
        if begun.source != self.settings.source:  # With another source all the rest differs, too.
            differences = [f"source was {begun.source}, is {self.settings.source}"]
        else:
            kind = "photos"
            if self.is_video:
                kind = "videos"
            elif begun.frames is not None:
                problem = f"{self.options.out} was begun with videos, beside which there are photos now"
                raise InputError(f"{problem}: move the photos to a folder of their own.")
            elif self.masks:
                kind = "photos or masks"
            changes = self._changed_files(begun)
            differences = [f"{kind} {change}" for change in changes.values()]
            differences += self._changed_options(begun)
            if "changed" in changes or "removed" in changes:
                remedy = f"put these {kind} back, "
        if differences:
            problem = f"{self.options.out} was begun with other photos or settings ({'; '.join(differences)})"
            raise InputError(f"{problem}; {remedy}give another folder or delete it.")

    def _changed_files(self, begun: SceneSettings) -> dict[str, str]:
        """Return the changes of photos and masks, or videos, as `changes_of` does."""
        source = self.options.source
        if source.is_file():
            return changes_of(source, begun.files, [""])
        photos = self.settings.photos
        if self.finished and not self.is_video:  # Others may be added, with their masks.
            photos = [name for name in photos if name in begun.photos]
        masks = []
        if self.finished or begun.has_noted_masks:
            masks = [self.masks[name] for name in photos if name in self.masks]
        stamps = begun.files
        has_unused_masks = self.finished and not self.is_video and not self.has_masks
        if has_unused_masks:  # Those of added photos, which may go.
            stamps = {name: stamp for name, stamp in stamps.items() if name in begun.photos or name in masks}
        return changes_of(source, stamps, photos + masks)

    def _changed_options(self, begun: SceneSettings) -> list[str]:
        """Return the options that differ, as parts of a sentence."""
        options: list[tuple[str, Any, Any]] = [
            ("--camera-per-photo", begun.camera_per_photo, self.settings.camera_per_photo)
        ]
        if self.is_video:
            options.append(("--frames", begun.frames, self.settings.frames))
        if self.finished:
            options.append(("--max-size", begun.max_size, self.options.max_size))
        return [f"{option} was {before}, is {now}" for option, before, now in options if before != now]

    def _find_model(self, begun: SceneSettings) -> None:
        """Find the finished scene's model, which is the base of another one if photos were added."""
        self.model = self.work / begun.model
        photos = self.settings.photos
        self.added = len(set(photos) - set(begun.photos))
        if self.added:
            self.base = self.model
            self.model = self.work / f"model-{len(photos)}"
            if not self.base.exists() or not (self.work / "database.db").exists():
                problem = f"{self.work} no longer holds the features and the model that photos could be added to"
                raise InputError(f"{problem}: give another folder or delete it.")

    @contextlib.contextmanager
    def lock(self) -> Iterator[None]:
        """Write a new scene's settings, then lock the work folder; nothing half-written is left there at the end."""
        if self.begun is None:
            self.settings.write(self._settings_file)
        with locked(self.work, f"another sadgs-process works on {self.options.out}; wait for it, or stop it."):
            try:
                yield
            finally:
                for name in _UNFINISHED:
                    shutil.rmtree(self.work / name, ignore_errors=True)
                (self.work / "pairs.txt").unlink(missing_ok=True)

    def note_masks(self) -> None:
        """Write, before features are found, that they are found in the present masks."""
        if self.finished is None:
            self.settings.has_noted_masks = True
            self.settings.write(self._settings_file)

    def finish(self, summary: Summary) -> None:
        """Write that the scene is finished, and remove the files that are not needed to add photos to it."""
        self.settings.max_size = self.options.max_size
        self.settings.finished = dataclasses.asdict(summary)
        self.settings.has_noted_masks = True
        self.settings.model = self.model.name
        self.settings.write(self._settings_file)
        self.remove_intermediate_files()

    def remove_intermediate_files(self) -> None:
        """Remove the files that are not needed to add photos to the finished scene."""
        kept = {self.model, self.work / "database.db", self._settings_file}
        for path in set(self.work.iterdir()) - kept:
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink()
