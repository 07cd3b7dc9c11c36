"""The folder of a scene: what it was begun with, its lock, and what an interrupted run left in it."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator
from typing import Any

from sadgs_ns.errors import InputError
from sadgs_ns.files import locked, read_settings, write_json
from sadgs_ns.placing.folder import find_source
from sadgs_ns.placing.options import PlacingOptions
from sadgs_ns.placing.stamps import changes_of

_UNFINISHED = ("frames.partial", "photos.partial", "model.partial", "models", "undistorted")  # Made anew by each run


class Scene:
    """A scene's folder and the options for it; raises InputError if the scene was begun with others."""

    def __init__(self, options: PlacingOptions) -> None:
        self.options, self.work = options, options.out / "work"
        self.settings_file = self.work / "settings.json"
        out, source = options.out, options.source
        if out.is_file() or (not self.settings_file.exists() and any(not path.is_dir() for path in out.rglob("*"))):
            raise InputError(f"{out} exists and is not a scene that sadgs-process began; give another folder.")
        photos, self.is_video, self.masks, self.left_out = find_source(source, out)
        self.settings: dict[str, Any] = {"source": os.path.realpath(source), "photos": photos}
        self.settings["camera_per_photo"] = options.camera_per_photo
        if self.is_video:
            self.settings["frames"] = options.frames
        self.begun = read_settings(self.settings_file, out)
        self.finished = self.begun.get("finished") if (out / "transforms.json").exists() else None
        if self.begun:
            self._check_unchanged()
        self.added, self.base, self.model = 0, None, self.work / "model"
        if self.finished:
            self.added, self.model = len({*photos} - {*self.begun.get("photos", [])}), self.work / self.begun["model"]
        if self.added:
            self.base, self.model = self.model, self.work / f"model-{len(photos)}"
            if not (self.base.exists() and (self.work / "database.db").exists()):
                problem = f"{self.work} no longer holds the features and the model that photos could be added to"
                raise InputError(f"{problem}: give another folder or delete it.")

    def _check_unchanged(self) -> None:
        asked: dict[str, Any] = self.settings | ({"max_size": self.options.max_size} if self.finished else {})
        told, back, kind, names = [], "", "videos" if self.is_video else "photos", ["source"]
        source = self.options.source
        if self.begun.get("source") == asked["source"]:  # With another source all the rest differs, too.
            files = [""] if source.is_file() else asked["photos"]
            if self.finished and not self.is_video:  # Others may be added, with their masks.
                files = [name for name in files if name in self.begun["photos"]]
                files += [self.masks[name] for name in files if name in self.masks]
            changes = changes_of(source, self.begun.get("files", {}), files)
            told = [f"{kind} {change}" for change in changes.values()]
            back = "" if changes.keys() <= {"added"} else f"put these {kind} back, "
            names = [name for name in asked if name != "photos"]
        for name in (name for name in names if self.begun.get(name) != asked[name]):
            option = name if name == "source" else "--" + name.replace("_", "-")
            told.append(f"{option} was {self.begun.get(name)}, is {asked[name]}")
        if told:
            problem = f"{self.options.out} was begun with other photos or settings ({'; '.join(told)})"
            raise InputError(f"{problem}; {back}give another folder or delete it.")

    def note(self, **settings: Any) -> None:
        self.settings |= settings
        write_json(self.settings_file, self.settings)

    @contextlib.contextmanager
    def alone(self) -> Iterator[None]:
        """Lock the work folder, and leave nothing half-written there."""
        if not self.begun:
            self.note()
        with locked(self.work, f"another sadgs-process works on {self.options.out}; wait for it, or stop it."):
            try:
                yield
            finally:
                for name in _UNFINISHED:
                    shutil.rmtree(self.work / name, ignore_errors=True)
                (self.work / "pairs.txt").unlink(missing_ok=True)

    def remove_intermediate_files(self) -> None:
        """Remove the files that are not needed to add photos to the finished scene."""
        for path in {*self.work.iterdir()} - {self.model, self.work / "database.db", self.settings_file}:
            shutil.rmtree(path) if path.is_dir() else path.unlink()
