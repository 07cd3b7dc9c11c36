"""Moves a finished reconstruction to the folder of the scene."""

from __future__ import annotations

import json
import shutil
from collections.abc import Collection
from pathlib import Path
from typing import Any

from sadgs_ns.data.coordinates import FRAME_KEYS
from sadgs_ns.errors import InputError, WriteError
from sadgs_ns.placing.conversion import restore_alpha
from sadgs_ns.placing.photos import read_photos

_LISTS = {"train_filenames", "val_filenames", "test_filenames"}
_KEPT_KEYS = (*FRAME_KEYS, *sorted(_LISTS))  # Kept when photos are added


def publish(undistorted: Path, out: Path, grown: bool) -> None:
    """Move undistorted photos, their model and what nerfstudio reads of it to the scene's folder.

    A finished scene that has `grown` by these photos stays one until all are there. Raise OSError if writing fails.
    """
    file = undistorted / "transforms.json"
    described = json.loads(file.read_text())
    images = [frame["file_path"] for frame in described["frames"]]
    masks = [path.relative_to(undistorted).as_posix() for path in (undistorted / "masks").rglob("*.png")]
    if masks or (grown and (out / "masks").exists()):
        for frame in described["frames"]:
            frame["mask_path"] = f"masks/{frame['file_path'].removeprefix('images/')}.png"
    if grown:
        before = json.loads((out / "transforms.json").read_text())
        _keep_known_views(described, before)
        known = {frame["file_path"] for frame in before["frames"]}
        # Somebody took photos out of transforms.json, whose images are there: they stay out.
        described["frames"] = [
            frame for frame in described["frames"] if not _is_taken_out(frame["file_path"], known, undistorted, out)
        ]
        remaining = {frame["file_path"] for frame in described["frames"]}
        for key in _LISTS & described.keys():
            described[key] = [name for name in described[key] if name in remaining]
        images = [name for name in images if name in remaining]
        images = [name for name in images if (undistorted / name).exists() or name not in known]
    file.write_text(json.dumps(described, indent=4))
    written = images + masks
    try:
        read_photos(undistorted, written, lambda *step: None)
    except InputError as error:  # COLMAP does not say when a disk is full
        raise WriteError(undistorted / "images", OSError("the disk is full")) from error
    restore_alpha(undistorted / "images", undistorted / "alpha")
    if not grown:
        _remove_scene(out)
    _move(undistorted, out, written)


def _is_taken_out(name: str, known: Collection[str], undistorted: Path, out: Path) -> bool:
    """Return whether an image of the scene was taken out of its transforms.json, and is not undistorted anew."""
    return name not in known and not (undistorted / name).exists() and (out / name).exists()


def _keep_known_views(described: dict[str, Any], before: dict[str, Any]) -> None:
    """Write the poses, the frame and the division of views from an earlier transforms.json into a new one."""
    poses = {frame["file_path"]: frame["transform_matrix"] for frame in before["frames"]}
    for frame in described["frames"]:  # Computing a pose again rounds it.
        frame["transform_matrix"] = poses.get(frame["file_path"], frame["transform_matrix"])
    for key in _KEPT_KEYS:
        if key in before:
            kept = before[key]
            if key in described and key not in FRAME_KEYS:  # The new views of panoramas are divided, too.
                kept = kept + [view for view in described[key] if view not in poses]
            described[key] = kept


def _remove_scene(out: Path) -> None:
    """Remove the images and masks of an earlier scene."""
    (out / "transforms.json").unlink(missing_ok=True)  # Its presence says that all the others are there.
    for name in ("images", "masks"):
        shutil.rmtree(out / name, ignore_errors=True)


def _move(undistorted: Path, out: Path, images: list[str]) -> None:
    """Move images and masks, then the model, and at last transforms.json."""
    for name in images:
        (out / name).parent.mkdir(parents=True, exist_ok=True)
        (undistorted / name).replace(out / name)
    shutil.rmtree(out / "sparse", ignore_errors=True)
    for name in ("sparse", "sparse_pc.ply", "transforms.json"):
        (undistorted / name).rename(out / name)
