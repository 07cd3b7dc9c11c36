"""Cameras and points that are known: how far an adjustment brings perturbed ones back, in spite of wrong matches."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pycolmap

_PARAMS = (2400.0, 2400.0, 800.0, 600.0, -0.05, 0.01, 0.0, 0.0)
"""Parameters of the one camera, of the model OPENCV and 1600 × 1200 px. Points fill two thirds of its photos' width."""
_DISTANCE = 5.0  # Of COLMAP's drawn cameras from the middle of the points, which lie within 1 of it along each axis
_MOVED_CENTRES = 0.0004 * _DISTANCE  # Standard deviation of the perturbation along each axis
_MOVED_POINTS = 0.0004 * _DISTANCE
_TURNED = 0.02  # Standard deviation of the perturbation in degrees
_FOCAL_LENGTH = 1.001  # Perturbed focal length over the true one


@dataclass(frozen=True)
class Truth:
    """A drawn capture, whose cameras all look at the middle of its points."""

    cameras: int = 26
    points: int = 3000
    photos_of_point: int = 6  # Photos that show each point
    noise: float = 0.5  # Standard deviation of a place in a photo along each axis, in px
    wrong: float = 0.05  # Share of the observations that are wrong matches
    farthest: float = 4.0  # Largest distance in px of a wrong match, as COLMAP leaves out those that are farther off


@dataclass(frozen=True)
class Errors:
    """How far cameras lie from the true ones after a similarity, means over all."""

    centres: float  # In % of the extent of the true centres, the diagonal of the box around them
    rotations: float  # In degrees


def draw(truth: Truth, seed: int) -> tuple[pycolmap.Reconstruction, pycolmap.Reconstruction]:
    """Return the true model, and one with noise, wrong matches, and perturbed cameras and points."""
    pycolmap.set_random_seed(seed)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1,
        num_cameras_per_rig=1,
        num_frames_per_rig=truth.cameras,
        num_points3D=truth.points,
        track_length=truth.photos_of_point,
        num_points2D_without_point3D=0,
        camera_width=1600,
        camera_height=1200,
        camera_model_id=pycolmap.CameraModelId.OPENCV,
        camera_params=_PARAMS,
    )
    true = pycolmap.synthesize_dataset(options)
    perturbed = pycolmap.Reconstruction(true)
    _add_wrong_matches(perturbed, truth, seed)
    noise = pycolmap.SyntheticNoiseOptions(
        rig_from_world_translation_stddev=_MOVED_CENTRES,
        rig_from_world_rotation_stddev=_TURNED,
        point3D_stddev=_MOVED_POINTS,
        point2D_stddev=truth.noise,
    )
    pycolmap.synthesize_noise(noise, perturbed)
    for camera in perturbed.cameras.values():
        camera.focal_length_x *= _FOCAL_LENGTH
        camera.focal_length_y *= _FOCAL_LENGTH
    return true, perturbed


def _add_wrong_matches(model: pycolmap.Reconstruction, truth: Truth, seed: int) -> None:
    """Move a share of the observations, evenly over a disc."""
    random = np.random.default_rng(seed)
    for image_id in sorted(model.images):
        places = model.images[image_id].points2D
        for place in places:
            angle = random.uniform(0, 2 * np.pi)
            distance = truth.farthest * np.sqrt(random.uniform())
            if random.uniform() < truth.wrong:
                place.xy = place.xy + distance * np.array([np.cos(angle), np.sin(angle)])


def errors(model: pycolmap.Reconstruction, true: pycolmap.Reconstruction) -> Errors:
    """Return how far the cameras of a model lie from the true ones, after the similarity that fits the centres best."""
    image_ids = sorted(true.images)
    found = np.array([model.images[image_id].projection_center() for image_id in image_ids])
    expected = np.array([true.images[image_id].projection_center() for image_id in image_ids])
    similarity = pycolmap.estimate_sim3d(found, expected)
    assert similarity is not None, "there are at least three centres"
    extent = np.linalg.norm(expected.max(axis=0) - expected.min(axis=0))
    distances = np.linalg.norm(similarity * found - expected, axis=1)
    angles = []
    for image_id in image_ids:
        rotation = model.images[image_id].cam_from_world().rotation * similarity.rotation.inverse()
        angles.append(rotation.angle_to(true.images[image_id].cam_from_world().rotation))
    return Errors(float(100 * distances.mean() / extent), float(np.degrees(np.mean(angles))))
