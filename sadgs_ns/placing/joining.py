"""Joins cameras that folders kept apart and that turn out to be one.

Photos of several cameras often lie in a folder for each, and where EXIF is silent nothing else tells them apart. So
each folder has a camera of its own until the focal lengths are known.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

import pycolmap

_SAME_FOCAL_LENGTH = 0.01  # Largest difference of the focal lengths of one camera, as a share


def same_cameras(
    model: pycolmap.Reconstruction, alike: Sequence[Sequence[str]], fixed_cameras: Collection[int]
) -> dict[int, int]:
    """Return the cameras of a model that are most likely another one, with that one.

    Args:
        model: The model.
        alike: The names of photos that differ in their folder alone; only cameras of these are compared.
        fixed_cameras: Cameras whose intrinsics stay. Others may be joined to them, but not they to others.
    """
    cameras = {image.name: image.camera_id for image in model.images.values() if image.has_pose}
    targets: dict[int, int] = {}
    for names in alike:
        counts = Counter(cameras[name] for name in names if name in cameras)
        order = sorted(counts, key=lambda camera_id: (camera_id not in fixed_cameras, -counts[camera_id], camera_id))
        kept: list[int] = []
        for camera_id in order:
            target = None
            if camera_id not in fixed_cameras:
                target = _first_same(model.cameras[camera_id], [model.cameras[other] for other in kept])
            if target is None:
                kept.append(camera_id)
            else:
                targets[camera_id] = target
    return targets


def _first_same(camera: pycolmap.Camera, others: Sequence[pycolmap.Camera]) -> int | None:
    """Return the first of the others with the same size and focal lengths, or None."""
    for other in others:
        across = abs(camera.focal_length_x / other.focal_length_x - 1)
        down = abs(camera.focal_length_y / other.focal_length_y - 1)
        is_size = (camera.width, camera.height) == (other.width, other.height)
        if is_size and max(across, down) < _SAME_FOCAL_LENGTH:
            return other.camera_id
    return None


def join_cameras(model: pycolmap.Reconstruction, targets: Mapping[int, int]) -> pycolmap.Reconstruction:
    """Return a copy of a model in which some cameras are replaced by others of it, as `same_cameras` returns them.

    COLMAP cannot change the camera of an image that has points, so the copy is made of the model's parts.
    """
    joined = pycolmap.Reconstruction()
    for camera in model.cameras.values():
        if camera.camera_id not in targets:
            joined.add_camera(camera)
    for rig in model.rigs.values():
        if rig.ref_sensor_id.id not in targets:
            joined.add_rig(rig)
    rigs = _rigs_of_cameras(model.rigs.values())
    for frame in model.frames.values():
        joined.add_frame(_joined_frame(frame, targets, rigs))
    for image in model.images.values():
        joined.add_image(_joined_image(image, targets))
    for frame_id in model.reg_frame_ids():
        joined.register_frame(frame_id)
    for point_id, point in model.points3D.items():
        joined.add_point3D_with_id(point_id, point)
    return joined


def join_in_database(database: Path, targets: Mapping[int, int]) -> None:
    """Replace cameras in COLMAP's database as `join_cameras` does, so that photos can be added to the joined model."""
    with pycolmap.Database.open(database) as opened, pycolmap.DatabaseTransaction(opened):
        rigs = _rigs_of_cameras(opened.read_all_rigs())
        images = opened.read_all_images()  # Before any change, because COLMAP checks them against the frames.
        for frame in opened.read_all_frames():
            if any(data.sensor_id.id in targets for data in frame.data_ids):
                opened.update_frame(_joined_frame(frame, targets, rigs))
        for image in images:
            if image.camera_id in targets:
                image.camera_id = targets[image.camera_id]
                opened.update_image(image)


def _rigs_of_cameras(rigs: Collection[pycolmap.Rig]) -> dict[int, int]:
    """Return the rig of each camera that is alone in its rig, as all that are no views of panoramas are."""
    return {rig.ref_sensor_id.id: rig.rig_id for rig in rigs if rig.num_sensors() == 1}


def _joined_frame(frame: pycolmap.Frame, targets: Mapping[int, int], rigs: Mapping[int, int]) -> pycolmap.Frame:
    """Return a copy of a frame with its cameras replaced; `rigs` has the rig of each camera."""
    joined = pycolmap.Frame(frame_id=frame.frame_id, rig_id=frame.rig_id)
    if frame.has_pose:
        joined.rig_from_world = frame.rig_from_world
    for data in frame.data_ids:
        sensor = data.sensor_id
        if sensor.id in targets:
            target = targets[sensor.id]
            sensor = pycolmap.sensor_t(sensor.type, target)
            joined.rig_id = rigs[target]
        joined.add_data_id(pycolmap.data_t(sensor, data.id))
    return joined


def _joined_image(image: pycolmap.Image, targets: Mapping[int, int]) -> pycolmap.Image:
    """Return a copy of an image with its camera replaced, and without its points, which points bring along."""
    places = pycolmap.Point2DList([pycolmap.Point2D(place.xy) for place in image.points2D])
    camera_id = targets.get(image.camera_id, image.camera_id)
    return pycolmap.Image(
        name=image.name, image_id=image.image_id, camera_id=camera_id, frame_id=image.frame_id, points2D=places
    )
