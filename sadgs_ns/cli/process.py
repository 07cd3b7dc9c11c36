"""`sadgs-process PHOTOS_OR_VIDEO OUT`: from photos to a scene that `ns-train sadgs --data OUT` reads, with pycolmap.

OUT holds `images/`, `transforms.json`, `sparse_pc.ply` and COLMAP's model in `sparse/0`. `OUT/work` holds what an
interrupted run needs to go on, and of a finished scene what photos that are added later need.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import shlex
import shutil
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from sadgs_ns import events
from sadgs_ns.cli.program import exit_code, parse
from sadgs_ns.data.checks.layouts import poses_elsewhere
from sadgs_ns.data.coordinates import FRAME_KEYS
from sadgs_ns.errors import InputError, WriteError
from sadgs_ns.files import locked, read_settings, write_json
from sadgs_ns.interrupts import Interrupts
from sadgs_ns.placing.colmap import Report, make_model, start_colmap
from sadgs_ns.placing.folder import find_source, find_videos
from sadgs_ns.placing.panoramas import VIEWS
from sadgs_ns.placing.photos import (
    Photo,
    changes_of,
    convert_photos,
    empty_folder,
    photo_stamps,
    photos_by_camera,
    read_photos,
    restore_alpha,
    write_alpha,
    write_masks,
)
from sadgs_ns.placing.plan import Matching, Summary, choose_matching
from sadgs_ns.placing.video import video_frames, write_frames

MIN_SIZE = 64  # Least longest side of the result in px; no structure is left in smaller images
_SECONDS_PER_LINE = 1.0  # Least time between two lines of a stage's progress in a file
_KEPT_KEYS = (*FRAME_KEYS, "train_filenames", "val_filenames", "test_filenames")  # Kept when photos are added
_UNFINISHED = ("frames.partial", "photos.partial", "model.partial", "models", "undistorted")  # Made anew by each run


@dataclass
class Process:
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


class Scene:
    """A scene's folder and the options for it; raises InputError if the scene was begun with others."""

    def __init__(self, options: Process) -> None:
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


def process(options: Process) -> Summary:
    """Make a scene of photos or a video, and report its progress in print and as events.

    A run that was interrupted goes on. New photos are added to a finished scene, whose other cameras stay as they are.

    Raise InputError if the photos, the folder or the settings cannot be used, OSError if a file cannot be written,
    RunError if COLMAP fails, and Interrupted if a signal came: the work so far is kept.
    """
    with Interrupts(waiting=lambda: True):
        scene = Scene(options)
        if scene.finished and not scene.added:
            scene.remove_intermediate_files()
            _say("unchanged", f"{options.out} is finished; delete it to make it again.")
            summary = Summary(**scene.finished)
        else:
            if options.source.is_dir() and (poses := poses_elsewhere(options.source)):
                _say("aside", f"Poses are computed anew. {poses}")
            columns = (TextColumn("{task.description:>24}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
            with Progress(*columns, disable=not sys.stdout.isatty()) as progress:
                summary = _make(scene, _reporter(progress))
    print(summary)
    for sentence in scene.left_out:
        _say("aside", sentence)
    if not scene.is_video and (videos := find_videos(options.source)):
        told = f"Its videos ({len(videos)}, such as {videos[0]}) are not used: give them in a folder of their own."
        _say("aside", told)
    return summary


def _make(scene: Scene, report: Report) -> Summary:
    options, work = scene.options, scene.work

    # It starts at once, to import what it needs while photos are read, and ends before its folder is left.
    with contextlib.ExitStack() as alone, start_colmap() as colmap:
        folder, names = options.source, scene.settings["photos"]
        if scene.is_video:
            if names:
                _say("aside", f"Frames of {len(names)} videos are taken, each with a camera of its own.")
            folder = work / "frames"
            chosen = [] if folder.exists() else video_frames(options.source, names, options.frames)
            scene.settings["files"] = scene.begun.get("files") or photo_stamps(options.source, names or [""])
            alone.enter_context(scene.alone())  # It notes the settings, by which an interrupted run goes on.
            if not folder.exists():
                partial = empty_folder(work / "frames.partial")
                write_frames(chosen, partial, lambda done: report("frames", done, options.frames))
                partial.rename(folder)
            names = sorted(photo.relative_to(folder).as_posix() for photo in folder.rglob("*.jpg"))
        photos = read_photos(folder, names, report)
        if scene.is_video:
            photos = [dataclasses.replace(photo, camera=(os.path.dirname(photo.name), photo.size)) for photo in photos]
        views = sum(len(photo.views) for photo in photos)
        matching = choose_matching(options.matching, views, options.source.is_file())
        if not scene.is_video:
            stamps = scene.begun.get("files", {})
            scene.settings["files"] = stamps | photo_stamps(folder, [name for name in names if name not in stamps])
            alone.enter_context(scene.alone())  # Only now, when the photos are known to be readable.
            masks = [name for name in scene.masks.values() if name not in stamps]
            scene.settings["files"] |= photo_stamps(folder, masks)  # They are noted when the scene is finished.
        _tell_work(scene, photos)
        if scene.added:  # An interrupted run may have made these without some of them.
            for path in (scene.model, work / "photos"):
                shutil.rmtree(path, ignore_errors=True)
        rigs = [[view.name for view in photo.views] for photo in photos if photo.is_panorama]
        folder, photos = _convert(scene, folder, photos)
        photos = [photo for photo in photos if photo.camera]  # without the views
        groups = [[photo.name] for photo in photos] if options.camera_per_photo else photos_by_camera(photos)
        arguments = (folder, groups, matching, options.max_size, scene.model, scene.base, rigs)
        summary = Summary(**make_model(colmap, *arguments, folder=work, report=report))
        _publish(work / "undistorted", options.out, bool(scene.added))
        if summary.is_poor and not scene.added:  # The features serve another way of matching.
            shutil.rmtree(scene.model)
        else:
            scene.note(max_size=options.max_size, finished=dataclasses.asdict(summary), model=scene.model.name)
            scene.remove_intermediate_files()
    return summary


def _tell_work(scene: Scene, photos: Sequence[Photo]) -> None:
    if scene.added:
        added = f"{scene.added} photo{'s' * (scene.added > 1)} added to {len(scene.begun['photos'])}"
        _say("added", f"{added}.", photos=added)
    if panoramas := sum(photo.is_panorama for photo in photos):
        held_out = "all those of a panorama" if len(photos) > 4 else "single ones"
        _say(
            "panoramas",
            f"{panoramas} of the {len(photos)} photos are panoramas: each is cut into {VIEWS} views of 90°, which "
            f"leave out 30° about the zenith and the nadir; {held_out} are held out.",
        )


def _convert(scene: Scene, folder: Path, stored: Sequence[Photo]) -> tuple[Path, list[Photo]]:
    """Convert photos as `convert_photos`, and write their opacities, and masks if they or the scene have any."""
    work, masks = scene.work, scene.masks
    converted, photos = convert_photos(folder, stored, work / "photos")
    has_masks = (scene.options.out / "masks").exists() if scene.added else bool(masks)
    shutil.rmtree(work / "masks", ignore_errors=True)
    if has_masks:
        write_masks(scene.options.source, masks, stored, photos, work / "masks")
    if masks:
        why = "used" if has_masks else "not used, because the scene has none: give another folder for it"
        _say("aside", f"Masks of {len(masks)} photos are {why}.")
    if transparent := write_alpha(converted, photos, work / "alpha"):
        _say("transparent", f"{transparent} photos are partly transparent; their images in the scene are, too.")
    return converted, photos


def _say(event: str, sentence: str, **fields: str) -> None:
    """Print a sentence, and report the event that it is about, with the sentence as the field `told`."""
    print(sentence, flush=True)
    events.report(event, told=sentence, **fields)


def _reporter(progress: Progress) -> Report:
    """Return a function that shows each stage as a bar, or without a terminal as lines of numbers."""
    tasks: dict[str, TaskID] = {}
    printed = 0.0

    def report(stage: str, done: int, total: int) -> None:
        nonlocal printed
        events.progress(stage, done, total)
        if begins := stage not in tasks:
            tasks[stage] = progress.add_task(stage, total=total)
        progress.update(tasks[stage], completed=done)
        if progress.disable and (begins or done == total or time.monotonic() >= printed + _SECONDS_PER_LINE):
            print(f"{stage} {done}/{total}", flush=True)
            printed = time.monotonic()

    return report


def _publish(undistorted: Path, out: Path, grown: bool) -> None:
    """Move undistorted photos, their model and what nerfstudio reads of it to the scene's folder.

    A finished scene that has `grown` by these photos stays one until all are there. Raise OSError if writing fails.
    """
    images, described = undistorted / "images", json.loads((undistorted / "transforms.json").read_text())
    written = [frame["file_path"] for frame in described["frames"]]
    masks = [path.relative_to(undistorted).as_posix() for path in (undistorted / "masks").rglob("*.png")]
    for frame in described["frames"] if masks or (grown and (out / "masks").exists()) else ():
        frame["mask_path"] = f"masks/{frame['file_path'].removeprefix('images/')}.png"
    if grown:
        before = json.loads((out / "transforms.json").read_text())
        poses = {frame["file_path"]: frame["transform_matrix"] for frame in before["frames"]}
        for frame in described["frames"]:  # Computing a pose again rounds it.
            frame["transform_matrix"] = poses.get(frame["file_path"], frame["transform_matrix"])
        kept = {name: before[name] for name in _KEPT_KEYS if name in before}
        for name in kept.keys() & described.keys() - {*FRAME_KEYS}:  # The new views of panoramas are divided, too.
            kept[name] = kept[name] + [view for view in described[name] if view not in poses]
        described |= kept
        written = [name for name in written if (undistorted / name).exists() or name not in poses]
    (undistorted / "transforms.json").write_text(json.dumps(described, indent=4))
    written += masks
    try:
        read_photos(undistorted, written, lambda *step: None)
    except InputError as error:  # COLMAP does not say when a disk is full
        raise WriteError(images, OSError("the disk is full")) from error
    restore_alpha(images, undistorted / "alpha")
    if not grown:
        (out / "transforms.json").unlink(missing_ok=True)  # Its presence says that all the others are there.
        for name in ("images", "masks"):
            shutil.rmtree(out / name, ignore_errors=True)
    for name in written:
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (undistorted / name).replace(out / name)
    shutil.rmtree(out / "sparse", ignore_errors=True)
    for name in ("sparse", "sparse_pc.ply", "transforms.json"):
        (undistorted / name).rename(out / name)


def check_size(max_size: int) -> None:
    """Raise InputError if photos of this longest side in px would show no structure."""
    if max_size != 0 and max_size < MIN_SIZE:
        raise InputError(f"--max-size must be at least {MIN_SIZE} px, or 0 to keep the photos' size.")


def main(argv: Sequence[str] | None = None) -> int:
    """Make a scene and return the exit code, which is 1 also if fewer than half of the photos registered."""
    options = parse(Process, "sadgs-process", argv)
    return exit_code("sadgs-process", options.out, lambda: _run(options))


def _run(options: Process) -> int:
    if options.frames < 3:
        raise InputError("--frames must be at least 3.")
    check_size(options.max_size)
    summary, out = process(options), shlex.quote(str(options.out))
    if not summary.is_poor:
        print(f"\nCheck machine and data before a long run:  sadgs-doctor {out}\nTrain:  ns-train sadgs --data {out}")
        return 0
    again = "the same command with --matching exhaustive, which uses the features found so far; or "
    print(
        f"warning: {options.out} shows only what {summary.registered} of {summary.photos} photos saw. Try "
        f"{again * (summary.matching != 'exhaustive')}another folder with more photos between those that did not "
        f"register, with two thirds of overlap. This trains on what is there: ns-train sadgs --data {out}",
        file=sys.stderr,
    )
    return 1
