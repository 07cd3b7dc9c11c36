"""What nerfstudio reads of a scene: `transforms.json`, and its points in `sparse_pc.ply`.

nerfstudio's own writer takes 30 µs a point, and reads all keypoints again, which takes seconds. Here it writes the
cameras alone.
"""

from __future__ import annotations

import contextlib
import io
import json
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pycolmap

from sadgs_ns.placing.photos import in_order

POINTS = "sparse_pc.ply"
_HEADER = """ply
format ascii 1.0
element vertex {}
property float x
property float y
property float z
property uint8 red
property uint8 green
property uint8 blue
end_header
"""
_AT_ONCE = 10_000  # Points that are turned into text together


def write_transforms(made: pycolmap.Reconstruction, folder: Path, colmap_to_json: Callable[..., int]) -> None:
    """Write `transforms.json` and `sparse_pc.ply` of an undistorted model to a folder, as nerfstudio does.

    Args:
        made: The model, with the cameras of the undistorted images.
        folder: Where the files are written.
        colmap_to_json: nerfstudio's writer.
    """
    cameras = pycolmap.Reconstruction(made)
    cameras.delete_all_points2D_and_points3D()
    cameras.add_point3D(np.zeros(3), pycolmap.Track(), np.zeros(3, np.uint8))  # It cannot write a scene without any.
    with tempfile.TemporaryDirectory(dir=folder) as bare:
        cameras.write(bare)
        with contextlib.redirect_stdout(io.StringIO()):  # It prints all cameras where there are several.
            colmap_to_json(Path(bare), folder, ply_filename=POINTS)
    described = json.loads((folder / "transforms.json").read_text("utf8"))
    applied = np.array(described["applied_transform"], np.float32)
    write_points(made, applied, folder / POINTS)


def write_points(model: pycolmap.Reconstruction, applied: np.ndarray, file: Path) -> None:
    """Write the points of a model as text, in the order of their file, after a transformation. float32 [3, 4]"""
    points = [model.points3D[point_id] for point_id in sorted(model.points3D)]
    with file.open("w") as text:
        text.write(_HEADER.format(len(points)))
        for start in range(0, len(points), _AT_ONCE):
            some = points[start : start + _AT_ONCE]
            places = np.array([point.xyz for point in some], np.float32)
            places = places @ applied[:, :3].T + applied[:, 3]
            colours = np.array([point.color for point in some])
            values = np.concatenate([places.astype(float), colours], axis=1).ravel()
            text.write("%8f %8f %8f %d %d %d\n" * len(some) % tuple(values.tolist()))


def hold_out_panoramas(file: Path, rigs: Sequence[Sequence[str]]) -> None:
    """Hold out every tenth panorama whole, or photo, from the fifth; of fewer nerfstudio chooses single views."""
    described = json.loads(file.read_text())
    first = {view: views[0] for views in rigs for view in views}
    names = in_order([frame["file_path"] for frame in described["frames"]])
    whole = {name: first.get(name.removeprefix("images/"), name) for name in names}
    chosen = list(dict.fromkeys(whole.values()))[4::10]
    held_out = [name for name in names if whole[name] in chosen]
    if held_out:
        described["train_filenames"] = [name for name in names if whole[name] not in chosen]
        described |= {"val_filenames": held_out, "test_filenames": held_out}
        file.write_text(json.dumps(described, indent=4))
