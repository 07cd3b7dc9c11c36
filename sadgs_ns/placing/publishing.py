"""Moves a finished reconstruction to the folder of the scene."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

from sadgs_ns.data.coordinates import FRAME_KEYS
from sadgs_ns.errors import InputError, WriteError
from sadgs_ns.placing.conversion import restore_alpha
from sadgs_ns.placing.photos import read_photos

_KEPT_KEYS = (*FRAME_KEYS, "train_filenames", "val_filenames", "test_filenames")  # Kept when photos are added


def publish(undistorted: Path, out: Path, grown: bool) -> None:
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
