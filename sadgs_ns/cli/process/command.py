"""`sadgs-process PHOTOS_OR_VIDEO OUT`: from photos to a scene that `ns-train sadgs --data OUT` reads, with pycolmap.

OUT holds `images/`, `transforms.json`, `sparse_pc.ply` and COLMAP's model in `sparse/0`. What an interrupted run needs
to go on lies in `OUT/work`.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

import pycolmap
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from sadgs_ns.atomic import atomic_path
from sadgs_ns.cli.process.photos import find_photos, photos_by_camera, photos_not_read
from sadgs_ns.cli.process.stages import (
    Matching,
    Summary,
    empty_folder,
    extract,
    match,
    reconstruct,
    summarize,
    undistort,
)
from sadgs_ns.cli.process.video import video_frames, write_frames
from sadgs_ns.errors import WriteError, free_space, reason


def _note(settings: dict, noted: Path) -> None:
    """Write the settings that a scene is begun with; a scene that goes on keeps its own."""
    if not noted.exists():
        with atomic_path(noted) as partial:
            partial.write_text(json.dumps(settings))


def _changes(begun: dict, asked: dict) -> str:
    """What differs between the settings that a scene was begun with and those asked for now; empty if nothing does."""
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
) -> Summary:
    """Make a scene of photos or a video.

    Args:
        source: A folder of photos, searched with its subfolders, or a video.
        out: Folder for the scene; made if it does not exist, continued if an earlier run was interrupted.
        matching: Which pairs are matched; "auto" is sequential for videos, exhaustive for at most
            `stages.EXHAUSTIVE_LIMIT` photos, and by GPS positions or a vocabulary for more.
        frames: How many frames of a video are taken.
        max_size: Longest side of the undistorted photos in px; 0 keeps them as they are.
        camera_per_photo: Whether every photo has a focal length of its own. Otherwise photos of one size share a
            camera, unless EXIF tells of several cameras or focal lengths.

    Returns:
        What was registered and what was not.

    Raises:
        ValueError: One sentence that names the input and the remedy.
    """
    work = out / "work"
    noted = work / "settings.json"
    if out.is_file() or (out.exists() and any(out.iterdir()) and not noted.exists()):
        raise ValueError(f"{out} exists and is not a scene that sadgs-process began; give another folder.")
    is_video = source.is_file()
    settings = {"source": str(source.resolve()), "camera_per_photo": camera_per_photo}
    settings |= {"frames": frames} if is_video else {"photos": find_photos(source, out)}
    if noted.exists() and (changes := _changes(json.loads(noted.read_text()), settings)):
        raise ValueError(
            f"{out} was begun with other photos or settings ({changes}); give another folder or delete it."
        )
    if is_video:
        photos = work / "frames"
        if not photos.exists():
            chosen = video_frames(source, frames)
            _note(settings, noted)  # before anything else lies in the folder: an interrupted run goes on by it
            partial = empty_folder(work / "frames.partial")
            write_frames(chosen, partial)
            partial.rename(photos)
        names = sorted(photo.name for photo in photos.glob("*.jpg"))
    else:
        photos, names = source, settings["photos"]
    groups = [[name] for name in names] if camera_per_photo else photos_by_camera(photos, names)
    _note(settings, noted)  # for a folder only now, when its photos are known to be readable
    database = work / "database.db"
    columns = (TextColumn("{task.description:>24}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    level, pycolmap.logging.minloglevel = pycolmap.logging.minloglevel, int(pycolmap.logging.ERROR)
    try:
        with Progress(*columns) as progress:
            extract(photos, groups, database, progress)
            match(names, database, work, matching, is_video, progress)
            model = reconstruct(photos, names, database, work, progress)
            undistort(photos, model, out, work, max_size or -1, progress)
    finally:
        pycolmap.logging.minloglevel = level
    return summarize(names, model, database)


def main(argv: Sequence[str] | None = None) -> int:
    """Make a scene; returns the exit code: 1 on a full disk, 2 if the input is wrong, 130 after an interrupt."""
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
        "--max-size", type=int, default=1600, metavar="PX", help="longest side of the result, 0 for all (%(default)s)"
    )
    parser.add_argument(
        "--camera-per-photo", action="store_true", help="every photo has its own zoom, and EXIF does not tell"
    )
    options = parser.parse_args(argv)
    if options.frames < 3:
        parser.error("--frames must be at least 3")
    if options.max_size < 0:
        parser.error("--max-size must not be negative")
    try:
        summary = process(**vars(options))
    except ValueError as error:
        print(f"sadgs-process: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        told = f"{reason(error)} ({free_space(options.out)} free there); the same command goes on."
        print(f"sadgs-process: {error if isinstance(error, WriteError) else told}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("sadgs-process: stopped; the same command goes on.", file=sys.stderr)
        return 130
    print(summary)
    if options.source.is_dir() and (not_read := photos_not_read(options.source)):
        print(not_read)
    if summary.registered < 0.5 * summary.photos:
        print("Fewer than half of the photos registered: more overlap between them would help.")
    print(f"\nns-train sadgs --data {options.out}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
