"""`sadgs-process PHOTOS_OR_VIDEO OUT`: from photos to a scene that `ns-train sadgs --data OUT` reads, with pycolmap.

OUT holds `images/`, `transforms.json`, `sparse_pc.ply` and COLMAP's model in `sparse/0`. What an interrupted run needs
to go on lies in `OUT/work`. Of a finished scene `settings.json` stays there, by which the command knows it again, and
what photos that come later are added to: the features and matches in `database.db`, and the model before undistortion.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import shlex
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from sadgs_ns import events
from sadgs_ns.atomic import atomic_path
from sadgs_ns.cli.process.colmap import Report, run_colmap
from sadgs_ns.cli.process.photos import (
    changed_photos,
    convert_photos,
    empty_folder,
    find_photos,
    photo_stamps,
    photos_by_camera,
    photos_not_read,
    read_photos,
    restore_alpha,
    write_alpha,
)
from sadgs_ns.cli.process.plan import Matching, Summary, choose_matching, expected_work
from sadgs_ns.cli.process.video import video_frames, write_frames
from sadgs_ns.cli.program import exit_code, locked, parse
from sadgs_ns.data.coordinates import FRAME_KEYS
from sadgs_ns.errors import InputError, WriteError, reason
from sadgs_ns.plugin.interrupts import Interrupts

MIN_SIZE = 64
"""Smallest longest side of the result in px; no structure is left in smaller images."""
_SECONDS_PER_LINE = 1.0
"""Least time between two lines of a stage's progress in a file."""
_KEPT_KEYS = (*FRAME_KEYS, "train_filenames", "val_filenames", "test_filenames")
"""Keys that a scene's `transforms.json` keeps when photos are added."""
_MODEL = "model"
"""Name of the model's folder in `work`; where photos were added, their number follows it."""
_UNFINISHED = (
    "frames.partial",
    "photos.partial",
    "alpha.partial",
    "model.partial",
    "models",
    "undistorted",
)
"""Folders in `work` that are made anew by each run that needs them."""


def _note(settings: dict, noted: Path) -> None:
    """Write the settings that a scene is begun with, unless it was begun before."""
    if not noted.exists():
        with atomic_path(noted) as partial:
            partial.write_text(json.dumps(settings))


def _refuse_changes(out: Path, begun: dict, asked: dict, grows: bool) -> None:
    """Compare the settings and photos that a scene was begun with to those of now.

    Args:
        out: The scene.
        begun: The settings with which it was begun.
        asked: Those of now.
        grows: Whether photos may have been added.

    Raises:
        InputError: If they differ.
    """
    differing = [name for name in asked if begun.get(name) != asked[name]]
    if "source" in differing:  # the rest follows from it
        differing = ["source"]
    told, photos, back = [], [], ""
    if "source" not in differing and "photos" in asked:
        photos += [("changed", changed_photos(Path(asked["source"]), begun.get("files", {})))]
    for name in differing:
        if name not in begun:
            told.append(f"an earlier version began it and did not compare its {name}")
        elif name == "photos":
            before, now = set(begun[name]), set(asked[name])
            photos += [("added", set() if grows else now - before), ("removed", before - now)]
        else:
            option = name if name == "source" else "--" + name.replace("_", "-")
            told.append(f"{option} was {begun[name]}, is {asked[name]}")
    for verb, names in photos:
        if names:
            told.append(f"photos {verb}: {len(names)}, such as {min(names)}")
            back = back if verb == "added" else "put these photos back, "
    if told:
        raise InputError(
            f"{out} was begun with other photos or settings ({'; '.join(told)}); {back}give another folder or delete "
            "it."
        )


def photos_added(source: Path, out: Path) -> list[str]:
    """Return the names of the photos that a folder holds more than those that its finished scene was made of.

    Raises:
        InputError: As `find_photos`, or if the scene's settings are damaged.
    """
    noted = out / "work" / "settings.json"
    begun = _read_settings(noted) if noted.exists() and source.is_dir() else {}
    known = begun.get("photos") if "finished" in begun else None
    return [] if known is None else sorted(set(find_photos(source, out)) - set(known))


def process(
    source: Path,
    out: Path,
    *,
    matching: Matching = "auto",
    frames: int = 200,
    max_size: int = 1600,
    camera_per_photo: bool = False,
) -> Summary:
    """Make a scene of photos or a video, and say how far it is, in print and as events.

    Args:
        source: A folder of photos, searched with its subfolders, or a video.
        out: Folder for the scene. It is made if it does not exist, and an interrupted run in it goes on. To a finished
            scene photos are added that have come since, while its other cameras stay as they are; without any it is
            left as it is.
        matching: Which pairs are matched; "auto" is sequential for videos, exhaustive for at most
            `plan.EXHAUSTIVE_LIMIT` photos, and by GPS positions or a vocabulary for more. Where there is no vocabulary,
            it is sequential for numbered photos and exhaustive for others.
        frames: How many frames of a video are taken.
        max_size: Longest side of the undistorted photos in px; 0 keeps them as they are.
        camera_per_photo: Whether every photo has a focal length of its own. Otherwise photos of one size share a
            camera, unless EXIF tells of several cameras or focal lengths.

    Returns:
        What was registered and what was not.

    Raises:
        InputError: If the photos, the folder or the settings cannot be used.
        Interrupted: If a signal came; what was done is kept.
        OSError: If a file cannot be written.
        RunError: If COLMAP fails.
    """
    with Interrupts(waiting=lambda: True):
        summary = _process(source, out, matching, frames, max_size, camera_per_photo)
    print(summary)
    if source.is_dir() and (not_read := photos_not_read(source)):
        print(not_read)
    return summary


def _process(
    source: Path, out: Path, matching: Matching, frames: int, max_size: int, camera_per_photo: bool
) -> Summary:
    work = out / "work"
    noted = work / "settings.json"
    if out.is_file() or (not noted.exists() and any(not path.is_dir() for path in out.rglob("*"))):
        raise InputError(f"{out} exists and is not a scene that sadgs-process began; give another folder.")
    is_video = source.is_file()
    settings = {"source": os.path.realpath(source), "camera_per_photo": camera_per_photo}
    settings |= {"frames": frames} if is_video else {"photos": find_photos(source, out)}
    begun = _read_settings(noted) if noted.exists() else {}
    finished = begun.get("finished") if (out / "transforms.json").exists() else None
    asked = settings | ({"max_size": max_size} if finished else {})
    if begun:
        _refuse_changes(out, begun, asked, grows=bool(finished))
    added = [] if is_video or not finished else sorted(set(settings["photos"]) - set(begun["photos"]))
    base: str | None = begun.get("model", _MODEL) if added else None
    if base is not None and not ((work / base).exists() and (work / "database.db").exists()):
        raise InputError(
            f"{out} was made by an earlier version, which kept nothing that photos could be added to: give another "
            "folder or delete it."
        )
    model = f"{_MODEL}-{len(settings['photos'])}" if added else _MODEL
    if finished and not added:
        _remove_intermediate_files(work, begun)
        _say("unchanged", f"{out} is finished; delete it to make it again.")
        return Summary(**finished)
    columns = (TextColumn("{task.description:>24}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, disable=not sys.stdout.isatty()) as progress, contextlib.ExitStack() as alone:
        report = _reporter(progress)
        if is_video:
            folder = work / "frames"
            chosen = [] if folder.exists() else video_frames(source, frames)
            _note(settings, noted)  # before anything else lies in the folder: an interrupted run goes on by it
            alone.enter_context(_alone(work))
            if not folder.exists():
                partial = empty_folder(work / "frames.partial")
                write_frames(chosen, partial, lambda done: report("frames", done, frames))
                partial.rename(folder)
            names = sorted(photo.name for photo in folder.glob("*.jpg"))
        else:
            folder, names = source, settings["photos"]
        photos = read_photos(folder, names, report)
        if not is_video:
            settings["files"] = begun.get("files") or {}
            settings["files"] |= photo_stamps(folder, [name for name in names if name not in settings["files"]])

        def fetch_vocabulary() -> None:
            with tempfile.TemporaryDirectory() as scratch:
                run_colmap("fetch_vocabulary", Path(scratch), folder=Path(scratch), report=report)

        chosen_matching, notice = choose_matching(matching, photos, is_video, fetch_vocabulary)
        if not is_video:
            _note(settings, noted)  # only now, when the photos are known to be readable
            alone.enter_context(_alone(work))
        known = len(photos) - len(added) if added else 0
        if added:
            told = f"{len(added)} photo{'s' * (len(added) > 1)} added to {known}"
            _say("added", f"{told}.", told=told)
        work_sentence, duration = expected_work(photos, chosen_matching, known)
        _say("expected", f"{notice} {work_sentence}".lstrip(), duration=duration)
        folder, photos = convert_photos(folder, photos, work / "photos")
        if transparent := write_alpha(folder, photos, work / "alpha"):
            _say("transparent", f"{transparent} photos are partly transparent; their images in the scene are, too.")
        groups = [[photo.name] for photo in photos] if camera_per_photo else photos_by_camera(photos)
        if added:  # An interrupted run may have made a model without some of them.
            shutil.rmtree(work / model, ignore_errors=True)
        arguments = (folder, groups, chosen_matching, max_size, work / "alpha", work, model, base)
        summary = Summary(**run_colmap("make_model", *arguments, folder=work, report=report))
        _publish(work / "undistorted", out, bool(added))
        if summary.is_poor and not added:  # the features serve another way of matching
            shutil.rmtree(work / model)
        else:
            settings |= {"max_size": max_size, "finished": dataclasses.asdict(summary), "model": model}
            with atomic_path(noted) as partial:
                partial.write_text(json.dumps(settings))
            _remove_intermediate_files(work, settings)
    return summary


def _say(event: str, sentence: str, **fields: str) -> None:
    """Print a sentence, and tell a listener of the event that it is about."""
    print(sentence, flush=True)
    events.report(event, **fields)


@contextlib.contextmanager
def _alone(work: Path) -> Iterator[None]:
    """Keep other runs away from a work folder, and leave nothing half-written there.

    Raises:
        InputError: If another run works there.
    """
    with locked(work, f"another sadgs-process works on {work.parent}; wait for it, or stop it."):
        try:
            yield
        finally:
            for name in _UNFINISHED:
                shutil.rmtree(work / name, ignore_errors=True)
            (work / "pairs.txt").unlink(missing_ok=True)


def _remove_intermediate_files(work: Path, settings: dict) -> None:
    """Remove from a finished scene's work folder what no photo that is added later needs."""
    for path in work.iterdir():
        if path.name in (settings.get("model", _MODEL), "database.db", "settings.json"):
            continue
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()


def _read_settings(noted: Path) -> dict:
    try:
        return dict(json.loads(noted.read_text()))
    except ValueError as error:
        raise InputError(
            f"{noted} is damaged ({reason(error)}): delete {noted.parent.parent} and begin again."
        ) from error


def _reporter(progress: Progress) -> Report:
    """Return a function that shows each stage as a bar of its own; where there is no terminal, as lines of a number."""
    tasks: dict[str, TaskID] = {}
    printed = 0.0

    def report(stage: str, done: int, total: int) -> None:
        nonlocal printed
        events.progress(stage, done, total)
        begins = stage not in tasks
        if begins:
            tasks[stage] = progress.add_task(stage, total=total)
        progress.update(tasks[stage], completed=done)
        if progress.disable and (begins or done == total or time.monotonic() >= printed + _SECONDS_PER_LINE):
            print(f"{stage} {done}/{total}", flush=True)
            printed = time.monotonic()

    return report


def _publish(undistorted: Path, out: Path, grown: bool = False) -> None:
    """Move undistorted photos, their model and what nerfstudio reads of it to the scene's folder.

    Args:
        undistorted: The folder of all that.
        out: The scene's folder.
        grown: Whether the photos are added to those of a finished scene, which stays one until all are there.

    Raises:
        OSError: If a file cannot be written, or COLMAP could not write one.
    """
    images = undistorted / "images"
    described = json.loads((undistorted / "transforms.json").read_text())
    written = [frame["file_path"] for frame in described["frames"]]
    if grown:
        before = json.loads((out / "transforms.json").read_text())
        poses = {frame["file_path"]: frame["transform_matrix"] for frame in before["frames"]}
        for frame in described["frames"]:  # Computing a pose again rounds it.
            frame["transform_matrix"] = poses.get(frame["file_path"], frame["transform_matrix"])
        kept = {name: before[name] for name in _KEPT_KEYS if name in before}
        (undistorted / "transforms.json").write_text(json.dumps(described | kept))
        written = [name for name in written if (undistorted / name).exists() or name not in poses]
    try:
        read_photos(undistorted, written, lambda *step: None)
    except InputError as error:  # COLMAP does not say when a disk is full
        raise WriteError(images, OSError("the disk is full")) from error
    restore_alpha(images, undistorted / "alpha")
    if grown:
        for name in written:
            (out / name).parent.mkdir(parents=True, exist_ok=True)
            (undistorted / name).replace(out / name)
    else:
        (out / "transforms.json").unlink(missing_ok=True)  # its presence says that all the others are there
        shutil.rmtree(out / "images", ignore_errors=True)
        images.rename(out / "images")
    shutil.rmtree(out / "sparse", ignore_errors=True)
    for name in ("sparse", "sparse_pc.ply", "transforms.json"):
        (undistorted / name).rename(out / name)


@dataclass
class Process:
    """From photos or a video to a scene for sadgs."""

    source: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="PHOTOS_OR_VIDEO")]
    """Folder of photos, or a video."""
    out: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="OUT")]
    """Folder for the scene; an interrupted run goes on in it."""
    matching: Matching = "auto"
    """Which photos are compared; auto decides by their kind and number."""
    frames: int = 200
    """Frames to take of a video, at least 3."""
    max_size: Annotated[int, tyro.conf.arg(metavar="PX")] = 1600
    """Longest side of the result, at least 64, 0 to keep it."""
    camera_per_photo: bool = False
    """Every photo has its own zoom, and EXIF does not tell."""

    def make(self) -> int:
        """Make the scene, and return 0, or 1 where fewer than half of the photos registered."""
        if self.frames < 3:
            raise InputError("--frames must be at least 3.")
        check_size(self.max_size)
        if not (self.source.is_absolute() and self.out.is_absolute()):
            try:
                os.getcwd()
            except FileNotFoundError:
                raise InputError(
                    "the working directory was deleted; change to another one, or give full paths."
                ) from None
        summary = process(**vars(self))
        out = shlex.quote(str(self.out))
        if not summary.is_poor:
            print(
                f"\nCheck machine and data before a long run:  sadgs-doctor {out}\nTrain:  ns-train sadgs --data {out}"
            )
            return 0
        again = "the same command with --matching exhaustive, which uses the features found so far; or "
        print(
            f"warning: {self.out} shows only what {summary.registered} of {summary.photos} photos saw. Try "
            f"{'' if summary.matching == 'exhaustive' else again}another folder with more photos between those that "
            f"did not register, with two thirds of overlap. This trains on what is there: ns-train sadgs --data {out}",
            file=sys.stderr,
        )
        return 1


def check_size(max_size: int) -> None:
    """Raise an InputError if a longest side in px leaves no structure in the photos."""
    if max_size != 0 and max_size < MIN_SIZE:
        raise InputError(f"--max-size must be at least {MIN_SIZE} px, or 0 to keep the photos' size.")


def main(argv: Sequence[str] | None = None) -> int:
    """Make a scene and return the exit code.

    It is 0 for a scene of at least half of the photos, 1 for one of fewer, a full disk or a failure of COLMAP, 2 if the
    input is wrong, and 130, 143 or 129 after SIGINT, SIGTERM or SIGHUP.
    """
    given = parse(Process, "sadgs-process", argv)
    return exit_code("sadgs-process", given.out, given.make)


if __name__ == "__main__":
    raise SystemExit(main())
