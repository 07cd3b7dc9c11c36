"""What speaks against a model, on models whose cameras and observations are known."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np
import pycolmap
import pytest

from sadgs_ns.data.level import LARGEST_TILT
from sadgs_ns.placing.judgement import CRITERIA, Judgement, Measures, judge, measure

SIDE = 640
FOCAL_LENGTH = 600.0
SOUND = Measures(widest=60, narrowest=45, stretch=1.01, observations=500, parallax=15, shift=0.03)


def turned(angle: float) -> np.ndarray:
    """The rotation to the axes of a camera (x right, y down, z ahead) that is turned to the right. [3, 3]"""
    return cv2.Rodrigues(np.array([0.0, -angle, 0.0]))[0]


def orbit(count: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Rotations and centres of cameras on an arc around points at (0, 0, 5)."""
    angles = np.linspace(-0.4, 0.4, count)
    rotations = [turned(angle) for angle in angles]
    centres = [np.array([0, 0, 5.0]) - 5 * rotation[2] for rotation in rotations]
    return rotations, centres


def points_ahead(count: int = 300) -> np.ndarray:
    """Points around (0, 0, 5). [count, 3]"""
    return np.random.default_rng(0).uniform((-1, -1, 4), (1, 1, 6), (count, 3))


def model_of(
    rotations: Sequence[np.ndarray],
    centres: Sequence[np.ndarray],
    points: np.ndarray,
    places: Sequence[np.ndarray] | None = None,
    focal_lengths: Sequence[tuple[float, float]] = ((FOCAL_LENGTH, FOCAL_LENGTH),),
) -> pycolmap.Reconstruction:
    """A model in which each photo shows all points, and photo i has the camera i modulo their number.

    Args:
        rotations: To the cameras' axes. [3, 3] each
        centres: Of the cameras. [3] each
        points: N points. [N, 3]
        places: Where each photo shows them, in px; as projected by default. [N, 2] each
        focal_lengths: Of each camera in px.
    """
    model = pycolmap.Reconstruction()
    for number, (fx, fy) in enumerate(focal_lengths, 1):
        params = [fx, fy, SIDE / 2, SIDE / 2]
        camera = pycolmap.Camera(model="PINHOLE", width=SIDE, height=SIDE, params=params, camera_id=number)
        model.add_camera_with_trivial_rig(camera)
    if places is None:
        places = [projected(rotation, centre, points) for rotation, centre in zip(rotations, centres, strict=True)]
    for i, (rotation, centre) in enumerate(zip(rotations, centres, strict=True)):
        observed = pycolmap.Point2DList([pycolmap.Point2D(place) for place in places[i]])
        camera_id = i % len(focal_lengths) + 1
        image = pycolmap.Image(name=f"{i}.png", image_id=i + 1, camera_id=camera_id, points2D=observed)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ centre)
        model.add_image_with_trivial_frame(image, pose)
    for number, point in enumerate(points):
        elements = [pycolmap.TrackElement(i + 1, number) for i in range(len(rotations))]
        model.add_point3D(point, pycolmap.Track(elements))
    return model


def projected(rotation: np.ndarray, centre: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Where a camera shows points, in px. [N, 2]"""
    seen = (points - centre) @ rotation.T
    return FOCAL_LENGTH * seen[:, :2] / seen[:, 2:] + SIDE / 2


def reasons(model: pycolmap.Reconstruction) -> Judgement:
    return judge(measure(model))


def test_nothing_speaks_against_cameras_around_an_object():
    measures = measure(model_of(*orbit(12), points_ahead()))
    assert measures.widest == measures.narrowest == pytest.approx(56.14, abs=0.01)
    assert measures.stretch == 1
    assert measures.observations == 300
    assert 40 < measures.parallax < 50
    assert measures.shift > 0.01
    assert judge(measures) == Judgement([], [])
    assert judge(SOUND).is_sound


@pytest.mark.hard_case(
    "the angle of view, the number of points or the parallax of found cameras is impossible",
    "exit code 1 with the reason and the remedy; the files are kept, and `--anyway` goes on",
)
@pytest.mark.parametrize(
    ("field", "doubtful", "wrong", "reason"),
    [
        ("widest", 125, 135.5, r"they would see 136° across, more than a lens does: take a step"),
        ("narrowest", 5, 0.32, r"they would see 0\.32° across, less than a lens does: zoom less"),
        ("stretch", 1.5, 175.8, r"their focal lengths across and down would differ by a factor of 175\.8: take a step"),
        ("observations", 30, 6, r"half of the photos show at most 6 points: take sharp photos"),
        ("parallax", 2.2, 1.6, r"half of the points are seen from directions within 1\.6° of each other: take a step"),
        (
            "disagreement",
            0.03,
            0.13,
            r"with other random samples they move by 13 % of a photo's size: take",
        ),
        ("shift", 0.003, 0.001, r"as if the camera had turned on the spot, to 0\.10 % of their size: take a step"),
    ],
)
def test_each_measure_beyond_its_limits_is_a_reason(field: str, doubtful: float, wrong: float, reason: str):
    doubt = judge(dataclasses.replace(SOUND, **{field: doubtful}))
    assert len(doubt.doubts) == 1
    assert not doubt.faults
    assert not doubt.is_sound
    fault = judge(dataclasses.replace(SOUND, **{field: wrong}))
    assert not fault.doubts
    assert not fault.is_sound
    with pytest.raises(AssertionError, match=reason):
        raise AssertionError(*fault.faults)


def test_a_camera_that_is_tilted_to_all_sides_is_a_doubt_at_most():
    doubt = judge(dataclasses.replace(SOUND, tilt=22.5))
    (reason,) = doubt.doubts
    assert reason.startswith("the camera would have been tilted to all sides, by 22°, as if parts of the scene were")
    assert not doubt.faults
    assert judge(dataclasses.replace(SOUND, tilt=7.5)).is_sound
    assert not judge(dataclasses.replace(SOUND, tilt=35.2)).faults


def test_a_model_whose_halves_are_turned_is_tilted():
    rotations, centres = orbit(12)
    level = measure(model_of(rotations, centres, points_ahead()))
    assert level.tilt == pytest.approx(0, abs=1e-5)
    over = cv2.Rodrigues(np.array([0.0, 0.0, np.pi / 2]))[0]
    middle = np.array([0, 0, 5.0])
    for i in range(0, 12, 2):
        rotations[i] = rotations[i] @ over.T
        centres[i] = over @ (centres[i] - middle) + middle
    turned_half = measure(model_of(rotations, centres, points_ahead()))
    assert turned_half.tilt > LARGEST_TILT


def test_every_measure_has_a_criterion():
    expected = [field.name for field in dataclasses.fields(Measures)]
    assert [criterion.measure for criterion in CRITERIA] == expected


@pytest.mark.parametrize("focal_lengths", [(131, 131), (78934, 449)])
def test_focal_lengths_of_wrong_models_are_told(focal_lengths: tuple[float, float]):
    """One was found for brackets of six poses, one for pairs of fisheye circles."""
    model = model_of(*orbit(6), points_ahead(), focal_lengths=[focal_lengths])
    assert any("they would see" in fault for fault in reasons(model).faults)


def test_the_focal_length_of_a_single_photo_is_not_held_against_all():
    model = model_of(*orbit(10), points_ahead(), focal_lengths=[(78934, 78934), *[(FOCAL_LENGTH, FOCAL_LENGTH)] * 9])
    assert reasons(model).is_sound
    model = model_of(*orbit(10), points_ahead(), focal_lengths=[(78934, 78934), *[(FOCAL_LENGTH, FOCAL_LENGTH)] * 4])
    assert len(reasons(model).faults) == 1


def test_few_points_and_none_are_told():
    few = reasons(model_of(*orbit(6), points_ahead(6)))
    assert few.faults == [few.faults[0]]
    assert "at most 6 points" in few.faults[0]
    none = reasons(model_of(*orbit(6), points_ahead(0)))
    assert none.faults == [none.faults[0]]
    assert "at most 0 points" in none.faults[0]


def test_points_far_away_have_hardly_any_parallax():
    rotations = [turned(angle) for angle in np.linspace(-0.1, 0.1, 6)]
    centres = [np.array([x, 0, 0]) for x in np.linspace(0, 0.12, 6)]
    (fault, *_) = reasons(model_of(rotations, centres, points_ahead())).faults
    assert "half of the points are seen from directions within 1.4°" in fault


@pytest.mark.hard_case(
    "photos by a camera that only turned, of which COLMAP makes a model with false depths", "told by their points' ways"
)
def test_a_camera_that_turned_on_the_spot_is_told_whatever_the_model_says():
    """The model has sound angles between rays, and a focal length that is too long."""
    rotations = [turned(angle) for angle in np.linspace(-0.2, 0.2, 12)]
    places = [projected(rotation, np.zeros(3), points_ahead()) for rotation in rotations]
    model = model_of(*orbit(12), points_ahead(), places, [(1.8 * FOCAL_LENGTH, 1.8 * FOCAL_LENGTH)])
    assert measure(model).parallax > 40
    (fault,) = reasons(model).faults
    assert "as if the camera had turned on the spot" in fault


def test_brackets_of_several_poses_are_no_camera_that_turned():
    rotations, centres = orbit(6)
    assert reasons(model_of(rotations * 3, centres * 3, points_ahead())).is_sound


def test_flat_ground_from_straight_above_is_no_camera_that_turned():
    xs, ys = np.meshgrid(np.linspace(-1, 1, 5), np.linspace(-1, 1, 4))
    centres = [np.array([x, y, 0]) for x, y in zip(xs.flat, ys.flat, strict=True)]
    ground = points_ahead() * (1.6, 1.6, 0) + (0, 0, 5)  # All photos show this much of it.
    assert reasons(model_of([np.eye(3)] * 20, centres, ground)).is_sound


def test_a_model_without_tracks_is_judged_by_its_cameras_alone():
    model = model_of(*orbit(6), points_ahead())
    for image in model.images.values():
        for number in range(image.num_points2D()):
            image.reset_point3D_for_point2D(number)
    for point in model.points3D.values():
        point.track = pycolmap.Track()
    measures = measure(model)
    assert np.isnan([measures.observations, measures.parallax, measures.shift]).all()
    assert judge(measures).is_sound
