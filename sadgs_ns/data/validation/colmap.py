"""Checks of a COLMAP reconstruction, binary or text."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from sadgs_ns.data import colmap
from sadgs_ns.data.validation.findings import Finding, collect_findings
from sadgs_ns.data.validation.geometry import Camera, View, check_points, check_positive, check_views
from sadgs_ns.data.validation.images import (
    MAX_AUTO_RESOLUTION,
    Frame,
    Rounding,
    check_images,
    image_size,
    scaled_size,
    smaller_folder,
)
from sadgs_ns.data.validation.layouts import COLMAP_FOLDERS, find_reconstruction, no_layout
from sadgs_ns.errors import InputError

UNSUPPORTED_CAMERAS = {"FULL_OPENCV", "FOV", "THIN_PRISM_FISHEYE"}
"""Those of COLMAP's camera models that nerfstudio cannot read."""


@collect_findings
def check_colmap(
    data: Path,
    *,
    images_path: Path = Path("images"),
    colmap_path: Path = Path(COLMAP_FOLDERS[0]),
    masks_path: Path | None = None,
    downscale_factor: int | None = None,
    rounding: Rounding = "floor",
    load_points: bool = True,
    training_images: Callable[[int], int] | None = lambda count: count - math.ceil(count / 8),
    open_images: bool = True,
) -> Iterator[Finding]:
    """Check a COLMAP reconstruction, binary or text.

    Args:
        data: The folder that the other paths are relative to.
        images_path, colmap_path, masks_path, downscale_factor, rounding: As of nerfstudio's parser.
        load_points, training_images, open_images: As for `check_nerfstudio`.
    """
    images_folder, model_folder = data / images_path, data / colmap_path
    kind = next((kind for kind in ("txt", "bin") if (model_folder / f"cameras.{kind}").is_file()), None)
    if kind is None:
        if (found := find_reconstruction(data)) is not None:
            raise InputError(
                f"{model_folder} holds no COLMAP reconstruction, but {data / found} does: add `--colmap-path {found}` "
                "after `colmap`."
            )
        raise InputError(no_layout(data))
    cameras_path, poses_path = model_folder / f"cameras.{kind}", model_folder / f"images.{kind}"
    cameras = colmap.read_cameras(cameras_path)
    poses = colmap.read_poses(poses_path)
    if not poses:
        raise InputError(f"{poses_path} holds no pose, so there is no image to train on: run COLMAP's mapper again.")
    for name, camera_id, pose in poses:
        where = f"{poses_path}: image {name}"
        if not np.isfinite(pose).all():
            raise InputError(f"{where} has NaN or infinity in its pose: run COLMAP's mapper again.")
        if not 0.99 < np.linalg.norm(pose[:4]) < 1.01:
            raise InputError(f"{where} has a rotation that is no unit quaternion: run COLMAP's mapper again.")
        if camera_id not in cameras:
            raise InputError(f"{where} has camera {camera_id}, which {cameras_path} lacks: take both of one model.")
    used = {camera_id: cameras[camera_id] for _, camera_id, _ in poses}
    for camera_id, camera in cameras.items():  # nerfstudio reads all of them, used or not
        _check_camera(camera, f"{cameras_path}: camera {camera_id}")
    if len({"FISHEYE" in camera.model for camera in used.values()}) > 1:
        raise InputError(
            f"{cameras_path} mixes fisheye and other cameras, which nerfstudio cannot read: undistort the images with "
            "`colmap image_undistorter`."
        )
    if not images_folder.is_dir():
        raise InputError(
            f"{poses_path} has poses of {len(poses)} images, but there is no folder {images_folder}: put them there, "
            "or add `--images-path FOLDER` after `colmap`."
        )
    training = training_images and training_images(len(poses))
    if (listed := data / "train_list.txt").is_file():
        training = len(listed.read_text(encoding="utf8").splitlines())
    views = _views(poses, used, poses_path, cameras_path)
    yield from (of_views := list(check_views(views, training, poses_path)))
    if load_points:
        wrong = any(finding.severity == "error" for finding in of_views)
        yield from _check_points(model_folder, [] if wrong else views)
    if not open_images:
        return
    factor = downscale_factor
    if factor is None:
        factor, size = 1, image_size(images_folder / poses[0][0])
        while max(size) / factor > MAX_AUTO_RESOLUTION:
            factor *= 2
    smaller = smaller_folder(images_folder, factor)
    if not all((smaller / name).parent.exists() for name, _, _ in poses):
        yield Finding(
            "warning",
            f"{images_folder} holds images of more than {MAX_AUTO_RESOLUTION} px and there is no {smaller}: nerfstudio "
            f"will ask whether to make it with ffmpeg; say yes, or add `--downscale-factor 1` after `colmap`.",
        )
        factor, smaller = 1, images_folder
    frames = []
    for name, camera_id, _ in poses:
        size = scaled_size((used[camera_id].width, used[camera_id].height), factor, rounding)
        mask = None
        if masks_path is not None:
            mask = (smaller_folder(data / masks_path, factor) / name).with_suffix(".png")
        frames.append(Frame(smaller / name, size, mask))
    yield from check_images(frames, poses_path, look_for_unused=factor == 1)


def _check_camera(camera: colmap.Camera, where: str) -> None:
    """Raise InputError if nerfstudio cannot read a camera or one of its values makes no sense."""
    if camera.model not in colmap.CAMERA_PARAMETERS or camera.model in UNSUPPORTED_CAMERAS:
        raise InputError(
            f"{where} has the model {camera.model}, which nerfstudio cannot read: undistort the images with "
            "`colmap image_undistorter`."
        )
    focals = _number_of_focals(camera.model)
    values = {"width": camera.width, "height": camera.height}
    values |= {f"focal length {axis}": value for axis, value in zip("xy", camera.params[:focals], strict=False)}
    check_positive(values, where, list(values))
    if not np.isfinite(camera.params).all() or len(camera.params) != colmap.CAMERA_PARAMETERS[camera.model]:
        raise InputError(
            f"{where} has the parameters {camera.params} instead of {colmap.CAMERA_PARAMETERS[camera.model]} finite "
            "numbers: run COLMAP's mapper again."
        )


def _views(
    poses: Sequence[colmap.Pose], cameras: Mapping[int, colmap.Camera], poses_path: Path, cameras_path: Path
) -> list[View]:
    """The poses and their cameras, as the checks of geometry take them."""
    described = {camera_id: _describe(camera) for camera_id, camera in cameras.items()}
    quats = np.array([pose[[1, 2, 3, 0]] for _, _, pose in poses])  # xyzw [V, 4]
    rotations = Rotation.from_quat(quats).as_matrix()  # [V, 3, 3]
    return [
        View(
            f"{poses_path}: image {name}",
            f"{cameras_path}: camera {camera_id}",
            rotation,
            -rotation.T @ pose[4:],
            described[camera_id],
        )
        for (name, camera_id, pose), rotation in zip(poses, rotations, strict=True)
    ]


def _describe(camera: colmap.Camera) -> Camera:
    """What COLMAP's parameters of a model that nerfstudio reads stand for."""
    focals = _number_of_focals(camera.model)
    fx, fy, (cx, cy, *rest) = camera.params[0], camera.params[focals - 1], camera.params[focals:]
    tangential = rest[2:] if camera.model == "OPENCV" else ()
    radial = rest[:2] if camera.model == "OPENCV" else rest
    fisheye = "FISHEYE" in camera.model
    return Camera(camera.width, camera.height, fx, fy, cx, cy, tuple(radial), tuple(tangential), fisheye)


def _number_of_focals(model: str) -> int:
    return 1 if model.startswith("SIMPLE") or "RADIAL" in model else 2


def _check_points(model_folder: Path, views: Sequence[View]) -> Iterator[Finding]:
    """Check the SfM points and, if there are views, how the points lie to them."""
    path = colmap.points_file(model_folder)
    random = "add `--load-3D-points False` after `colmap` to start from random points"
    if path is None:
        yield Finding(
            "error", f"{model_folder} has no points3D.bin or .txt: copy the whole reconstruction, or {random}."
        )
        return
    positions, _ = colmap.read_points(path)
    if not np.isfinite(positions).all():
        yield Finding("error", f"{path} has NaN or infinity in a point: run COLMAP's mapper again, or {random}.")
    if len(positions) == 0:
        yield Finding("error", f"{path} holds no SfM point: run COLMAP's mapper again, or {random}.")
    elif views and np.isfinite(positions).all():
        yield from check_points(positions, views, path)
