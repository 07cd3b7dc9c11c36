"""The features that `sadgs-process` finds in photos."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

CENTER = (130.0, 90.0)
"""Of the only blob in the picture, in px from the centre of the first pixel."""


@pytest.fixture(scope="module")
def features():
    """The module is imported after Pillow, as in the command, where it has a process of its own."""
    from sadgs_ns.placing import features

    return features


@pytest.fixture
def blob(tmp_path: Path) -> Path:
    x, y = np.meshgrid(np.arange(320), np.arange(240))
    brightness = 200 * np.exp(-((x - CENTER[0]) ** 2 + (y - CENTER[1]) ** 2) / (2 * 6.0**2))
    path = tmp_path / "blob.png"
    Image.fromarray(brightness.round().astype(np.uint8)).save(path)
    return path


@pytest.mark.parametrize("max_side", [3200, 160])
def test_a_blob_is_found_where_it_is_and_as_large_as_it_is(features, blob: Path, monkeypatch, max_side: int):
    monkeypatch.setattr(features, "MAX_SIDE", max_side)
    keypoints, descriptors = features.sift(blob)
    nearest = keypoints[np.linalg.norm(keypoints[:, :2] - CENTER, axis=1).argmin()]
    assert nearest[:2] == pytest.approx([CENTER[0] + 0.5, CENTER[1] + 0.5], abs=0.25)  # A pixel's centre is at a half.
    assert nearest[2] == pytest.approx(6.0, rel=0.3)
    assert keypoints.dtype == np.float32
    assert descriptors.dtype == np.uint8
    assert descriptors.shape == (len(keypoints), 128)
    actual = np.linalg.norm(descriptors.astype(float), axis=1)
    expected = pytest.approx(512, rel=0.01)
    assert actual == expected


def test_the_file_s_own_pixels_are_searched_whatever_orientation_exif_tells(features, blob: Path, tmp_path: Path):
    exif = Image.Exif()
    exif[0x0112] = 6  # to be turned by a quarter
    with Image.open(blob) as image:
        image.save(tmp_path / "upright.jpg", quality=100)
        image.save(tmp_path / "turned.jpg", quality=100, exif=exif)
    upright = features.sift(tmp_path / "upright.jpg")
    turned = features.sift(tmp_path / "turned.jpg")
    assert len(upright[0]) > 0
    assert np.array_equal(upright[0], turned[0])
    assert np.array_equal(upright[1], turned[1])


@pytest.mark.parametrize("content", [b"no image", "empty"])
def test_what_cannot_be_searched_has_no_features(features, tmp_path: Path, content: bytes | str):
    path = tmp_path / "photo.png"
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        Image.new("RGB", (64, 64)).save(path)
    keypoints, descriptors = features.sift(path)
    assert keypoints.shape == (0, 4)
    assert descriptors.shape == (0, 128)


def test_photos_that_have_features_are_not_searched_again(features, tmp_path: Path, monkeypatch):
    noise = np.random.default_rng(0).integers(0, 256, (4, 30, 40, 3), dtype=np.uint8)
    names = [f"{k}.png" for k in range(4)]
    for name, pixels in zip(names, noise, strict=True):
        Image.fromarray(cv2.resize(pixels, (160, 120))).save(tmp_path / name)
    searched = []
    told = []
    sift = features.sift

    def noting(photo: Path, mask: Path):
        searched.append(photo.name)
        return sift(photo, mask)

    monkeypatch.setattr(features, "sift", noting)
    database = tmp_path / "database.db"
    features.extract(tmp_path, [names[:2]], database)
    monkeypatch.setattr(features, "progress", lambda *step: told.append(step))
    features.extract(tmp_path, [names], database)
    assert sorted(searched) == names
    assert told[-1] == ("features", 4, 4)
    with features.pycolmap.Database.open(database) as opened:
        images = opened.read_all_images()
        actual = {image.name for image in images}
        assert actual == set(names)
        assert len({image.camera_id for image in images}) == 1  # The photos of a group share one.
        for image in images:
            assert opened.num_keypoints_for_image(image.image_id) > 0


def test_no_more_photos_are_searched_at_a_time_than_memory_holds(features, monkeypatch):
    from sadgs_ns.placing import photos

    monkeypatch.setattr(photos, "num_cores", lambda: 64)
    monkeypatch.setattr(photos, "available_host_bytes", lambda: 16e9)
    assert features._num_threads([(2000, 1500)]) == 11  # half of the memory, at 720 MB each
    assert features._num_threads([(20_000, 15_000)]) == 4  # these are scaled down to 3200 px
    assert features._num_threads([]) == 64
    monkeypatch.setattr(photos, "available_host_bytes", lambda: 0.0)
    assert features._num_threads([(2000, 1500)]) == 1


def test_photos_are_taken_by_lots_as_all_at_once(features, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A panorama's views may lie in two lots."""
    import pycolmap

    names = [f"{i}.png" for i in range(5)]
    views = [f"pano/{i}.png" for i in range(features.VIEWS)]
    (tmp_path / "pano").mkdir()
    rng = np.random.default_rng(0)
    for name in (*names, *views):
        Image.fromarray(rng.integers(0, 256, (64, 64), np.uint8)).resize((128, 128)).save(tmp_path / name)
    held = []
    for at_once in (256, 3):
        monkeypatch.setattr(features, "_AT_ONCE", at_once)
        database = tmp_path / f"{at_once}.db"
        features.extract(tmp_path, [names[:4], names[4:]], database, [views])
        with pycolmap.Database.open(database) as opened:
            images = {image.name: image for image in opened.read_all_images()}
            cameras = [images[name].camera_id for name in names]
            cameras = [cameras[:4], cameras[4:]]
            assert len({*cameras[0]}) == 1
            assert len({*cameras[0], *cameras[1]}) == 2
            rigs = [rig.num_sensors() for rig in opened.read_all_rigs()]
            held.append(
                (sorted(rigs), {name: opened.read_keypoints(images[name].image_id).tolist() for name in images})
            )
    assert held[0] == held[1]
    assert len(held[0][1]) == len(names) + len(views)
