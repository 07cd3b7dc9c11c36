"""`sadgs-process PHOTOS_OR_VIDEO OUT`: from photos to a scene that `ns-train sadgs --data OUT` reads, with pycolmap.

OUT holds `images/`, `transforms.json`, `sparse_pc.ply` and COLMAP's model in `sparse/0`. What an interrupted run needs
to go on lies in `OUT/work`. Of a finished scene `settings.json` stays there, by which the command knows it again, and
what photos that come later are added to: the features and matches in `database.db`, and the model before undistortion.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import fcntl
import json
import os
import shlex
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from rich.progress import BarColumn, MofNCompleteColumn, Progress, TaskID, TextColumn, TimeRemainingColumn

from sadgs_ns.atomic import atomic_path
from sadgs_ns.cli.process.apart import Report, run_apart
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
from sadgs_ns.data.coordinates import FRAME_KEYS
from sadgs_ns.errors import InputError, RunError, WriteError, free_space, reason
from sadgs_ns.plugin.interrupts import Interrupted, Interrupts

MIN_SIZE = 64
"""Smallest longest side of the result in px; no structure is left in smaller images."""
_SECONDS_PER_LINE = 1.0
"""Least time between two lines of a stage's progress in a file."""
_STAGES = "sadgs_ns.cli.process.stages"
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
    tell: Callable[[str], None] = print,
) -> Summary:
    """Make a scene of photos or a video.

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
        tell: Called with sentences that the user should read, as the work goes on.

    Returns:
        What was registered and what was not.

    Raises:
        InputError: If the photos, the folder or the settings cannot be used.
        OSError: If a file cannot be written.
        RunError: If COLMAP fails.
    """
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
        tell(f"{out} is finished; delete it to make it again.")
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
                run_apart(f"{_STAGES}:fetch_vocabulary", Path(scratch), folder=Path(scratch), report=report)

        chosen_matching, notice = choose_matching(matching, photos, is_video, fetch_vocabulary)
        if not is_video:
            _note(settings, noted)  # only now, when the photos are known to be readable
            alone.enter_context(_alone(work))
        known = len(photos) - len(added) if added else 0
        if added:
            tell(f"{len(added)} photo{'s' * (len(added) > 1)} added to {known}.")
        tell(f"{notice} {expected_work(photos, chosen_matching, known)}".lstrip())
        folder, photos = convert_photos(folder, photos, work / "photos")
        if transparent := write_alpha(folder, photos, work / "alpha"):
            tell(f"{transparent} photos are partly transparent; their images in the scene are, too.")
        groups = [[photo.name] for photo in photos] if camera_per_photo else photos_by_camera(photos)
        if added:  # An interrupted run may have made a model without some of them.
            shutil.rmtree(work / model, ignore_errors=True)
        arguments = (folder, groups, chosen_matching, max_size, work / "alpha", work, model, base)
        summary = run_apart(f"{_STAGES}:make_model", *arguments, folder=work, report=report)
        _publish(work / "undistorted", out, bool(added))
        if summary.is_poor and not added:  # the features serve another way of matching
            shutil.rmtree(work / model)
        else:
            settings |= {"max_size": max_size, "finished": dataclasses.asdict(summary), "model": model}
            with atomic_path(noted) as partial:
                partial.write_text(json.dumps(settings))
            _remove_intermediate_files(work, settings)
    return summary


@contextlib.contextmanager
def _alone(work: Path) -> Iterator[None]:
    """Keep other runs away from a work folder, and leave nothing half-written there.

    Raises:
        InputError: If another run works there.
    """
    lock = os.open(work, os.O_RDONLY)
    try:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise InputError(f"another sadgs-process works on {work.parent}; wait for it, or stop it.") from error
        try:
            yield
        finally:
            for name in _UNFINISHED:
                shutil.rmtree(work / name, ignore_errors=True)
            (work / "pairs.txt").unlink(missing_ok=True)
    finally:
        os.close(lock)


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


def main(argv: Sequence[str] | None = None) -> int:
    """Make a scene and return the exit code.

    It is 0 for a scene of at least half of the photos, 1 for one of fewer, a full disk or a failure of COLMAP, 2 if the
    input is wrong, and 130, 143 or 129 after SIGINT, SIGTERM or SIGHUP.
    """
    parser = argparse.ArgumentParser(prog="sadgs-process", description="From photos or a video to a scene for sadgs.")
    parser.add_argument("source", type=Path, help="folder of photos, or a video")
    parser.add_argument("out", type=Path, help="folder for the scene; an interrupted run goes on in it")
    parser.add_argument(
        "--matching",
        default="auto",
        choices=["auto", "exhaustive", "sequential", "spatial", "vocabulary"],
        help="which photos are compared (default %(default)s, by their kind and number)",
    )
    parser.add_argument("--frames", type=int, default=200, help="frames to take of a video (default %(default)s)")
    parser.add_argument(
        "--max-size",
        type=int,
        default=1600,
        metavar="PX",
        help=f"longest side of the result, at least {MIN_SIZE}, 0 to keep it (default %(default)s)",
    )
    parser.add_argument(
        "--camera-per-photo", action="store_true", help="every photo has its own zoom, and EXIF does not tell"
    )
    options = parser.parse_args(argv)
    if options.frames < 3:
        parser.error("--frames must be at least 3")
    if options.max_size != 0 and options.max_size < MIN_SIZE:
        parser.error(f"--max-size must be at least {MIN_SIZE} px, or 0 to keep the photos' size")
    try:
        if not (options.source.is_absolute() and options.out.is_absolute()):
            try:
                os.getcwd()
            except FileNotFoundError:
                raise InputError(
                    "the working directory was deleted; change to another one, or give full paths."
                ) from None
        with Interrupts(waiting=lambda: True):
            summary = process(**vars(options))
    except InputError as error:
        print(f"sadgs-process: {error}", file=sys.stderr)
        return 2
    except (OSError, RunError) as error:
        told = str(error)
        if isinstance(error, OSError) and error.errno is not None:
            where = error.filename or options.out
            told = f"{where}: {reason(error)} ({free_space(options.out)} free there); the same command goes on."
        print(f"sadgs-process: {told}", file=sys.stderr)
        return 1
    except KeyboardInterrupt as stopped:
        print("sadgs-process: stopped; the same command goes on.", file=sys.stderr)
        return 128 + (stopped.number if isinstance(stopped, Interrupted) else signal.SIGINT)
    print(summary)
    if options.source.is_dir() and (not_read := photos_not_read(options.source)):
        print(not_read)
    out = shlex.quote(str(options.out))
    if summary.is_poor:
        again = "the same command with --matching exhaustive, which uses the features found so far; or "
        print(
            f"warning: {options.out} shows only what {summary.registered} of {summary.photos} photos saw. Try "
            f"{'' if summary.matching == 'exhaustive' else again}another folder with more photos between those that "
            f"did not register, with two thirds of overlap. This trains on what is there: ns-train sadgs --data {out}",
            file=sys.stderr,
        )
        return 1
    print(f"\nCheck machine and data before a long run:  sadgs-doctor {out}\nTrain:  ns-train sadgs --data {out}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
