"""Which of nerfstudio's cameras this method renders right: pinholes, and fisheyes that nerfstudio undistorts."""

from __future__ import annotations

import torch
from nerfstudio.cameras.cameras import Cameras, CameraType

_UNDISTORTED = (CameraType.FISHEYE, CameraType.FISHEYE624)
"""Types whose images nerfstudio's FullImageDatamanager turns into pinhole images, if they have distortion."""


def refuse_unsupported_cameras(cameras: Cameras) -> None:
    """Let pass what is, or is made, a pinhole camera.

    nerfstudio gives full images of any camera type to a splatting model, and undistorts those of perspective and
    fisheye cameras that have a distortion coefficient other than 0. The others would be rendered, wrongly, as pinholes.

    Args:
        cameras: Of one or several images, shape [C].

    Raises:
        ValueError: If one of them is neither; it names the type, the first such camera and the remedy.
    """
    types = cameras.camera_type.flatten().cpu()  # [C]
    distorted = torch.zeros_like(types, dtype=torch.bool)
    if cameras.distortion_params is not None:
        distorted = (cameras.distortion_params.reshape(len(types), -1) != 0).any(dim=1).cpu()
    for index, (number, undistorts) in enumerate(zip(types.tolist(), distorted.tolist(), strict=True)):
        camera_type = CameraType(number)
        if camera_type is CameraType.PERSPECTIVE or (camera_type in _UNDISTORTED and undistorts):
            continue
        if camera_type in _UNDISTORTED:
            raise ValueError(
                f"Camera {index} is {camera_type.name} with all distortion coefficients 0, and nerfstudio undistorts "
                "no such image: undistort the images yourself, or give one coefficient a tiny value (k1 = 1e-9)."
            )
        raise ValueError(
            f"Camera {index} is {camera_type.name}, which sadgs cannot render: it renders PERSPECTIVE cameras only. "
            "Make perspective images of it (ns-process-data does so with --camera-type equirectangular)."
        )
