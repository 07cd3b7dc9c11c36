"""Copies of scenes whose photos have known exposures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from PIL import Image

from benchmarks import __main__ as bench
from benchmarks.exposures import FILE, draw_gains, linear_light, srgb_values, with_gains
from helpers.json_files import read_json
from helpers.small_scenes import VIEWS


def pixels(scene: Path, name: str) -> np.ndarray:
    return np.asarray(Image.open(scene / "images" / name))


def test_each_training_photo_has_the_gain_that_the_file_says_and_held_out_ones_the_mean(scene: Path, tmp_path: Path):
    status = bench.main(["exposures", str(scene), str(tmp_path / "copy")])
    assert status == 0
    photos = read_json(tmp_path / "copy" / FILE)
    assert len(photos) == VIEWS
    assert (tmp_path / "copy/sparse/0/points3D.bin").exists()
    held_out = [name for name, photo in photos.items() if photo["held_out"]]
    assert held_out == ["000.png", "004.png", "008.png"]
    gains = np.array([photo["gain"] for photo in photos.values() if not photo["held_out"]])
    assert gains.max() / gains.min() == pytest.approx(4.0)
    actual = [photos[name]["gain"] for name in held_out]
    expected = np.exp(np.log(gains).mean())
    assert_allclose(actual, expected)
    for name, photo in photos.items():
        before = linear_light(pixels(scene, name) / 255.0)
        after = linear_light(pixels((tmp_path / "copy"), name) / 255.0)
        gain = photo["gain"] * np.array(photo["channels"])
        assert_allclose(after, before * gain, atol=0.005)  # half a step of 8 bits
        assert photo["held_out"] == (photo["channels"] == [1.0, 1.0, 1.0])
        assert gain.max() <= 1


def test_a_control_has_one_exposure(scene: Path, tmp_path: Path):
    options = ["--spread", "1", "--white-balance", "0", "--mean", "0.5"]
    status = bench.main(["exposures", str(scene), str(tmp_path / "copy"), *options])
    assert status == 0
    photos = read_json(tmp_path / "copy" / FILE).values()
    actual = {(photo["gain"], *photo["channels"]) for photo in photos}
    expected = {(0.5, 1.0, 1.0, 1.0)}
    assert actual == expected


def test_the_same_seed_draws_the_same_gains():
    drawn = [draw_gains(9, 4.0, 0.1, 0.4, seed)[0].tolist() for seed in (0, 0, 1)]
    assert drawn[0] == drawn[1] != drawn[2]


def test_factors_of_channels_keep_the_brightness_and_stay_in_their_range():
    gains, factors = draw_gains(500, 4.0, 0.1, 0.4, seed=3)
    actual = factors.prod(axis=1)
    assert_allclose(actual, 1.0)
    assert 1.05 < factors.max() <= 1.1 + 1e-9
    assert 1 / 1.1 - 1e-9 <= factors.min() < 0.95
    assert np.exp(np.log(gains).mean()) == pytest.approx(0.4)


def test_srgb_and_linear_light_are_inverse():
    values = np.linspace(0, 1, 1001)
    actual = srgb_values(linear_light(values))
    assert_allclose(actual, values, atol=1e-7)


def test_what_exceeds_white_saturates():
    image = np.full((1, 1, 3), 200, np.uint8)
    actual = with_gains(image, np.array([1.0, 3.0, 0.0])).tolist()
    expected = [[[200, 255, 0]]]
    assert actual == expected


def test_wrong_input_is_one_sentence_and_leaves_all_as_it_was(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    (tmp_path / "copy").mkdir()
    (tmp_path / "copy/kept").touch()
    for arguments, said in (
        ([str(tmp_path), str(tmp_path / "copy")], "holds no sparse/0"),
        ([str(scene), str(scene)], "is there and holds no exposures.json"),
        ([str(scene), str(tmp_path / "copy")], "is there and holds no exposures.json"),
        ([str(scene), str(tmp_path / "new"), "--spread", "0.5"], "--spread must be at least 1"),
    ):
        status = bench.main(["exposures", *arguments])
        assert status == 2
        error = capsys.readouterr().err
        assert said in error
        assert error.count("\n") == 1
    assert (tmp_path / "copy/kept").exists()
    assert (scene / "images").is_dir()
    assert not (tmp_path / "new").exists()
