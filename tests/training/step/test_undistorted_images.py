"""Images that training undistorts keep the detail of their photos."""

from __future__ import annotations

import cv2
import numpy as np
import pycolmap
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType

from helpers.drawn_textures import energy, photograph, psnr
from sadgs_ns.training.step.undistortion import Undistortion, Warp, apply_warp

WIDTH = 360
HEIGHT = 240
FOCAL = 0.9 * WIDTH
COEFFICIENTS = {
    "OPENCV": (CameraType.PERSPECTIVE, [-0.12, 0.02, 0.0, 0.0, 0.001, -0.001], [-0.12, 0.02, 0.001, -0.001]),
    "OPENCV_FISHEYE": (CameraType.FISHEYE, [0.05, 0.01, 0.002, 0.001, 0.0, 0.0], [0.05, 0.01, 0.002, 0.001]),
}
"""Camera type and coefficients as nerfstudio orders them, and as COLMAP does."""


def camera_of(kind: str) -> Cameras:
    camera_type, distortion, _ = COEFFICIENTS[kind]
    pose = torch.eye(4)[:3]
    cameras = Cameras(
        pose[None], FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT, torch.tensor([distortion]), camera_type
    )
    return cameras[0].reshape(())


@pytest.mark.parametrize("kind", COEFFICIENTS)
def test_images_keep_the_detail_of_their_photos(kind: str):
    undistortion = Undistortion(camera_of(kind))
    lens = pycolmap.Camera(
        model=kind, width=WIDTH, height=HEIGHT, params=[FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, *COEFFICIENTS[kind][2]]
    )
    K = undistortion.K
    params = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
    pinhole = pycolmap.Camera(model="PINHOLE", width=undistortion.width, height=undistortion.height, params=params)
    period = 3.0 / FOCAL  # The finest wave has 3 px.
    photo = photograph(lens, period)
    truth = photograph(pinhole, period)
    warp = undistortion.warp()
    image, mask = undistortion({}, photo, warp)
    assert warp is not None
    assert mask is None
    assert image.shape == truth.shape
    bilinear = np.asarray(cv2.remap(photo, warp.x, warp.y, cv2.INTER_LINEAR), np.uint8)
    assert 0.9 <= energy(image) / energy(truth) <= 1.05
    assert energy(bilinear) / energy(truth) < 0.75
    assert psnr(image, truth) > psnr(bilinear, truth) + 3


def test_what_lies_outside_the_photo_is_black_and_opacity_does_not_overshoot():
    x, y = np.meshgrid(np.arange(20, dtype=np.float32) - 4, np.arange(10, dtype=np.float32))
    outside = x < -0.5
    image = np.zeros((10, 20, 4), np.uint8)
    image[:, 10:] = 200
    warped = apply_warp(image, Warp(x + np.float32(0.5), y, outside))
    assert not warped[outside].any()
    actual = set(np.unique(warped[..., 3]))
    assert actual == {0, 100, 200}
