"""`sadgs-process PHOTOS_OR_VIDEO OUT`: from photos to a scene that `ns-train sadgs --data OUT` reads, with pycolmap.

OUT holds `images/`, `transforms.json`, `sparse_pc.ply` and COLMAP's model in `sparse/0`. What an interrupted run needs
to go on lies in `OUT/work`; of a finished scene only `settings.json` stays there, by which the command knows it again.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import fcntl
import io
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
    convert_photos,
    empty_folder,
    find_photos,
    photos_by_camera,
    photos_not_read,
    read_photos,
    restore_alpha,
    write_alpha,
)
from sadgs_ns.cli.process.plan import Matching, Summary, choose_matching, expected_work
from sadgs_ns.cli.process.video import video_frames, write_frames
from sadgs_ns.errors import InputError, RunError, WriteError, free_space, reason
from sadgs_ns.plugin.interrupts import Interrupted, Interrupts

MIN_SIZE = 64
"""Smallest longest side of the result in px; no structure is left in smaller images."""
_SECONDS_PER_LINE = 1.0
"""Least time between two lines of a stage's progress in a file."""
_STAGES = "sadgs_ns.cli.process.stages"
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


def _changes(begun: dict, asked: dict) -> str:
    """Say what differs between the settings that a scene was begun with and those asked for now, if anything does."""
    changed = [name for name in asked if begun.get(name) != asked[name]]
    if "source" in changed:  # the rest follows from it
        changed = ["source"]
    told = []
    for name in changed:
        if name not in begun:
            told.append(f"an earlier version began it and did not compare its {name}")
        elif name == "photos":
            before, now = set(begun[name]), set(asked[name])
            for verb, names in (("added", now - before), ("removed", before - now)):
                told += [f"photos {verb}: {len(names)}, such as {min(names)}"] if names else []
        else:
            option = name if name == "source" else "--" + name.replace("_", "-")
            told.append(f"{option} was {begun[name]}, is {asked[name]}")
    return "; ".join(told)


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
        out: Folder for the scene. It is made if it does not exist, and an interrupted run in it goes on. A finished
            scene is left as it is.
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
    if begun and (changes := _changes(begun, asked)):
        raise InputError(
            f"{out} was begun with other photos or settings ({changes}); give another folder or delete it."
        )
    if finished:
        _remove_intermediate_files(work)
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

        def fetch_vocabulary() -> None:
            with tempfile.TemporaryDirectory() as scratch:
                run_apart(f"{_STAGES}:fetch_vocabulary", Path(scratch), folder=Path(scratch), report=report)

        chosen_matching, notice = choose_matching(matching, photos, is_video, fetch_vocabulary)
        if not is_video:
            _note(settings, noted)  # only now, when the photos are known to be readable
            alone.enter_context(_alone(work))
        tell(f"{notice} {expected_work(photos, chosen_matching)}".lstrip())
        folder, photos = convert_photos(folder, photos, work / "photos")
        if transparent := write_alpha(folder, photos, work / "alpha"):
            tell(f"{transparent} photos are partly transparent; their images in the scene are, too.")
        groups = [[photo.name] for photo in photos] if camera_per_photo else photos_by_camera(photos)
        arguments = (folder, groups, chosen_matching, max_size, work / "alpha", work)
        summary = run_apart(f"{_STAGES}:make_model", *arguments, folder=work, report=report)
        _publish(work / "undistorted", out)
        if summary.is_poor:  # the features serve another way of matching
            shutil.rmtree(work / "model")
        else:
            with atomic_path(noted) as partial:
                ending = {"max_size": max_size, "finished": dataclasses.asdict(summary)}
                partial.write_text(json.dumps(settings | ending))
            _remove_intermediate_files(work)
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


def _remove_intermediate_files(work: Path) -> None:
    """Remove what a finished scene does not need from its work folder."""
    for path in work.iterdir():
        if path.is_dir():
            shutil.rmtree(path)
        elif path.name != "settings.json":
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


def _publish(undistorted: Path, out: Path) -> None:
    """Add what nerfstudio reads to undistorted photos and their model, and move everything to the scene's folder.

    Raises:
        OSError: If a file cannot be written, or COLMAP could not write one.
    """
    from nerfstudio.process_data.colmap_utils import colmap_to_json

    with contextlib.redirect_stdout(io.StringIO()):  # nerfstudio prints all cameras where there are several
        colmap_to_json(undistorted / "sparse" / "0", undistorted)
    images = undistorted / "images"
    written = [frame["file_path"] for frame in json.loads((undistorted / "transforms.json").read_text())["frames"]]
    try:
        read_photos(undistorted, written, lambda *step: None)
    except InputError as error:  # COLMAP does not say when a disk is full
        raise WriteError(images, OSError("the disk is full")) from error
    restore_alpha(images, undistorted / "alpha")
    (out / "transforms.json").unlink(missing_ok=True)  # its presence says that all the others are there
    for name in ("images", "sparse"):
        shutil.rmtree(out / name, ignore_errors=True)
    for name in ("images", "sparse", "sparse_pc.ply", "transforms.json"):
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
