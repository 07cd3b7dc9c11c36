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


def check_camera_types(cameras: Cameras) -> None:
    """Raise InputError for the first of C cameras that neither is a pinhole nor becomes one.

    nerfstudio gives full images of any camera type to a splatting model, and undistorts those of perspective and
    fisheye cameras with a distortion coefficient other than 0. Others would be rendered wrongly, as pinholes.
    """
    for index, camera_type in enumerate(map(CameraType, cameras.camera_type.flatten().tolist())):
        where, coefficients = f"Camera {index} is {camera_type.name}", cameras.distortion_params
        if camera_type in _UNDISTORTED and (coefficients is None or not coefficients[index].any()):
            raise InputError(f"{where} {NO_COEFFICIENTS}")
        if camera_type not in (CameraType.PERSPECTIVE, *_UNDISTORTED):
            problem = f"{where}, which sadgs cannot render: it renders PERSPECTIVE cameras only"
            remedy = "Make perspective images of it (ns-process-data does so with --camera-type equirectangular)"
            raise InputError(f"{problem}. {remedy}.")


def check_undistortion(cameras: Cameras, names: Sequence[Path]) -> None:
    """Raise InputError for the first of C fisheye images that became black when nerfstudio undistorted it.

    `cameras` are those after undistortion, and `names` their files. Near a field of view of 180° OpenCV gives them a
    focal length of almost 0, or a centre far outside the image.
    """
    sizes = torch.cat([cameras.width, cameras.height], dim=-1)  # [C, 2] px
    focals, centers = torch.cat([cameras.fx, cameras.fy], dim=-1), torch.cat([cameras.cx, cameras.cy], dim=-1)
    fits = (focals > 0.01 * sizes) & (centers > 0) & (centers < sizes)  # 1 % is a field of view of 179°
    of_fisheye = (cameras.camera_type == torch.tensor([t.value for t in _UNDISTORTED]).to(cameras.camera_type)).any(-1)
    for index in (of_fisheye & ~fits.all(dim=-1)).nonzero().flatten().tolist():
        problem = f"{names[index]} is a FISHEYE image that nerfstudio could not undistort"
        why = "its field of view is too close to 180°"
        raise InputError(f"{problem}, for {why}: crop it, or undistort it yourself.")
