"""Undistort the photos of a model: take the lens out of the images, and keep their detail.

COLMAP undistorts with bilinear interpolation, which loses a third to half of the energy of the finest detail, and
samples photos that it reduces by less than two. Here an image is warped with Lanczos's filter at the photo's own size,
and then reduced with a bicubic filter as wide as the reduction. Of the finest waves, averaging by area keeps 69 to 90 %
of the energy where the bicubic filter keeps 90 to 104 %, in photos that are reduced by 1.25 to 3. The cameras are
COLMAP's.
"""

from __future__ import annotations

import contextlib
import copy
import functools
import shutil
import threading
from collections.abc import Callable, Collection, Mapping
from concurrent.futures import Future, as_completed
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray
from PIL import Image

from sadgs_ns.events import progress, span
from sadgs_ns.placing.model_files import check_written, move_keypoints
from sadgs_ns.placing.photos import threads, threads_in_memory

MOST_SIDE = 32_766  # Longest side in px that OpenCV warps
JPEG_QUALITY = 97  # With colours at full resolution; each photo is encoded a second time.
_BYTES_PER_PIXEL = 24  # Memory of a thread: photo, maps of both axes, and the warped image
_JPEG_SUFFIXES = {".jpg", ".jpeg"}

Warp = Callable[[NDArray[np.uint8]], NDArray[np.uint8]]
"""Takes a photo [H, W, 3] and returns its undistorted image [H', W', 3]."""


class Undistortion:
    """A context in which threads write the undistorted images of a model while its files are written.

    They lie in `images`, `alpha` and `masks` of the folder `undistorted`, and their model in its `sparse/0`. Call
    `begin`, `write_model` and `wait` in this order. Leaving the context early drops the images that are not begun.
    """

    def __init__(self, photos: Path, model: Path, max_size: int, known: Collection[str]) -> None:
        """Take the options.

        Args:
            photos: The photos' folder.
            model: The model's folder; beside it lie `write_alpha`'s and `write_masks`' files, and `undistorted`.
            max_size: Longest side of the images in px; 0 keeps them as they are.
            known: Names of photos that were undistorted before.
        """
        self.folder = model.with_name("undistorted")
        self._photos = photos
        self._model = model
        self._known = known
        self._options = pycolmap.UndistortCameraOptions(max_image_size=max_size or -1)
        self._pool = contextlib.ExitStack()
        self._work: list[Future[None]] = []
        self._cameras: dict[int, pycolmap.Camera] = {}
        self._one_at_a_time = threading.Lock()
        # A warp takes 8 bytes a pixel, and each photo may have a camera of its own.
        self._warp_of_camera = functools.lru_cache(maxsize=2)(self._make_warp)

    def __enter__(self) -> Undistortion:
        return self

    def __exit__(self, *error: object) -> None:
        self._pool.close()

    def begin(self, made: pycolmap.Reconstruction) -> None:
        """Make the folder anew, and begin to write the images of a model; its colours may still change."""
        shutil.rmtree(self.folder, ignore_errors=True)
        registered = [image for image in made.images.values() if image.has_pose and image.name not in self._known]
        registered.sort(key=lambda image: image.camera_id)  # The photos of a camera share its warp.
        self._cameras = {image.camera_id: copy.copy(made.cameras[image.camera_id]) for image in registered}
        cv2.setNumThreads(1)  # Each thread of ours has a photo.
        pool = self._pool.enter_context(threads(_num_threads(self._cameras.values())))
        self._work = [pool.submit(self._write, image.name, image.camera_id) for image in registered]

    def write_model(self, made: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
        """Write the model of the images, given that of the photos. Raise OSError if the disk is full.

        Returns:
            The model with the cameras of the images. Its keypoints stay where they are in the photos; those in the file
            lie where they are in the images.
        """
        cameras = {image.camera_id: made.cameras[image.camera_id] for image in made.images.values()}
        undistorted = {key: pycolmap.undistort_camera(self._options, camera) for key, camera in cameras.items()}
        sparse = self.folder / "sparse" / "0"
        sparse.mkdir(parents=True)
        model = _with_cameras(made, undistorted)
        model.write(sparse)
        check_written(sparse, model)
        move_keypoints(sparse, cameras, undistorted)
        return model

    def wait(self) -> None:
        """Wait until all images are written. Raise OSError if one cannot be."""
        progress("undistorted photos", 0, len(self._work))
        with span("rest of undistortion"):
            for done, finished in enumerate(as_completed(self._work), 1):
                finished.result()
                progress("undistorted photos", done, len(self._work))

    def _make_warp(self, camera_id: int) -> Warp | None:
        return warp_of(self._cameras[camera_id], self._options)

    def _write(self, name: str, camera_id: int) -> None:
        """Write the image of a photo, and its opacity and mask if it has them."""
        target = self.folder / "images" / name
        target.parent.mkdir(parents=True, exist_ok=True)
        camera = self._cameras[camera_id]
        with self._one_at_a_time:
            warp = self._warp_of_camera(camera_id)
        if warp is None:
            write_as_colmap(self._photos / name, camera, self._options, target)
        else:
            write_image(warp(read_pixels(self._photos / name)), target)
        for kind in ("alpha", "masks"):
            stored = self._model.with_name(kind) / f"{name}.png"
            if stored.exists():
                grey = self.folder / kind / f"{name}.png"
                write_grey(stored, camera, self._options, grey, is_mask=kind == "masks")


def warp_of(camera: pycolmap.Camera, options: pycolmap.UndistortCameraOptions) -> Warp | None:
    """Return the warp from a photo of `camera` to an image of COLMAP's undistorted camera.

    It undistorts a photo at its full size, and then reduces the image to the size that `options` ask for. None if a
    side is longer than `MOST_SIDE`.
    """
    final = pycolmap.undistort_camera(options, camera)
    full_size = pycolmap.undistort_camera(pycolmap.UndistortCameraOptions(), camera)
    if max(camera.width, camera.height, full_size.width, full_size.height) > MOST_SIDE:
        return None
    map_x, map_y = maps_of(camera, full_size)
    size = (final.width, final.height)

    def warp(photo: NDArray[np.uint8]) -> NDArray[np.uint8]:
        image = cv2.remap(photo, map_x, map_y, cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REFLECT_101)
        if (full_size.width, full_size.height) != size:
            # Pillow's filters grow with the reduction; OpenCV's do not.
            image = Image.fromarray(image).resize(size, Image.Resampling.BICUBIC)
        return np.asarray(image, np.uint8)

    return warp


def maps_of(camera: pycolmap.Camera, undistorted: pycolmap.Camera) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return where in a photo each pixel of the undistorted image lies, as OpenCV counts: from pixels' centres.

    x and y in px. float32 [H, W] each
    """
    x = np.arange(undistorted.width) + 0.5
    y = np.arange(undistorted.height) + 0.5
    pixels = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    rays = np.asarray(undistorted.cam_from_img(pixels))[:, :2]
    points = np.c_[rays, np.ones(len(rays))]  # At depth 1 before the camera. [H · W, 3]
    in_photo = np.asarray(camera.img_from_cam(points)) - 0.5
    maps = in_photo.astype(np.float32).reshape(undistorted.height, undistorted.width, 2)
    return np.ascontiguousarray(maps[..., 0]), np.ascontiguousarray(maps[..., 1])


def read_pixels(photo: Path) -> NDArray[np.uint8]:
    """Read a photo as it lies in its file, not turned by EXIF, as COLMAP does. RGB [H, W, 3]"""
    pixels = cv2.imread(str(photo), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if pixels is None:
        raise _missing(photo)
    return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB), np.uint8)


def _missing(photo: Path) -> OSError:
    return OSError(f"{photo} cannot be read any more: put it back, and run the same command again")


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
        raise _missing(photo)
    undistorted, _ = pycolmap.undistort_image(options, bitmap, camera)
    undistorted.write(target)


def write_grey(
    stored: Path, camera: pycolmap.Camera, options: pycolmap.UndistortCameraOptions, target: Path, *, is_mask: bool
) -> None:
    """Undistort a photo's opacity, or its mask, which stays black and white."""
    target.parent.mkdir(parents=True, exist_ok=True)
    grey = pycolmap.Bitmap.read(stored, as_rgb=False)
    assert grey is not None  # `write_alpha` or `write_masks` wrote it.
    undistorted, _ = pycolmap.undistort_image(options, grey, camera)
    if is_mask:
        is_white = undistorted.to_array() > 127
        undistorted = pycolmap.Bitmap.from_array(np.uint8(255 * is_white))
    undistorted.write(target)


def _with_cameras(made: pycolmap.Reconstruction, cameras: Mapping[int, pycolmap.Camera]) -> pycolmap.Reconstruction:
    """Return a copy of a model that has other cameras, by their numbers; its keypoints stay where they are."""
    model = pycolmap.Reconstruction(made)
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
    return threads_in_memory(_BYTES_PER_PIXEL * pixels)
