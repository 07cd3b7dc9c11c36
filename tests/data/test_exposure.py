"""What photos tell of their exposure, on observations and on drawn photos with gains that are known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from sadgs_ns.data.exposure import (
    LEAST_STOPS,
    Exposures,
    PinholeViews,
    exif_stops,
    exposures,
    linear_light,
    relative_stops,
    srgb_values,
)
from sadgs_ns.demo.drawing import render
from sadgs_ns.demo.scene import describe_scene

GAINS = np.exp2([-1.0, 0.6, -0.4, 1.0, 0.2, -0.8, 0.9, -0.1, 0.3, -0.7])
"""Of ten photos."""


def observations(noise: float, wrong: float, views: int = 10, points: int = 2000) -> tuple[NDArray, NDArray]:
    """Brightness [P, V] of points of which each is seen by four photos in a row, and the photos' exposures [V]."""
    generator = np.random.default_rng(0)
    stops, levels = np.log2(GAINS[:views]), generator.uniform(-5, -1, points)
    light = levels[:, None] + stops + noise * generator.normal(size=(points, views))
    light = np.where(generator.random(light.shape) < wrong, generator.uniform(-8, 0, light.shape), light)
    first = generator.integers(0, views - 3, points)[:, None]
    view = np.arange(views)
    return np.where((view >= first) & (view < first + 4), light, np.nan), stops - stops.mean()


@pytest.mark.parametrize(
    ("noise", "wrong", "error"), [(0.0, 0.0, 1e-9), (0.1, 0.0, 0.05), (0.1, 0.2, 0.1), (0.3, 0.1, 0.2)]
)
def test_known_exposures_are_found_through_noise_and_outliers(noise: float, wrong: float, error: float):
    light, expected = observations(noise, wrong)
    found = relative_stops(light)
    assert found is not None
    stops, unexplained = found
    np.testing.assert_allclose(stops, expected, atol=error)
    assert 0.7 * noise <= unexplained <= 1.5 * noise + 1e-9, "of four observations of a point one number takes a part"


def test_photos_that_have_nothing_in_common_tell_nothing():
    light, expected = observations(0.0, 0.0)
    assert relative_stops(np.full((100, 5), np.nan)) is None
    assert relative_stops(np.zeros((0, 5))) is None
    assert relative_stops(light[:10]) is None, "ten points are too few"
    alone = np.full(light.shape, np.nan)
    alone[np.arange(len(light)), np.arange(len(light)) % 10] = 0.0
    assert relative_stops(alone) is None, "each point is seen once"
    some = light.copy()
    some[:, 0] = np.nan
    found = relative_stops(some)
    assert found is not None and np.isnan(found[0][0])
    np.testing.assert_allclose(found[0][1:], expected[1:] - expected[1:].mean(), atol=1e-9)


def test_exposure_varies_where_it_explains_more_than_it_leaves():
    stops = np.array([-0.5, 0.5, np.nan, 0.5, -0.5])
    assert Exposures(stops, 0.2, "pixels").varies and Exposures(stops, 0.0, "EXIF").varies
    assert Exposures(stops, 0.2, "pixels").range == pytest.approx(1.0)
    assert not Exposures(stops, 0.6, "pixels").varies
    assert not Exposures(1.9 * LEAST_STOPS * stops, 0.0, "EXIF").varies


def write_photos(folder: Path, gains: NDArray) -> tuple[PinholeViews, NDArray, NDArray]:
    """Photos of the demo's room with gains in linear light, and its SfM points with their colours."""
    scene = describe_scene(160, 120, len(gains), 1500)
    folder.mkdir()
    for view, gain in zip(scene.views, gains, strict=True):
        light = gain * 0.2 * linear_light(render(scene.surfaces, view, supersampling=2) / 255.0)
        Image.fromarray(np.rint(255 * srgb_values(light.clip(0, 1))).astype(np.uint8)).save(folder / view.name)
    views = PinholeViews(
        files=[folder / view.name for view in scene.views],
        world_to_camera=np.stack([np.column_stack([view.rotation, view.translation]) for view in scene.views]),
        intrinsics=np.array([[view.focal / 160, view.focal / 120, 0.5, 0.5] for view in scene.views]),
        distortion=np.zeros((len(gains), 6)),
    )
    return views, scene.points, scene.colours


def test_gains_of_drawn_photos_are_found_in_their_pixels(tmp_path: Path):
    views, points, colors = write_photos(tmp_path / "varying", GAINS)
    found = exposures(views, points, colors)
    assert found is not None and found.source == "pixels" and found.varies
    expected = np.log2(GAINS)
    np.testing.assert_allclose(found.stops, expected - expected.mean(), atol=0.15)

    views, points, colors = write_photos(tmp_path / "even", np.ones(10))
    found = exposures(views, points, colors)
    assert found is not None and not found.varies and np.ptp(found.stops) < 0.25


def test_a_photo_that_cannot_be_decoded_says_nothing_and_stops_nothing(tmp_path: Path):
    views, points, colors = write_photos(tmp_path / "photos", GAINS)
    views.files[3].write_bytes(b"no photo")
    views.files[5].unlink()
    found = exposures(views, points, colors)
    assert found is not None and np.flatnonzero(np.isnan(found.stops)).tolist() == [3, 5]
    assert exposures(views, points[:0], colors[:0]) is None, "without points nothing can be looked up"


def write_exif(path: Path, **tags: object) -> None:
    exif = Image.Exif()
    numbers = {"time": 33434, "aperture": 33437, "iso": 34855}
    exif.get_ifd(0x8769).update({numbers[name]: value for name, value in tags.items()})
    Image.new("RGB", (8, 8)).save(path, exif=exif)


def test_exif_is_taken_where_all_photos_have_it(tmp_path: Path):
    files = [tmp_path / f"{i}.jpg" for i in range(3)]
    for file, time, aperture, iso in zip(files, (0.01, 0.02, 0.01), (2.0, 2.0, 4.0), (100, 100, 800), strict=True):
        write_exif(file, time=time, aperture=aperture, iso=iso)
    views = PinholeViews(files, np.zeros((3, 3, 4)), np.zeros((3, 4)), np.zeros((3, 6)))
    found = exposures(views, np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    assert found is not None and found.source == "EXIF" and found.varies
    np.testing.assert_allclose(found.stops, [-2 / 3, 1 / 3, 1 / 3], atol=1e-3)
    for lacking in ({"time": 0.01, "aperture": 2.0}, {"time": 0.0, "aperture": 2.0, "iso": 100}, {}):
        write_exif(files[1], **lacking)
        assert exif_stops(files) is None
    assert exif_stops([]) is None


def test_srgb_and_linear_light_are_inverse():
    values = np.linspace(0, 1, 256)
    np.testing.assert_allclose(srgb_values(linear_light(values)), values, atol=1e-7)
