"""Undistorted images keep the detail of their photos, in the cameras that COLMAP would give them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray
from PIL import Image

from sadgs_ns.placing import undistortion
from sadgs_ns.placing.undistortion import read_pixels, undistorted_camera, without_distortion, write_image

WIDTH, HEIGHT = 360, 240
SAMPLES = 4
"""Samples along a pixel's side, whose mean is its colour, as a sensor measures it."""


def lens(k1: float = -0.12, width: int = WIDTH, height: int = HEIGHT) -> pycolmap.Camera:
    focal = 0.9 * width
    params = [focal, focal, width / 2, height / 2, k1, 0.02, 0.001, -0.001]
    return pycolmap.Camera(model="OPENCV", width=width, height=height, params=params, camera_id=1)


def texture(rays: NDArray[np.float64], period: float) -> NDArray[np.float64]:
    """Waves in many directions over the plane of rays [..., 2], down to a period in the rays' units. [..., 3]"""
    generator = np.random.default_rng(0)
    value = np.zeros((*rays.shape[:-1], 3))
    for _ in range(24):
        angle, phase = generator.uniform(0, 2 * np.pi, 2)
        frequency = 2 * np.pi / (period * generator.uniform(1.0, 4.0))
        wave = np.sin(frequency * (rays @ [np.cos(angle), np.sin(angle)]) + phase)
        value += wave[..., None] * generator.uniform(-1, 1, 3)
    return 127.5 + 30 * value


def photograph(camera: pycolmap.Camera, period: float) -> NDArray[np.uint8]:
    """Draw the texture as a camera sees it. [H, W, 3]"""
    x = (np.arange(camera.width * SAMPLES) + 0.5) / SAMPLES
    y = (np.arange(camera.height * SAMPLES) + 0.5) / SAMPLES
    pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    rays = np.asarray(camera.cam_from_img(pixels))[:, :2]
    values = texture(rays, period).reshape(camera.height, SAMPLES, camera.width, SAMPLES, 3)
    return np.rint(values.mean(axis=(1, 3)).clip(0, 255)).astype(np.uint8)


def energy(image: NDArray[np.uint8]) -> float:
    """Return the energy of the finest detail."""
    inside = image[8:-8, 8:-8].astype(np.float32)
    return float(np.square(cv2.Laplacian(inside, cv2.CV_32F)).mean())


def psnr(image: NDArray[np.uint8], truth: NDArray[np.uint8]) -> float:
    difference = image[8:-8, 8:-8].astype(np.float64) - truth[8:-8, 8:-8]
    return float(10 * np.log10(255**2 / np.square(difference).mean()))


@pytest.mark.parametrize("reduction", [1.0, 1.25, 1.5, 2.0, 3.0])
def test_images_keep_the_detail_of_their_photos(reduction: float):
    camera = lens()
    max_size = -1 if reduction == 1 else round(WIDTH / reduction)
    options = pycolmap.UndistortCameraOptions(max_image_size=max_size)
    new = undistorted_camera(camera, options)
    period = 3.0 * reduction / camera.focal_length_x  # The finest wave has 3 px in the image.
    photo = photograph(camera, period)
    truth = photograph(new.camera, period)
    assert new.warp is not None
    image = new.warp(photo)
    bilinear = pycolmap.undistort_image(options, pycolmap.Bitmap.from_array(photo), camera)[0].to_array()
    assert image.shape == truth.shape == bilinear.shape
    assert 0.9 <= energy(image) / energy(truth) <= 1.05
    assert psnr(image, truth) > psnr(bilinear, truth)


def test_a_step_overshoots_little():
    camera = lens()
    photo = np.full((HEIGHT, WIDTH, 3), 60, np.uint8)
    photo[:, WIDTH // 2 :] = 190
    warp = undistorted_camera(camera, pycolmap.UndistortCameraOptions()).warp
    assert warp is not None
    image = warp(photo).astype(int)
    assert image.min() >= 60 - 13 and image.max() <= 190 + 13, "a tenth of the step"


def test_the_camera_is_colmap_s_and_pixels_lie_where_it_says():
    camera = lens()
    options = pycolmap.UndistortCameraOptions(max_image_size=200)
    new = undistorted_camera(camera, options)
    assert new.camera.params.tolist() == pycolmap.undistort_camera(options, camera).params.tolist()
    ray = np.array([[0.21, -0.13, 1.0]])
    x, y = np.asarray(camera.img_from_cam(ray))[0]
    grid_y, grid_x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    spot = np.exp(-((grid_x - x) ** 2 + (grid_y - y) ** 2) / (2 * 3.0**2))
    assert new.warp is not None
    photo = (255 * spot).astype(np.uint8)[..., None].repeat(3, axis=2)
    image = new.warp(photo)[..., 0].astype(float)
    at_y, at_x = np.mgrid[: image.shape[0], : image.shape[1]] + 0.5
    found = np.array([(at_x * image).sum(), (at_y * image).sum()]) / image.sum()
    np.testing.assert_allclose(found, np.asarray(new.camera.img_from_cam(ray))[0], atol=0.05)


def test_keypoints_of_the_model_move_with_the_images():
    made = pycolmap.Reconstruction()
    camera = lens()
    made.add_camera_with_trivial_rig(camera)
    points = np.array([[20.0, 30.0], [300.0, 200.0]])
    image = pycolmap.Image(name="a.jpg", camera_id=1, image_id=1, keypoints=points)
    made.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    new = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
    model = without_distortion(made, {1: new})
    assert model.cameras[1].model_name == "PINHOLE" and made.cameras[1].model_name == "OPENCV"
    rays = np.c_[np.asarray(camera.cam_from_img(points))[:, :2], np.ones(2)]
    expected = np.asarray(new.img_from_cam(rays))
    np.testing.assert_allclose([point.xy for point in model.images[1].points2D], expected, atol=1e-9)
    np.testing.assert_allclose([point.xy for point in made.images[1].points2D], points)


def test_a_jpeg_loses_hardly_anything_and_a_png_nothing(tmp_path: Path):
    pixels = photograph(lens(width=90, height=60), 4.0 / 81)
    for name, most in (("a.jpg", 4.0), ("a.JPEG", 4.0), ("a.png", 0.0)):
        write_image(pixels, tmp_path / name)
        stored = read_pixels(tmp_path / name).astype(float)
        assert np.sqrt(np.square(stored - pixels).mean()) <= most
    with Image.open(tmp_path / "a.jpg") as image:
        assert image.format == "JPEG"


def test_photos_too_large_for_opencv_go_colmap_s_way(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(undistortion, "MOST_SIDE", WIDTH - 1)
    assert undistorted_camera(lens(), pycolmap.UndistortCameraOptions()).warp is None
