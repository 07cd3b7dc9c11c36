"""The training cameras of a run as `transforms.json`, with the poses that the run refined."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from sadgs_ns.data.coordinates import FRAME_KEYS, Similarity
from sadgs_ns.data.run_cameras import RunCameras
from sadgs_ns.errors import InputError
from sadgs_ns.files import atomic_path
from sadgs_ns.geometry.poses import corrected
from sadgs_ns.geometry.rigid import inverse_rigid
from sadgs_ns.render.rasterization import viewmats_from_camera_to_world

_TABLE = "_model.poses.table"
_COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")


def write_cameras(path: Path, pipeline: Mapping[str, Any], cameras: RunCameras, similarity: Similarity | None) -> None:
    """Write the training cameras of a checkpoint's pipeline, and print whether it refined them.

    `cameras` are those of the capture, and the similarity maps the run's frame to the file's. Call
    `check_images` before. Raises InputError if the cameras are of a type that cannot be written, WriteError if writing
    fails.
    """
    if cameras.distortion is not None and cameras.distortion.shape[1] > len(_COEFFICIENTS):
        raise InputError("--cameras cannot write cameras of the type FISHEYE624: leave it out.")
    poses = cameras.camera_to_worlds
    table = pipeline.get(_TABLE)
    origin = "as the capture has them"
    if table is not None:
        origin = "refined"
        poses = refined(poses, table)
    frame: dict[str, Any] = {}
    if similarity is None:  # Training on this file keeps the frame.
        frame = dict(zip(FRAME_KEYS, (np.eye(4)[:3].tolist(), 1.0), strict=True))
    else:
        poses = torch.from_numpy(similarity.poses(poses.double().numpy()))
    frames = []
    for index, pose in enumerate(poses.tolist()):
        image = _name_from(path.parent, cameras.images[index])
        transform = [*pose, [0.0, 0.0, 0.0, 1.0]]
        frames.append({"file_path": image} | _frame(cameras, index) | {"transform_matrix": transform})
    content = {"camera_model": cameras.camera_model, **frame, "frames": frames}
    with atomic_path(path) as partial:
        partial.write_text(json.dumps(content, indent=2), "utf8")
    print(f"{path}: {len(frames)} training cameras, {origin}")


def _name_from(folder: Path, image: Path) -> str:
    """Return the path of an image from a folder that it lies in or below, or else the absolute one."""
    real = Path(os.path.realpath(image.parent)) / image.name
    root = Path(os.path.realpath(folder))
    if real.is_relative_to(root):
        return real.relative_to(root).as_posix()
    return str(real)


def refined(
    camera_to_worlds: Tensor,  # [C, 3, 4]
    table: Tensor,  # [C, 6]
) -> Tensor:
    """Return nerfstudio's poses after corrections in the cameras' frames. float64 [C, 3, 4]"""
    viewmats = corrected(viewmats_from_camera_to_world(camera_to_worlds.double()), table.double())
    refined_to_worlds = inverse_rigid(viewmats)[:, :3]
    flip = viewmats.new_tensor([1.0, -1.0, -1.0, 1.0])
    return refined_to_worlds * flip


def check_images(pipeline: Mapping[str, Any], cameras: RunCameras) -> None:
    """Raise InputError if the capture's training images are not those of the checkpoint."""
    before = pipeline.get("_extra_state", {}).get("images")
    now = [path.name for path in cameras.images]
    if before is None or before == now:
        return
    capture_has = f"The capture has {len(now)} training images, {now[0]}, …"
    run_had = f"the run had {len(before)}, {before[0]}, …"
    raise InputError(f"{capture_has}, and {run_had}: give the run's capture with --data.")


def _frame(cameras: RunCameras, index: int) -> dict[str, Any]:
    """Return a camera's size, intrinsics and distortion as a frame of `transforms.json` has them."""
    K = cameras.Ks[index].tolist()
    width, height = cameras.sizes[index]
    frame: dict[str, Any] = {"w": width, "h": height}
    frame |= {"fl_x": K[0][0], "fl_y": K[1][1], "cx": K[0][2], "cy": K[1][2]}
    if cameras.distortion is not None:
        frame |= dict(zip(_COEFFICIENTS, cameras.distortion[index].tolist(), strict=False))
    return frame
