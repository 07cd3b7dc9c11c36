"""Undistorted images keep the detail of their photos, in the cameras that COLMAP would give them."""

from __future__ import annotations

import threading
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image

from helpers.drawn_textures import energy, photograph, psnr
from sadgs_ns.placing import undistortion
from sadgs_ns.placing.undistortion import Undistortion, read_pixels, warp_of, write_image

WIDTH = 360
HEIGHT = 240


def lens(k1: float = -0.12, width: int = WIDTH, height: int = HEIGHT) -> pycolmap.Camera:
    focal = 0.9 * width
    params = [focal, focal, width / 2, height / 2, k1, 0.02, 0.001, -0.001]
    return pycolmap.Camera(model="OPENCV", width=width, height=height, params=params, camera_id=1)


@pytest.mark.parametrize("reduction", [1.0, 1.25, 1.5, 2.0, 3.0])
def test_images_keep_the_detail_of_their_photos(reduction: float):
    camera = lens()
    max_size = -1 if reduction == 1 else round(WIDTH / reduction)
    options = pycolmap.UndistortCameraOptions(max_image_size=max_size)
    undistorted = pycolmap.undistort_camera(options, camera)
    warp = warp_of(camera, options)
    period = 3.0 * reduction / camera.focal_length_x  # The finest wave has 3 px in the image.
    photo = photograph(camera, period)
    truth = photograph(undistorted, period)
    assert warp is not None
    image = warp(photo)
    bilinear = pycolmap.undistort_image(options, pycolmap.Bitmap.from_array(photo), camera)[0].to_array()
    assert image.shape == truth.shape == bilinear.shape
    assert 0.9 <= energy(image) / energy(truth) <= 1.05
    assert psnr(image, truth) > psnr(bilinear, truth)


def test_a_step_overshoots_little():
    camera = lens()
    photo = np.full((HEIGHT, WIDTH, 3), 60, np.uint8)
    photo[:, WIDTH // 2 :] = 190
    warp = warp_of(camera, pycolmap.UndistortCameraOptions())
    assert warp is not None
    image = warp(photo).astype(int)
    assert image.min() >= 60 - 13, "a tenth of the step"
    assert image.max() <= 190 + 13, "a tenth of the step"


def test_the_camera_is_colmap_s_and_pixels_lie_where_it_says():
    camera = lens()
    options = pycolmap.UndistortCameraOptions(max_image_size=200)
    undistorted = pycolmap.undistort_camera(options, camera)
    warp = warp_of(camera, options)
    ray = np.array([[0.21, -0.13, 1.0]])
    x, y = np.asarray(camera.img_from_cam(ray))[0]
    grid_y, grid_x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    spot = np.exp(-((grid_x - x) ** 2 + (grid_y - y) ** 2) / (2 * 3.0**2))
    assert warp is not None
    photo = (255 * spot).astype(np.uint8)[..., None].repeat(3, axis=2)
    image = warp(photo)[..., 0].astype(float)
    at_y, at_x = np.mgrid[: image.shape[0], : image.shape[1]] + 0.5
    found = np.array([(at_x * image).sum(), (at_y * image).sum()]) / image.sum()
    expected = np.asarray(undistorted.img_from_cam(ray))[0]
    assert_allclose(found, expected, atol=0.05)


def test_each_photo_has_its_camera_s_warp_and_no_warp_is_made_twice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Photos of two sizes lie in turns, and a third camera has a photo that was undistorted before."""
    photos = tmp_path / "photos"
    photos.mkdir()
    made = pycolmap.Reconstruction()
    cameras = {1: lens(-0.12, 90, 60), 2: lens(0.1, 60, 90), 3: lens(-0.1, 80, 50)}
    for camera_id, camera in cameras.items():
        camera.camera_id = camera_id
        made.add_camera_with_trivial_rig(camera)
    for image_id, camera_id in enumerate([1, 2, 1, 2, 3], 1):
        name = f"{image_id}.png"
        Image.fromarray(photograph(cameras[camera_id], 0.1)).save(photos / name)
        image = pycolmap.Image(name=name, camera_id=camera_id, image_id=image_id)
        made.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    asked: list[tuple[int, int]] = []

    def counted(camera: pycolmap.Camera, options: pycolmap.UndistortCameraOptions) -> undistortion.Warp | None:
        asked.append((camera.width, camera.height))
        return warp_of(camera, options)

    monkeypatch.setattr(undistortion, "warp_of", counted)
    with undistortion.Undistortion(photos, tmp_path / "model", 0, {"5.png"}) as images:
        images.begin(made)
        images.write_model(made)
        images.wait()
    assert asked == [(90, 60), (60, 90)]
    model = pycolmap.Reconstruction(tmp_path / "undistorted/sparse/0")
    options = pycolmap.UndistortCameraOptions()
    for camera_id, camera in cameras.items():
        expected = pycolmap.undistort_camera(options, camera)
        assert model.cameras[camera_id].params.tolist() == expected.params.tolist()
    written = sorted((tmp_path / "undistorted/images").iterdir())
    names = [file.name for file in written]
    assert names == ["1.png", "2.png", "3.png", "4.png"]
    for file in written:
        camera = cameras[made.images[int(file.stem)].camera_id]
        warp = warp_of(camera, options)
        assert warp is not None
        assert_array_equal(read_pixels(file), warp(read_pixels(photos / file.name)))


def model_of_photos(folder: Path, number: int) -> pycolmap.Reconstruction:
    """Write equal photos, and return a model in which each has a pose."""
    folder.mkdir()
    made = pycolmap.Reconstruction()
    camera = lens(-0.12, 90, 60)
    made.add_camera_with_trivial_rig(camera)
    for image_id in range(1, number + 1):
        name = f"{image_id}.png"
        Image.fromarray(photograph(camera, 0.1)).save(folder / name)
        image = pycolmap.Image(name=name, camera_id=1, image_id=image_id)
        made.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    return made


def test_a_photo_that_is_gone_is_named_when_the_model_is_written(tmp_path: Path):
    made = model_of_photos(tmp_path / "photos", 3)
    (tmp_path / "photos/2.png").unlink()
    with undistortion.Undistortion(tmp_path / "photos", tmp_path / "model", 0, ()) as images:
        images.begin(made)
        images.write_model(made)
        with pytest.raises(OSError, match=r"2\.png cannot be read any more"):
            images.wait()


def test_images_that_are_not_begun_are_dropped_where_the_files_fail(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    made = model_of_photos(tmp_path / "photos", 4)
    goes_on = threading.Event()
    read = read_pixels

    def read_late(photo: Path) -> np.ndarray:
        assert goes_on.wait(60)
        return read(photo)

    monkeypatch.setattr(undistortion, "read_pixels", read_late)
    monkeypatch.setattr(undistortion, "threads_in_memory", lambda bytes_of_photo: 1)
    images = undistortion.Undistortion(tmp_path / "photos", tmp_path / "model", 0, ())
    with pytest.raises(OSError, match="full"), images:
        images.begin(made)
        threading.Timer(0.2, goes_on.set).start()
        raise OSError("full")
    assert len(list((tmp_path / "undistorted/images").glob("*.png"))) <= 1


def drawn_model() -> pycolmap.Reconstruction:
    """Return a model of two cameras and four images: one has no keypoints, and one no pose."""
    made = pycolmap.Reconstruction()
    made.add_camera_with_trivial_rig(lens())
    other = lens(k1=0.05, width=300)
    other.camera_id = 2
    made.add_camera_with_trivial_rig(other)
    keypoints = {
        1: [[20.0, 30.0], [300.0, 200.0]],
        2: [],
        3: [[17.5, 4.25], [150.0, 99.5], [290.0, 3.0]],
        4: [[1.0, 2.0]],
    }
    names = {1: "a.jpg", 2: "rooms/häuser.jpg", 3: "c", 4: "d.jpg"}
    for number, points in keypoints.items():
        camera_id = 1 + number % 2
        places = np.array(points).reshape(-1, 2)
        image = pycolmap.Image(name=names[number], camera_id=camera_id, image_id=number, keypoints=places)
        if number == 4:
            frame = pycolmap.Frame(rig_id=camera_id, frame_id=number)
            frame.add_data_id(image.data_id)
            made.add_frame(frame)
            image.frame_id = number
            made.add_image(image)
        else:
            made.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    track = pycolmap.Track()
    track.add_element(1, 1)
    track.add_element(3, 2)
    made.add_point3D(np.array([0.1, 0.2, 3.0]), track, np.zeros(3, np.uint8))
    return made


def test_keypoints_of_the_model_move_with_the_images(tmp_path: Path):
    """Each keypoint lies where COLMAP's cameras put it, one after the other."""
    made = drawn_model()
    images = Undistortion(tmp_path, tmp_path / "model", 0, ())
    returned = images.write_model(made)
    model = pycolmap.Reconstruction(images.folder / "sparse/0")
    assert sorted(model.images) == [1, 2, 3]
    for number, image in model.images.items():
        before = made.images[number]
        camera = made.cameras[before.camera_id]
        new = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
        assert camera.model_name == "OPENCV"
        assert model.cameras[image.camera_id].model_name == "PINHOLE"
        assert image.name == before.name
        assert image.num_points2D() == before.num_points2D()
        for keypoint, keypoint_before in zip(image.points2D, before.points2D, strict=True):
            ray = np.append(np.asarray(camera.cam_from_img(keypoint_before.xy))[:2], 1.0)
            assert_allclose(keypoint.xy, np.asarray(new.img_from_cam(ray)), atol=1e-9)
            assert keypoint.point3D_id == keypoint_before.point3D_id
    assert model.points3D[1].track.length() == 2
    assert {camera.model_name for camera in returned.cameras.values()} == {"PINHOLE"}


def test_a_full_disk_is_told_before_keypoints_are_moved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    write = pycolmap.Reconstruction.write

    def write_half(self: pycolmap.Reconstruction, folder: Path) -> None:
        write(self, folder)
        file = folder / "images.bin"
        file.write_bytes(file.read_bytes()[:200])

    monkeypatch.setattr(pycolmap.Reconstruction, "write", write_half)
    images = Undistortion(tmp_path, tmp_path / "model", 0, ())
    with pytest.raises(OSError, match="the disk is full"):
        images.write_model(drawn_model())


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
    assert warp_of(lens(), pycolmap.UndistortCameraOptions()) is None
