"""The intrinsics of cameras while photos are placed: few parameters first, all of them in the end.

COLMAP estimates all parameters of a camera from the first two photos on. Two photos can be explained by many values of
the eight parameters of OPENCV, and photos that are placed after a wrong choice do not fit: of the capture lund, 2 to 4
of 29 photos registered in five of five placings on a GPU host. With one focal length and one coefficient of distortion
24 to 29 did in eight of eight. On five other captures placing takes .9 to 1.3 times as long, and on mouse a quarter to
three quarters. A lens whose pixels are not square, or whose distortion is complicated, is known well enough by then:
the other parameters are only refined.
"""

from __future__ import annotations

import contextlib
from collections.abc import Collection, Iterator
from pathlib import Path

import pycolmap

_SIMPLE = "SIMPLE_RADIAL"  # COLMAP's model with one focal length and one coefficient of distortion
_WHOLE = "OPENCV"  # COLMAP's model with two focal lengths and four coefficients


@contextlib.contextmanager
def few_parameters(database: Path, fixed_cameras: Collection[int]) -> Iterator[None]:
    """Give the cameras of COLMAP's database one focal length and one coefficient of distortion within this context.

    `fixed_cameras` stay as they are. Afterwards all other cameras have the parameters of OPENCV again. This includes
    cameras that still have few parameters because an earlier run was killed within this context.
    """
    _change_cameras(database, _SIMPLE, fixed_cameras)
    try:
        yield
    finally:
        _change_cameras(database, _WHOLE, fixed_cameras)


def _change_cameras(database: Path, name: str, fixed_cameras: Collection[int]) -> None:
    """Give the cameras of a database another model, with the focal length that is known so far and no distortion."""
    with pycolmap.Database.open(database) as opened:
        for camera in opened.read_all_cameras():
            if camera.camera_id in fixed_cameras or camera.model_name not in (_SIMPLE, _WHOLE):
                continue
            focal = camera.mean_focal_length()
            changed = pycolmap.Camera.create_from_model_name(camera.camera_id, name, focal, camera.width, camera.height)
            changed.has_prior_focal_length = camera.has_prior_focal_length
            opened.update_camera(changed)


def free_all_parameters(model: pycolmap.Reconstruction) -> None:
    """Give cameras with few parameters those of OPENCV; each projects points to the same pixels as before."""
    for camera in model.cameras.values():
        if camera.model_name == _SIMPLE:
            focal, x, y, distortion = camera.params
            camera.model = pycolmap.CameraModelId.OPENCV
            camera.params = [focal, focal, x, y, distortion, 0.0, 0.0, 0.0]
