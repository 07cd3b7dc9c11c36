"""nerfstudio's cameras: this method renders pinholes, and fisheyes that nerfstudio undistorts."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch
from nerfstudio.cameras.cameras import Cameras, CameraType
from torch import Tensor

from sadgs_ns.data.views import NO_COEFFICIENTS
from sadgs_ns.errors import InputError

_UNDISTORTED = (CameraType.FISHEYE, CameraType.FISHEYE624)
"""Types whose images nerfstudio's FullImageDatamanager turns into pinhole images, if a coefficient is not 0."""


def camera_positions(cameras: Cameras) -> Tensor:
    """Return the centres of cameras in world units. [C, 3]"""
    return cameras.camera_to_worlds[:, :3, 3].cpu()


TRAINING_VIEW = "training_view"
"""Key in cameras' metadata: the index of the training view that each one is, −1 of others. int64 [C, 1]"""


def mark_training_views(cameras: Cameras, names: Sequence[Path], training: Sequence[Path]) -> None:
    """Note in the metadata of cameras, by their images' names, which training view each one is."""
    numbers = {name: number for number, name in enumerate(training)}
    views = torch.tensor([[numbers.get(name, -1)] for name in names], device=cameras.device).view(-1, 1)
    cameras.metadata = {**(cameras.metadata or {}), TRAINING_VIEW: views}


def training_view(camera: Cameras) -> int | None:
    """Return the index of the training view that a camera, shape [1], is; None if it is none."""
    number = (camera.metadata or {}).get(TRAINING_VIEW)
    if not isinstance(number, Tensor) or number.numel() != 1 or int(number) < 0:
        return None
    return int(number)


def mean_pixels(cameras: Cameras) -> float:
    """Return the mean number of pixels of C cameras' images."""
    return float((cameras.height * cameras.width).double().mean())


def check_camera_types(cameras: Cameras) -> None:
    """Raise InputError for the first of C cameras that neither is a pinhole nor becomes one, or that has no pixel.

    nerfstudio gives full images of any camera type to a splatting model, and undistorts those of perspective and
    fisheye cameras with a distortion coefficient other than 0. Others would be rendered wrongly, as pinholes.
    """
    coefficients = cameras.distortion_params  # [C, 6 or 12] or None
    for index, number in enumerate(cameras.camera_type.flatten().tolist()):
        camera_type = CameraType(number)
        where = f"Camera {index} is {camera_type.name}"
        width = int(cameras.width.flatten()[index])
        height = int(cameras.height.flatten()[index])
        if min(width, height) < 1:
            raise InputError(f"Camera {index} has {width} × {height} px: give it, or its path, a larger size.")
        if camera_type in _UNDISTORTED:
            if coefficients is None or not coefficients[index].any():
                raise InputError(f"{where} {NO_COEFFICIENTS}")
        elif camera_type != CameraType.PERSPECTIVE:
            problem = f"{where}, which sadgs cannot render: it renders PERSPECTIVE cameras only"
            remedy = "Make perspective images of it (ns-process-data does so with --camera-type equirectangular)"
            raise InputError(f"{problem}. {remedy}.")


def check_drawn_cameras(cameras: Cameras) -> None:
    """Raise InputError for the first of C cameras that a picture or a camera path asks for and that cannot be drawn.

    The viewer's own types other than perspective cameras have no coefficients of a lens that could be undone.
    """
    coefficients = cameras.distortion_params  # [C, 6 or 12] or None
    for index, number in enumerate(cameras.camera_type.flatten().tolist()):
        camera_type = CameraType(number)
        is_undistorted = camera_type in _UNDISTORTED and coefficients is not None and bool(coefficients[index].any())
        if camera_type != CameraType.PERSPECTIVE and not is_undistorted:
            problem = f"Camera {index} of the path is {camera_type.name}, which sadgs cannot draw"
            raise InputError(f"{problem}: choose the camera type Perspective in the viewer, and save the path again.")
    check_camera_types(cameras)


def check_undistortion(cameras: Cameras, names: Sequence[Path]) -> None:
    """Raise InputError for the first of C fisheye images that became black when nerfstudio undistorted it.

    `cameras` are those after undistortion, and `names` their files. Near a field of view of 180° OpenCV gives them a
    focal length of almost 0, or a centre far outside the image.
    """
    sizes = torch.cat([cameras.width, cameras.height], dim=-1)  # [C, 2] px
    focals = torch.cat([cameras.fx, cameras.fy], dim=-1)  # [C, 2] px
    centers = torch.cat([cameras.cx, cameras.cy], dim=-1)  # [C, 2] px
    has_focals = (focals > 0.01 * sizes).all(dim=-1)  # 1 % is a field of view of 179°
    has_center = ((centers > 0) & (centers < sizes)).all(dim=-1)
    fisheyes = torch.tensor([camera_type.value for camera_type in _UNDISTORTED]).to(cameras.camera_type)
    is_fisheye = (cameras.camera_type == fisheyes).any(dim=-1)  # [C]
    is_black = is_fisheye & ~(has_focals & has_center)
    for index in is_black.nonzero().flatten().tolist():
        problem = f"{names[index]} is a FISHEYE image that nerfstudio could not undistort"
        raise InputError(f"{problem}, for its field of view is too close to 180°: crop it, or undistort it yourself.")
