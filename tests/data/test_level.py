"""How level cameras were held, on poses that are known."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sadgs_ns.data.checks.geometry import check_views
from sadgs_ns.data.level import FEWEST_VIEWS, LARGEST_TILT, tilt
from sadgs_ns.data.views import Camera, View

VIEWS = 24


def turned(axis: str, degrees: np.ndarray) -> np.ndarray:
    """Rotations about an axis. [V, 3, 3]"""
    return Rotation.from_euler(axis, degrees[:, None], degrees=True).as_matrix()


def around_a_table() -> np.ndarray:
    """Level cameras all around, which look down at 10 to 60°: world to camera, the world's z upwards. [V, 3, 3]"""
    yaws = turned("z", np.linspace(0, 360, VIEWS, endpoint=False))
    pitches = turned("x", np.linspace(10, 60, VIEWS))
    ahead = turned("x", np.full(VIEWS, 90.0))
    return pitches @ ahead @ yaws


def rolled(degrees: np.ndarray) -> np.ndarray:
    """The same cameras, each turned about its viewing axis. [V, 3, 3]"""
    return turned("z", degrees) @ around_a_table()


def test_level_cameras_have_no_tilt_wherever_they_look():
    across = around_a_table()[:, 0]
    assert np.abs(across[:, 2]).max() < 1e-9
    assert tilt(around_a_table()) == pytest.approx(0, abs=1e-5)


def test_the_axes_of_the_world_do_not_matter():
    world = Rotation.from_euler("xyz", (20, -50, 130), degrees=True).as_matrix()
    assert tilt(around_a_table() @ world) == pytest.approx(0, abs=1e-5)


def test_a_hand_that_shakes_is_the_tilt():
    degrees = np.random.default_rng(0).normal(0, 6, VIEWS)
    found = tilt(rolled(degrees))
    assert 3 < found < 6  # A camera that looks down turns its sides less than it is rolled.
    assert found < LARGEST_TILT


def joined_wrongly() -> np.ndarray:
    """The same cameras, every second one of which knows a world that lies on its side. [V, 3, 3]"""
    rotations = around_a_table()
    on_its_side = Rotation.from_euler("x", 88, degrees=True).as_matrix()
    rotations[::2] = rotations[::2] @ on_its_side
    return rotations


def test_halves_that_are_joined_wrongly_are_beyond_the_limit():
    assert tilt(joined_wrongly()) > LARGEST_TILT


def views_of(rotations: np.ndarray) -> list[View]:
    """Views from around a thing at the origin."""
    camera = Camera(640, 480, 500.0, 500.0, 320.0, 240.0)
    return [View(f"image {i}", "camera 1", rotation, -4 * rotation[2], camera) for i, rotation in enumerate(rotations)]


@pytest.mark.hard_case(
    "poses whose parts are joined wrongly, so that their cameras are tilted to all sides", "trains, with a warning"
)
def test_poses_that_are_joined_wrongly_are_a_warning():
    source = Path("scene/sparse/0")
    assert list(check_views(views_of(around_a_table()), VIEWS, source)) == []
    (finding,) = check_views(views_of(joined_wrongly()), VIEWS, source)
    assert finding.severity == "warning"
    assert finding.sentence.startswith("scene/sparse/0 has cameras that are tilted to all sides, by ")
    assert finding.sentence.endswith(": look at the poses in the viewer, and compute them again if parts overlap.")


def test_few_views_and_broken_poses_tell_nothing():
    assert math.isnan(tilt(around_a_table()[: FEWEST_VIEWS - 1]))
    broken = around_a_table()
    broken[3, 0, 0] = math.nan
    assert math.isnan(tilt(broken))
