"""Scenes whose validation views are held out and whose test views are gone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig
from numpy.testing import assert_allclose
from PIL import Image

from benchmarks import __main__ as bench
from benchmarks.datasets import image_names
from benchmarks.validation import SPARSE
from helpers.json_files import write_json
from helpers.small_scenes import VIEWS


def test_a_colmap_scene_is_split_as_nerfstudio_then_reads_it(scene: Path, tmp_path: Path):
    status = bench.main(["validation", str(scene.parent), str(tmp_path)])
    assert status == 0
    names = image_names(ColmapDataParserConfig(colmap_path=SPARSE, downscale_factor=1), scene)
    parser = ColmapDataParserConfig(data=tmp_path / scene.name, colmap_path=SPARSE, downscale_factor=1).setup()
    read = {}
    for split in ("train", "val", "test"):
        read[split] = [path.name for path in parser.get_dataparser_outputs(split).image_filenames]
    assert read["val"] == read["test"] == [names[i] for i in range(4, VIEWS, 8)]
    expected = [name for i, name in enumerate(names) if i % 8 not in (0, 4)]
    assert read["train"] == expected


def test_each_fold_holds_out_its_views_and_only_fold_0_holds_out_test_views(scene: Path, tmp_path: Path):
    status = bench.main(["validation", str(scene.parent), str(tmp_path), "--folds", "1,4,0", "--noisy", scene.name])
    assert status == 0
    names = image_names(ColmapDataParserConfig(colmap_path=SPARSE, downscale_factor=1), scene)
    for fold in (0, 1, 4):
        for path in (tmp_path / f"{scene.name}-{fold}", tmp_path / f"{scene.name}-{fold}-noisy"):
            lists = {split: (path / f"{split}_list.txt").read_text().split() for split in ("train", "val", "test")}
            assert lists["val"] == lists["test"] == names[fold::8]
            expected = [name for i, name in enumerate(names) if i % 8 not in (0, fold)]
            assert lists["train"] == expected


@pytest.mark.parametrize("folds", ["8", "-1", "2,x", ""])
def test_a_fold_that_there_is_not_is_refused(folds: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    status = bench.main(["validation", str(tmp_path), str(tmp_path), f"--folds={folds}"])
    assert status == 2
    told = (
        f"python -m benchmarks validation: --folds must be whole numbers from 0 to 7, such as 2,4,6, not {folds!r}.\n"
    )
    errors = capsys.readouterr().err
    assert errors == told


def test_noise_turns_training_cameras_about_their_centres_and_leaves_the_others(scene: Path, tmp_path: Path):
    status = bench.main(["validation", str(scene.parent), str(tmp_path), "--noisy", scene.name])
    assert status == 0
    outputs = {}
    for name in (scene.name, f"{scene.name}-noisy"):
        parser = ColmapDataParserConfig(data=tmp_path / name, colmap_path=SPARSE, downscale_factor=1)
        parser.orientation_method = "none"
        parser.center_method = "none"
        parser.auto_scale_poses = False
        for split in ("train", "test"):
            outputs[name, split] = parser.setup().get_dataparser_outputs(split).cameras.camera_to_worlds
    for split, turned in (("train", True), ("test", False)):
        true = outputs[scene.name, split]
        noisy = outputs[f"{scene.name}-noisy", split]
        actual = noisy[..., 3]
        expected = true[..., 3]
        assert_allclose(actual, expected, atol=1e-5)
        angles = np.degrees((noisy - true)[:, :, :3].square().sum(dim=(1, 2)).div(2).sqrt().numpy())  # of small turns
        assert 0.05 < np.sqrt((angles**2).mean() / 3) < 0.15 if turned else angles.max() < 1e-3


def test_a_scene_that_lists_its_views_keeps_its_test_views_out(tmp_path: Path):
    scene = tmp_path / "scenes/listed"
    scene.mkdir(parents=True)
    names = [f"{i:02}.png" for i in range(24)]
    for name in names:
        Image.new("RGB", (4, 3)).save(scene / name)
    poses = np.repeat(np.eye(4)[None], len(names), axis=0)
    poses[:, 0, 3] = range(len(names))
    content = {
        "w": 4, "h": 3, "fl_x": 4, "fl_y": 4, "cx": 2, "cy": 1.5,
        "frames": [{"file_path": n, "transform_matrix": p.tolist()} for n, p in zip(names, poses, strict=True)],
        "train_filenames": names[:20], "val_filenames": names[20:], "test_filenames": names[20:],
    }  # fmt: skip
    write_json(scene / "transforms.json", content)
    status = bench.main(["validation", str(scene.parent), str(tmp_path / "out")])
    assert status == 0
    status = bench.main(["validation", str(scene.parent), str(tmp_path / "out"), "--folds", "0,2"])
    assert status == 0
    for copy, held_out in (("listed", names[4:20:8]), ("listed-0", names[20:]), ("listed-2", names[2:20:8])):
        parser = NerfstudioDataParserConfig(data=tmp_path / "out" / copy, downscale_factor=1).setup()
        expected = {"train": [name for name in names[:20] if name not in held_out], "val": held_out, "test": held_out}
        for split, chosen in expected.items():
            actual = [path.name for path in parser.get_dataparser_outputs(split).image_filenames]
            assert actual == chosen


def test_a_folder_without_scenes_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    status = bench.main(["validation", str(tmp_path), str(tmp_path / "out")])
    assert status == 2
    errors = capsys.readouterr().err
    assert f": {tmp_path} holds no folder with sparse/0 or transforms.json; give" in errors
