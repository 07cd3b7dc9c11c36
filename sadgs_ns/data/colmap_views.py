"""The views of a COLMAP reconstruction, binary or text."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sadgs_ns.data import colmap
from sadgs_ns.data.views import Camera, View, check_positive
from sadgs_ns.errors import InputError

UNSUPPORTED_CAMERAS = {"FULL_OPENCV", "FOV", "THIN_PRISM_FISHEYE"}  # COLMAP's camera models that nerfstudio cannot read


def read_views(poses_path: Path, cameras_path: Path) -> tuple[list[str], list[View]]:
    """Return the names and the views of all images.

    Raises InputError if there is no image, or if nerfstudio cannot use a pose or a camera.
    """
    stored = colmap.read_cameras(cameras_path)
    poses = colmap.read_poses(poses_path)
    if not poses:
        raise InputError(f"{poses_path} holds no pose, so there is no image to train on: run COLMAP's mapper again.")
    for name, camera_id, pose in poses:
        where = f"{poses_path}: image {name}"
        if not np.isfinite(pose).all():
            raise InputError(f"{where} has NaN or infinity in its pose: run COLMAP's mapper again.")
        if not 0.99 < np.linalg.norm(pose[:4]) < 1.01:
            raise InputError(f"{where} has a rotation that is no unit quaternion: run COLMAP's mapper again.")
        if camera_id not in stored:
            raise InputError(f"{where} has camera {camera_id}, which {cameras_path} lacks: take both of one model.")
    where_cameras = {}
    cameras = {}
    for camera_id, camera in stored.items():
        where_camera = f"{cameras_path}: camera {camera_id}"
        where_cameras[camera_id] = where_camera
        cameras[camera_id] = _camera(camera, where_camera)
    are_fisheye = [cameras[camera_id].fisheye for _, camera_id, _ in poses]
    if any(are_fisheye) and not all(are_fisheye):
        problem = f"{cameras_path} mixes fisheye and other cameras, which nerfstudio cannot read"
        raise InputError(f"{problem}: undistort the images with `colmap image_undistorter`.")
    rotations = _rotations(np.array([pose[:4] for _, _, pose in poses]))
    names = []
    views = []
    for (name, camera_id, pose), rotation in zip(poses, rotations, strict=True):
        centre = -rotation.T @ pose[4:]
        where = f"{poses_path}: image {name}"
        names.append(name)
        views.append(View(where, where_cameras[camera_id], rotation, centre, cameras[camera_id]))
    return names, views


def _camera(camera: colmap.Camera, where: str) -> Camera:
    """Return a camera for the checks; raise InputError if nerfstudio cannot read it, or one of its values is wrong."""
    model = camera.model
    params = camera.params
    num_params = colmap.CAMERA_PARAMETERS.get(model)
    if num_params is None or model in UNSUPPORTED_CAMERAS:
        problem = f"{where} has the model {model}, which nerfstudio cannot read"
        raise InputError(f"{problem}: undistort the images with `colmap image_undistorter`.")
    num_focals = 2
    if model.startswith("SIMPLE") or "RADIAL" in model:
        num_focals = 1
    values: dict[str, float] = {"width": camera.width, "height": camera.height}
    for axis, focal in zip("xy", params[:num_focals], strict=False):
        values[f"focal length {axis}"] = focal
    check_positive(values, where, list(values))
    if not np.isfinite(params).all() or len(params) != num_params:
        raise InputError(f"{where} has {params} instead of {num_params} finite parameters: run COLMAP's mapper again.")
    fx = params[0]
    fy = params[num_focals - 1]
    cx, cy, *radial = params[num_focals:]
    tangential = []
    if model == "OPENCV":
        *radial, p1, p2 = radial
        tangential = [p1, p2]
    fisheye = "FISHEYE" in model
    return Camera(camera.width, camera.height, fx, fy, cx, cy, tuple(radial), tuple(tangential), fisheye)


def _rotations(quats: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return wxyz quaternions [V, 4] as matrices [V, 3, 3]; scipy would take half a second to import."""
    quats = quats[:, None] / np.linalg.norm(quats, axis=1)[:, None, None]  # [V, 1, 4]
    cross = np.cross(np.eye(3), quats[..., 1:])  # The matrix of the cross product with the axis. [V, 3, 3]
    return np.eye(3) + 2 * (quats[..., :1] * cross + cross @ cross)  # Rodrigues' formula
