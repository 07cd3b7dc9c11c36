"""The four stages from photos to a scene, each with pycolmap: features, matches, cameras and points, undistortion.

Each stage goes on where an interrupted run left it.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import shutil
import sqlite3
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import pycolmap
from rich.progress import Progress

from sadgs_ns.errors import reason

_SEED = 0
"""Seed of COLMAP's random samples, so that equal photos give nearly equal cameras; COLMAP's own seed is the clock."""
EXHAUSTIVE_LIMIT = 200
"""Photos up to which every pair is matched; twice the photos take four times as long."""
FEW_FEATURES = 500
"""Keypoints under which a photo counts as blurred or empty."""
Matching = Literal["auto", "exhaustive", "sequential", "spatial", "vocabulary"]


@dataclass(frozen=True)
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
    """Pairs of each frame with the next ones and with ever fewer of those farther on, which close loops.

    Args:
        names: In the order of the video.
        overlap: How many of the next frames each is matched with.
    """
    steps = sorted({*range(1, overlap + 1), *(2**k for k in range(4, 10))})
    return [(names[i], names[i + step]) for i in range(len(names)) for step in steps if i + step < len(names)]


def empty_folder(folder: Path) -> Path:
    """Make a folder, and remove what an interrupted run left in it."""
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
    """A connection that takes no lock, because COLMAP aborts where it meets one; what it reads may be half-written."""
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
    if matching in ("spatial", "vocabulary") or not listable:  # COLMAP's own functions tell nothing of their progress
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
                raise ValueError(f"--matching vocabulary failed ({reason(error)}); use exhaustive.") from error
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
    attempts = empty_folder(work / "models")
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
    partial = empty_folder(work / "model.partial")
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
