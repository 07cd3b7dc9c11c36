"""`sadgs-process PHOTOS_OR_VIDEO OUT`: from photos to a scene that `ns-train sadgs --data OUT` reads, with pycolmap.

Four stages, each of which goes on where an earlier run was interrupted: find features, match them, reconstruct cameras
and points, undistort. OUT holds `images/`, `transforms.json`, `sparse_pc.ply` and COLMAP's model in `sparse/0`; what is
only needed to go on lies in `OUT/work`.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import io
import itertools
import json
import shutil
import sqlite3
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path
from typing import Literal

import pycolmap
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from sadgs_ns.atomic import atomic_path
from sadgs_ns.cli.process.photos import find_photos, photos_by_camera, photos_not_read
from sadgs_ns.cli.process.video import film_frames, write_frames
from sadgs_ns.errors import WriteError, free_space, reason

_SEED = 0
"""Of COLMAP's random samples, which otherwise draws from the clock: equal photos give nearly equal cameras."""
EXHAUSTIVE_LIMIT = 200
"""Photos up to which every pair is matched; twice the photos take four times as long."""
FEW_FEATURES = 500
"""Keypoints under which a photo counts as blurred or empty."""
Matching = Literal["auto", "exhaustive", "sequential", "spatial", "vocabulary"]


@dataclasses.dataclass(frozen=True)
class Summary:
    """What became of the photos."""

    photos: int
    registered: int
    points: int
    reprojection_error: float
    """Mean over all observations, px."""
    left_out: dict[str, str]
    """Photos that were not registered, and why."""

    def __str__(self) -> str:
        lines = [
            f"{self.registered} of {self.photos} photos registered, {self.points:,} points, "
            f"mean reprojection error {self.reprojection_error:.2f} px."
        ]
        return "\n".join(lines + [f"  {name}: {why}" for name, why in sorted(self.left_out.items())])


def sequential_pairs(names: Sequence[str], overlap: int = 10) -> list[tuple[str, str]]:
    """Each frame with the next ones, and with ever fewer of those farther on, which close loops.

    Args:
        names: In the order of the film.
        overlap: How many neighbours.
    """
    steps = sorted({*range(1, overlap + 1), *(2**k for k in range(4, 10))})
    return [(names[i], names[i + step]) for i in range(len(names)) for step in steps if i + step < len(names)]


def _empty_folder(folder: Path) -> Path:
    """Make a folder, without what an interrupted run left in it."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder


def extract(photos: Path, groups: Sequence[Sequence[str]], database: Path, progress: Progress) -> None:
    """Find SIFT features in the photos that have none yet; each group of photos shares a camera."""
    task = progress.add_task("features", total=sum(map(len, groups)))
    with ThreadPoolExecutor(1) as pool:
        for group in groups:
            reader = pycolmap.ImageReaderOptions(camera_model="OPENCV")
            if database.exists():
                with pycolmap.Database.open(database) as opened:  # an interrupted run has made the camera
                    known = {image.name: image.camera_id for image in opened.read_all_images()}
                reader.existing_camera_id = next((known[name] for name in group if name in known), -1)
            extraction = pool.submit(
                pycolmap.extract_features, database, photos, list(group), pycolmap.CameraMode.SINGLE, reader
            )
            while not extraction.done():
                wait([extraction], timeout=0.5)
                with contextlib.suppress(sqlite3.Error), contextlib.closing(_reading(database)) as connection:
                    progress.update(task, completed=connection.execute("SELECT COUNT(*) FROM keypoints").fetchone()[0])
            extraction.result()
    progress.update(task, completed=sum(map(len, groups)))


def _reading(database: Path) -> sqlite3.Connection:
    """A connection that takes no lock, for COLMAP aborts where it meets one; what it reads may be torn."""
    return sqlite3.connect(f"{database.resolve().as_uri()}?immutable=1", uri=True)


def match(
    names: Sequence[str], database: Path, work: Path, matching: Matching, is_video: bool, progress: Progress
) -> None:
    """Match features between photos; pairs that an earlier run matched are skipped.

    Raises:
        ValueError: If a way of matching cannot work on these photos.
    """
    if matching == "auto":
        if is_video:
            matching = "sequential"
        elif len(names) <= EXHAUSTIVE_LIMIT:
            matching = "exhaustive"
        else:
            matching = "spatial" if _all_have_positions(database, len(names)) else "vocabulary"
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = _SEED
    # COLMAP separates the names in a list of pairs by spaces.
    listable = not any(character.isspace() for name in names for character in name)
    if matching in ("spatial", "vocabulary") or not listable:  # COLMAP's own ways, which tell nothing of their progress
        task = progress.add_task(f"matches ({matching})", total=1)
        if matching == "spatial":
            if not _all_have_positions(database, len(names)):
                raise ValueError(
                    "--matching spatial needs a GPS position in every photo; use vocabulary or exhaustive."
                )
            pycolmap.match_spatial(database, verification_options=verification)
        elif matching == "sequential":
            pycolmap.match_sequential(database, verification_options=verification)
        elif matching == "exhaustive":
            pycolmap.match_exhaustive(database, verification_options=verification)
        else:
            try:
                pycolmap.match_vocabtree(database, verification_options=verification)
            except Exception as error:  # it downloads a vocabulary at its first use
                raise ValueError(f"--matching vocabulary failed ({_first_line(error)}); use exhaustive.") from error
        progress.advance(task)
        return
    pairs = sequential_pairs(names) if matching == "sequential" else list(itertools.combinations(names, 2))
    task = progress.add_task(f"matches ({matching})", total=len(pairs))
    for start in range(0, len(pairs), 50):
        chunk = pairs[start : start + 50]
        listed = work / "pairs.txt"
        listed.write_text("".join(f"{a} {b}\n" for a, b in chunk))
        pairing = pycolmap.ImportedPairingOptions(match_list_path=listed)
        pycolmap.match_image_pairs(database, pairing_options=pairing, verification_options=verification)
        progress.advance(task, len(chunk))


def _all_have_positions(database: Path, photos: int) -> bool:
    with pycolmap.Database.open(database) as opened:
        return opened.num_pose_priors() == photos


def reconstruct(photos: Path, names: Sequence[str], database: Path, work: Path, progress: Progress) -> Path:
    """Estimate cameras and points; of several disconnected models the one with the most photos is kept.

    Returns:
        The model's folder.

    Raises:
        ValueError: If no two photos could be related.
    """
    model = work / "model"
    task = progress.add_task("cameras", total=len(names))
    if (model / "images.bin").exists():
        progress.advance(task, len(names))
        return model
    attempts = _empty_folder(work / "models")
    options = pycolmap.IncrementalPipelineOptions(min_model_size=3, random_seed=_SEED)
    models = pycolmap.incremental_mapping(
        database,
        photos,
        attempts,
        options,
        initial_image_pair_callback=lambda: progress.advance(task, 2),
        next_image_callback=lambda: progress.advance(task),
    )
    if not models:
        raise ValueError(
            "no two photos could be related to each other; take more of them, with at least two thirds of overlap, "
            "sharp, and of a scene with texture."
        )
    best = max(models.values(), key=lambda candidate: candidate.num_reg_images())
    partial = _empty_folder(work / "model.partial")
    best.write(partial)
    partial.rename(model)
    progress.update(task, completed=len(names))
    return model


def undistort(photos: Path, model: Path, out: Path, work: Path, max_size: int, progress: Progress) -> None:
    """Write undistorted photos, the model that fits them, and what nerfstudio reads."""
    from nerfstudio.process_data.colmap_utils import colmap_to_json

    task = progress.add_task("undistorted photos", total=1)
    partial = work / "undistorted"
    shutil.rmtree(partial, ignore_errors=True)
    options = pycolmap.UndistortCameraOptions(max_image_size=max_size)
    pycolmap.undistort_images(partial, model, photos, undistort_options=options, jpeg_quality=95)
    sparse = partial / "sparse"
    (sparse / "0").mkdir()
    for file in sparse.glob("*.bin"):
        file.rename(sparse / "0" / file.name)
    with contextlib.redirect_stdout(io.StringIO()):  # it prints all cameras where there are several
        colmap_to_json(sparse / "0", partial)
    for name in ("images", "sparse"):
        shutil.rmtree(out / name, ignore_errors=True)
    for name in ("images", "sparse", "sparse_pc.ply", "transforms.json"):  # the last one says that all are there
        (partial / name).rename(out / name)
    progress.advance(task)


def summarize(names: Sequence[str], model: Path, database: Path) -> Summary:
    """Count what was registered, and find out why the rest was not."""
    reconstruction = pycolmap.Reconstruction(model)
    registered = {image.name for image in reconstruction.images.values() if image.has_pose}
    left_out = {}
    with pycolmap.Database.open(database) as opened:
        identities = {image.name: image.image_id for image in opened.read_all_images()}
        pair_ids, inliers = opened.read_two_view_geometry_num_inliers()
        matches = dict.fromkeys(identities.values(), 0)
        for pair, count in zip(pair_ids, inliers, strict=True):
            for identity in pycolmap.pair_id_to_image_pair(pair):
                matches[identity] = max(matches[identity], count)
        for name in set(names) - registered:
            identity = identities.get(name)
            if identity is None:
                left_out[name] = "could not be read"
            elif (count := opened.num_keypoints_for_image(identity)) < FEW_FEATURES:
                left_out[name] = f"only {count} features: blurred, dark or without texture"
            elif matches[identity] < 30:
                left_out[name] = "matches no other photo: too little overlap"
            else:
                left_out[name] = "matches other photos, but its pose stayed ambiguous"
    return Summary(
        len(names),
        len(registered),
        reconstruction.num_points3D(),
        reconstruction.compute_mean_reprojection_error(),
        left_out,
    )


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
        matching: Which pairs are matched; auto is sequential for videos, exhaustive up to `EXHAUSTIVE_LIMIT` photos,
            beyond that by GPS positions or a vocabulary.
        frames: How many frames of a video are taken.
        max_size: Longest side of the undistorted photos in px; 0 keeps them as they are.
        camera_per_photo: Every photo has a focal length of its own. Otherwise those of one size share a camera, unless
            EXIF tells of several cameras or focal lengths.

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
            chosen = film_frames(source, frames)
            _note(settings, noted)  # before anything else lies in the folder, so that an interrupted run can go on
            partial = _empty_folder(work / "frames.partial")
            write_frames(chosen, partial)
            partial.rename(photos)
        names = sorted(photo.name for photo in photos.glob("*.jpg"))
    else:
        photos, names = source, settings["photos"]
    groups = [[name] for name in names] if camera_per_photo else photos_by_camera(photos, names)
    _note(settings, noted)  # of a folder only now, when its photos are known to be readable
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


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


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
