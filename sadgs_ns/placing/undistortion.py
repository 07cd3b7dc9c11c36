"""Undistort the photos of a model: take the lens out of the images, and keep their detail.

COLMAP undistorts with bilinear interpolation, which loses a third to half of the energy of the finest detail, and
samples photos that it reduces by less than two. Here an image is warped with Lanczos's filter at the photo's own size,
and then reduced with a bicubic filter as wide as the reduction. Of the finest waves, averaging by area keeps 69 to 90 %
of the energy where the bicubic filter keeps 90 to 104 %, in photos that are reduced by 1.25 to 3. The cameras are
COLMAP's.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Collection
from concurrent.futures import as_completed
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray
from PIL import Image

from sadgs_ns.events import progress
from sadgs_ns.host_memory import available_host_bytes
from sadgs_ns.placing.photos import threads

MOST_SIDE = 32_766  # Longest side in px that OpenCV warps
JPEG_QUALITY = 97  # With colours at full resolution; each photo is encoded a second time.
_BYTES_PER_PIXEL = 24  # Memory of a thread: photo, maps of both axes, and the warped image
_JPEG_SUFFIXES = {".jpg", ".jpeg"}

Warp = Callable[[NDArray[np.uint8]], NDArray[np.uint8]]
"""Takes a photo [H, W, 3] and returns its undistorted image [H', W', 3]."""


@dataclass(frozen=True)
class UndistortedCamera:
    """The camera of undistorted images, and the way from a photo to one."""

    camera: pycolmap.Camera
    warp: Warp | None  # None where a side is longer than `MOST_SIDE`


def undistort(photos: Path, model: Path, made: pycolmap.Reconstruction, max_size: int, known: Collection[str]) -> None:
    """Write `images`, `alpha`, `masks` and their model, `sparse/0`, to the folder `undistorted`, which is made anew.

    Raise OSError if a file cannot be written.

    Args:
        photos: The photos' folder.
        model: The model's folder; beside it lie `write_alpha`'s and `write_masks`' files.
        made: The model in that folder.
        max_size: Longest side of the images in px; 0 keeps them as they are.
        known: Names of photos that were undistorted before.
    """
    folder = model.with_name("undistorted")
    shutil.rmtree(folder, ignore_errors=True)
    registered = [image for image in made.images.values() if image.has_pose and image.name not in known]
    options = pycolmap.UndistortCameraOptions(max_image_size=max_size or -1)
    cameras = {image.camera_id: made.cameras[image.camera_id] for image in made.images.values()}
    undistorted = {camera_id: undistorted_camera(camera, options) for camera_id, camera in cameras.items()}

    def write(name: str, camera_id: int) -> None:
        target = folder / "images" / name
        target.parent.mkdir(parents=True, exist_ok=True)
        warp = undistorted[camera_id].warp
        if warp is None:
            write_as_colmap(photos / name, cameras[camera_id], options, target)
        else:
            write_image(warp(read_pixels(photos / name)), target)
        for kind in ("alpha", "masks"):
            stored = model.with_name(kind) / f"{name}.png"
            if stored.exists():
                write_grey(stored, cameras[camera_id], options, folder / kind / f"{name}.png", is_mask=kind == "masks")

    progress("undistorted photos", 0, len(registered))
    cv2.setNumThreads(1)  # Each thread of ours has a photo.
    with threads(_num_threads(cameras.values())) as pool:
        work = [pool.submit(write, image.name, image.camera_id) for image in registered]
        for done, finished in enumerate(as_completed(work), 1):
            finished.result()
            progress("undistorted photos", done, len(registered))
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True)
    without_distortion(made, {camera_id: new.camera for camera_id, new in undistorted.items()}).write(sparse)


def undistorted_camera(camera: pycolmap.Camera, options: pycolmap.UndistortCameraOptions) -> UndistortedCamera:
    """Return COLMAP's camera of undistorted images, and the warp from a photo of `camera` to an image."""
    final = pycolmap.undistort_camera(options, camera)
    whole_size = pycolmap.UndistortCameraOptions()
    whole = pycolmap.undistort_camera(whole_size, camera)
    if max(camera.width, camera.height, whole.width, whole.height) > MOST_SIDE:
        return UndistortedCamera(final, None)
    map_x, map_y = maps_of(camera, whole)
    size = (final.width, final.height)

    def warp(photo: NDArray[np.uint8]) -> NDArray[np.uint8]:
        image = cv2.remap(photo, map_x, map_y, cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REFLECT_101)
        if (whole.width, whole.height) != size:
            # Pillow's filters grow with the reduction; OpenCV's do not.
            image = Image.fromarray(image).resize(size, Image.Resampling.BICUBIC)
        return np.asarray(image, np.uint8)

    return UndistortedCamera(final, warp)


def maps_of(camera: pycolmap.Camera, undistorted: pycolmap.Camera) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return where in a photo each pixel of the undistorted image lies, as OpenCV counts: from pixels' centres.

    x and y in px. float32 [H, W] each
    """
    x = np.arange(undistorted.width) + 0.5
    y = np.arange(undistorted.height) + 0.5
    pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    rays = np.asarray(undistorted.cam_from_img(pixels))[:, :2]
    in_photo = np.asarray(camera.img_from_cam(np.c_[rays, np.ones(len(rays))])) - 0.5
    maps = in_photo.astype(np.float32).reshape(undistorted.height, undistorted.width, 2)
    return np.ascontiguousarray(maps[..., 0]), np.ascontiguousarray(maps[..., 1])


def read_pixels(photo: Path) -> NDArray[np.uint8]:
    """Read a photo as it lies in its file, not turned by EXIF, as COLMAP does. RGB [H, W, 3]"""
    pixels = cv2.imread(str(photo), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if pixels is None:
        raise OSError(f"{photo} cannot be read any more: put it back, and run the same command again")
    return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB), np.uint8)


def write_image(pixels: NDArray[np.uint8], target: Path) -> None:
    """Write an image in the format of its name, a JPEG with hardly a loss."""
    image = Image.fromarray(pixels)
    if target.suffix.lower() in _JPEG_SUFFIXES:
        image.save(target, quality=JPEG_QUALITY, subsampling=0)
    else:
        image.save(target)


def write_as_colmap(
    photo: Path, camera: pycolmap.Camera, options: pycolmap.UndistortCameraOptions, target: Path
) -> None:
    """Undistort a photo by COLMAP's own interpolation."""
    bitmap = pycolmap.Bitmap.read(photo, as_rgb=True)
    if bitmap is None:
        raise OSError(f"{photo} cannot be read any more: put it back, and run the same command again")
    pycolmap.undistort_image(options, bitmap, camera)[0].write(target)


def write_grey(
    stored: Path, camera: pycolmap.Camera, options: pycolmap.UndistortCameraOptions, target: Path, *, is_mask: bool
) -> None:
    """Undistort a photo's opacity, or its mask, which stays black and white."""
    target.parent.mkdir(parents=True, exist_ok=True)
    grey = pycolmap.Bitmap.read(stored, as_rgb=False)
    assert grey is not None  # `write_alpha` or `write_masks` wrote it.
    grey = pycolmap.undistort_image(options, grey, camera)[0]
    if is_mask:
        grey = pycolmap.Bitmap.from_array(np.uint8(255 * (grey.to_array() > 127)))
    grey.write(target)


def without_distortion(made: pycolmap.Reconstruction, cameras: dict[int, pycolmap.Camera]) -> pycolmap.Reconstruction:
    """Return a copy of a model with other cameras, in whose images its keypoints lie then."""
    model = pycolmap.Reconstruction(made)
    for image in model.images.values():
        points = image.points2D
        if len(points) == 0:
            continue
        distorted = np.array([point.xy for point in points])
        rays = np.asarray(made.cameras[image.camera_id].cam_from_img(distorted))[:, :2]
        undistorted = np.asarray(cameras[image.camera_id].img_from_cam(np.c_[rays, np.ones(len(rays))]))
        for point, xy in zip(points, undistorted, strict=True):
            point.xy = xy
    for camera_id, new in cameras.items():
        camera = model.cameras[camera_id]
        camera.model = new.model
        camera.width = new.width
        camera.height = new.height
        camera.params = new.params
    return model


def _num_threads(cameras: Collection[pycolmap.Camera]) -> int:
    """Return how many photos are undistorted at a time: one on each core, if memory allows."""
    pixels = max((camera.width * camera.height for camera in cameras), default=1)
    in_memory = 0.5 * available_host_bytes() / (_BYTES_PER_PIXEL * pixels)
    return max(1, int(min(os.cpu_count() or 1, in_memory)))
