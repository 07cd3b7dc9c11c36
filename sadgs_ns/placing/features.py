"""SIFT features of photos, by OpenCV, which takes a quarter of COLMAP's processor time for them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from collections.abc import Set as AbstractSet
from pathlib import Path

import cv2
import numpy as np
import pycolmap
from PIL import Image

from sadgs_ns.data.images import image_size
from sadgs_ns.events import progress
from sadgs_ns.placing.matching_ahead import PhotoFeatures
from sadgs_ns.placing.panoramas import VIEWS, rotations
from sadgs_ns.placing.photos import threads, threads_in_memory

MOST_FEATURES = 8192  # Most features of a photo, those with the most contrast; COLMAP's own limit
MAX_SIDE = 3200  # Longest side in px to which photos are scaled down to find features, as COLMAP does
_CONTRAST = 0.02  # COLMAP's least contrast of a feature; a photo in [0, 1] needs a third in a scale of three an octave.
# Stand-ins for characters in names, and the way back
LISTED = str.maketrans(" #", "\x1f\x1e")
UNLISTED = str.maketrans("\x1f\x1e", " #")
_BYTES_PER_PIXEL = 240  # Memory of OpenCV for features, as measured; it doubles the photo's size first
_AT_ONCE = 256  # Photos whose features are kept, at 1 MB each, until COLMAP has read the photos and they are saved


def extract(
    photos: Path,
    groups: Sequence[Sequence[str]],
    database: Path,
    rigs: Sequence[Sequence[str]] = (),
    on_features: Callable[[PhotoFeatures], None] | None = None,
) -> None:
    """Find SIFT features in the photos of a folder that have none in COLMAP's database yet, which is made if need be.

    In `groups` the names of one camera's photos are together, in `rigs` those of one panorama's views. The folder
    `masks` beside the database may hold masks, as `write_masks` writes them. `on_features` is called with the features
    of each photo when they are saved.
    """
    names = list(itertools.chain(*groups, *rigs))
    progress("features", 0, len(names))
    rename_images(database, UNLISTED)  # A run that was interrupted during matching left them.
    with pycolmap.Database.open(database) as opened:
        done_before = {image.name for image in opened.read_all_images() if opened.exists_descriptors(image.image_id)}
    searched = [name for name in names if name not in done_before]
    done = len(done_before)
    cv2.setNumThreads(1)  # Each thread of ours has a photo.
    with threads(_num_threads([image_size(photos / name) for name in searched])) as pool:
        for start in range(0, len(searched), _AT_ONCE):
            lot = searched[start : start + _AT_ONCE]
            masks = database.with_name("masks")
            found = {name: pool.submit(sift, photos / name, masks / f"{name}.png") for name in lot}
            _add_images(database, photos, groups, rigs, {*lot})  # This takes a while, because COLMAP reads each photo.
            with pycolmap.Database.open(database) as opened:
                for image in (image for image in opened.read_all_images() if image.name in found):
                    keypoints, descriptors = found.pop(image.name).result()
                    features = pycolmap.FeatureDescriptors(type=pycolmap.FeatureExtractorType.SIFT, data=descriptors)
                    with pycolmap.DatabaseTransaction(opened):
                        opened.write_keypoints(image.image_id, keypoints)
                        opened.write_descriptors(image.image_id, features)
                    if on_features is not None:
                        on_features(PhotoFeatures(image.name, image.image_id, keypoints, descriptors))
                    done += 1
                    progress("features", done, len(names))


def rename_images(database: Path, characters: dict[int, int]) -> None:
    """Replace characters in the names of the images in COLMAP's database."""
    with pycolmap.Database.open(database) as opened, pycolmap.DatabaseTransaction(opened):
        for image in opened.read_all_images():
            name = image.name.translate(characters)
            if name != image.name:
                image.name = name
                opened.update_image(image)


def _add_images(
    database: Path, photos: Path, groups: Sequence[Sequence[str]], rigs: Sequence[Sequence[str]], lot: AbstractSet[str]
) -> None:
    """Add the photos of a lot to COLMAP's database, and their cameras, as far as they are not there yet."""
    with pycolmap.Database.open(database) as opened:
        known = {image.name: image.camera_id for image in opened.read_all_images()}
    for group in groups:
        missing = [name for name in group if name in lot and name not in known]
        if missing:
            reader = pycolmap.ImageReaderOptions(camera_model="OPENCV")
            # An earlier lot or run has made the camera.
            reader.existing_camera_id = next((known[name] for name in group if name in known), -1)
            pycolmap.import_images(database, photos, pycolmap.CameraMode.SINGLE, missing, reader)
    with pycolmap.Database.open(database) as opened:
        for camera in opened.read_all_cameras():  # EXIF may hold nonsense, which COLMAP believes.
            side = max(camera.width, camera.height)
            if not 0.1 < camera.mean_focal_length() / side < 10:  # These limits and the guess are COLMAP's own.
                camera.focal_length_x = camera.focal_length_y = 1.2 * side
                camera.has_prior_focal_length = False
                opened.update_camera(camera)
        for views in (views for views in rigs if lot & {*views} and views[0] not in known):
            with pycolmap.DatabaseTransaction(opened):
                _add_panorama(opened, photos, views)


def _add_panorama(opened: pycolmap.Database, photos: Path, views: Sequence[str]) -> None:
    """Write the views of a panorama to COLMAP's database as a frame of the rig for their size."""
    with Image.open(photos / views[0]) as image:
        side = image.width
    rigs = [rig for rig in opened.read_all_rigs() if rig.num_sensors() == VIEWS]
    rig = next((rig for rig in rigs if opened.read_camera(rig.ref_sensor_id.id).width == side), None)
    if rig is None:
        camera = pycolmap.Camera(model="PINHOLE", width=side, height=side, params=[side / 2] * 4)
        ids = [opened.write_camera(camera) for _ in views]
        to_panorama = rotations()
        rig = pycolmap.Rig()
        sensors = [pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id) for camera_id in ids]
        rig.add_ref_sensor(sensors[0])
        for sensor, rotation in zip(sensors[1:], to_panorama[1:], strict=True):
            rig.add_sensor(sensor, pycolmap.Rigid3d(pycolmap.Rotation3d(rotation.T @ to_panorama[0]), np.zeros(3)))
        rig.rig_id = opened.write_rig(rig)
    frame = pycolmap.Frame(rig_id=rig.rig_id)
    for sensor, name in zip(sorted(rig.sensor_ids(), key=lambda sensor: sensor.id), views, strict=True):
        image_id = opened.write_image(pycolmap.Image(name=name, camera_id=sensor.id))
        frame.add_data_id(pycolmap.data_t(sensor, image_id))
    opened.write_frame(frame)


def sift(photo: Path, mask: Path | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Find the SIFT features of a photo, whose EXIF orientation is ignored, except where a mask of its shape is black.

    Returns:
        N keypoints, at most about `MOST_FEATURES`, none if the photo cannot be decoded: x and y in px of the file, in
        which the first pixel's centre lies at .5; scale in px; orientation in radians. float32 [N, 4]
        Their descriptors, as COLMAP compares them: 512 times the roots of SIFT's shares (RootSIFT). uint8 [N, 128]
    """
    image = cv2.imread(str(photo), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
    points = ()
    values = None
    if image is not None:
        height, width = image.shape
        shrink = min(1.0, MAX_SIDE / max(width, height))
        if shrink < 1:
            smaller_width = max(1, round(shrink * width))
            smaller_height = max(1, round(shrink * height))
            image = cv2.resize(image, (smaller_width, smaller_height), interpolation=cv2.INTER_AREA)
        finder = cv2.SIFT.create(MOST_FEATURES, contrastThreshold=_CONTRAST, enable_precise_upscale=True)
        searched = cv2.imread(str(mask), cv2.IMREAD_GRAYSCALE) if mask and mask.exists() else None
        if searched is not None:
            searched = cv2.resize(searched, image.shape[::-1], interpolation=cv2.INTER_NEAREST)
        points, values = finder.detectAndCompute(image, searched)  # type: ignore[arg-type] # None is no mask.
    if image is None or values is None:
        return np.zeros((0, 4), np.float32), np.zeros((0, 128), np.uint8)
    stretch = np.array([width / image.shape[1], height / image.shape[0]])
    found = np.array([(*point.pt, point.size, math.radians(point.angle)) for point in points])
    keypoints = np.c_[(found[:, :2] + 0.5) * stretch, found[:, 2] / 2 * stretch[0], found[:, 3]].astype(np.float32)
    roots = np.sqrt(values / np.maximum(values.sum(axis=1, keepdims=True), 1e-6))
    return keypoints, np.clip(np.round(512 * roots), 0, 255).astype(np.uint8)


def _num_threads(sizes: Sequence[tuple[int, int]]) -> int:
    """Return how many photos of these sizes in px are searched at a time: one on each core if memory allows."""
    pixels = max((w * h * min(1.0, MAX_SIDE / max(w, h, 1)) ** 2 for w, h in sizes), default=1.0)
    return threads_in_memory(_BYTES_PER_PIXEL * pixels)
