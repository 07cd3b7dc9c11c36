"""The parsers that do the work of nerfstudio's, compared with nerfstudio's on files that those read rightly, too."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs
from nerfstudio.data.dataparsers.blender_dataparser import Blender, BlenderDataParserConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import Nerfstudio, NerfstudioDataParserConfig
from nerfstudio.data.utils import colmap_parsing_utils
from PIL import Image

from helpers.json_files import read_json, write_json
from helpers.short_runs import blender_data, nerfstudio_data
from sadgs_ns.data.own_parsers import BlenderParser, ColmapParser
from sadgs_ns.data.transforms_parser import TransformsParser

# nerfstudio opens an image, to look for smaller copies of it, and leaves it open.
pytestmark = pytest.mark.filterwarnings(
    "ignore:Exception ignored in. <_io.FileIO:pytest.PytestUnraisableExceptionWarning"
)

OF_CAMERAS = ("camera_to_worlds", "fx", "fy", "cx", "cy", "width", "height", "distortion_params", "camera_type")


def expect_the_same(found: DataparserOutputs, expected: DataparserOutputs) -> None:
    """All that a parser makes is the same, to the bit."""
    for name in OF_CAMERAS:
        mine = getattr(found.cameras, name)
        theirs = getattr(expected.cameras, name)
        if theirs is None:
            assert mine is None
        else:
            assert mine.dtype == theirs.dtype, name
            assert torch.equal(mine, theirs), name
    assert found.cameras.metadata == expected.cameras.metadata
    assert found.image_filenames == expected.image_filenames
    assert found.mask_filenames == expected.mask_filenames
    assert found.metadata == expected.metadata
    assert found.dataparser_scale == expected.dataparser_scale
    assert torch.equal(found.dataparser_transform, expected.dataparser_transform)
    assert torch.equal(found.scene_box.aabb, expected.scene_box.aabb)
    if expected.alpha_color is None:
        assert found.alpha_color is None
    else:
        assert found.alpha_color is not None
        assert torch.equal(found.alpha_color, expected.alpha_color)


def lists(meta: dict[str, Any]) -> None:
    names = [frame["file_path"] for frame in meta["frames"]]
    meta.update(train_filenames=names[3:], val_filenames=names[:2], test_filenames=names[2:3])


def files(meta: dict[str, Any]) -> None:
    for frame in meta["frames"]:
        frame["mask_path"] = frame["file_path"].replace("images", "masks")
        frame["depth_file_path"] = frame["file_path"].replace("images", "depths")


def in_disorder(meta: dict[str, Any]) -> None:
    meta["frames"] = [meta["frames"][index] for index in np.random.default_rng(0).permutation(len(meta["frames"]))]


def with_lenses(meta: dict[str, Any]) -> None:
    for index, frame in enumerate(meta["frames"]):
        frame.update(fl_x=20.0 + index, cx=11.5, k1=0.001 * index, k4=0.0, p2=0.002)


def of_many_coefficients(meta: dict[str, Any]) -> None:
    meta["camera_model"] = "FISHEYE624"
    meta["fisheye_crop_radius"] = 9
    for frame in meta["frames"]:
        frame["distortion_params"] = [0.01 * place for place in range(12)]


@pytest.mark.parametrize(
    ("change", "options"),
    [
        (dict, {}),
        (in_disorder, {"eval_mode": "interval", "eval_interval": 3}),
        (dict, {"eval_mode": "all", "orientation_method": "pca", "center_method": "focus"}),
        (dict, {"orientation_method": "none", "auto_scale_poses": False, "scale_factor": 2.5, "scene_scale": 2.0}),
        (lambda m: m.update(orientation_override="vertical"), {}),
        (lambda m: m.update(applied_transform=[[0, 1, 0, 0.5], [1, 0, 0, 0], [0, 0, -1, 2]], applied_scale=2.0), {}),
        (lists, {}),
        (files, {"mask_color": (1.0, 0.0, 0.5), "depth_unit_scale_factor": 0.01}),
        (with_lenses, {}),
        (of_many_coefficients, {}),
        (lambda m: m.update(camera_model="OPENCV_FISHEYE", fisheye_crop_radius=9), {}),
        (dict, {"downscale_factor": 2}),
        (dict, {"downscale_factor": None}),
    ],
)
@pytest.mark.parametrize("split", ["train", "val", "test"])
def test_a_transforms_json_becomes_what_nerfstudio_makes_of_it(
    change: Callable[[dict[str, Any]], Any], options: dict[str, Any], split: str, tmp_path: Path
):
    nerfstudio_data(tmp_path)
    (tmp_path / "images_2").mkdir()
    for path in (tmp_path / "images").iterdir():
        with Image.open(path) as image:
            image.resize((image.width // 2, image.height // 2)).save(tmp_path / "images_2" / path.name)
    meta = read_json(tmp_path / "transforms.json")
    change(meta)
    write_json(tmp_path / "transforms.json", meta)
    for data in (tmp_path, tmp_path / "transforms.json"):
        config = NerfstudioDataParserConfig(data=data, **options)
        found = TransformsParser(config).get_dataparser_outputs(split)
        expected = Nerfstudio(config).get_dataparser_outputs(split)
        expect_the_same(found, expected)


@pytest.mark.parametrize("options", [{}, {"scale_factor": 2.0}, {"alpha_color": None}, {"alpha_color": "black"}])
@pytest.mark.parametrize("split", ["train", "val", "test"])
def test_a_blender_scene_becomes_what_nerfstudio_makes_of_it(options: dict[str, Any], split: str, tmp_path: Path):
    blender_data(tmp_path, "white")
    config = BlenderDataParserConfig(data=tmp_path, **options)
    found = BlenderParser(config).get_dataparser_outputs(split)
    expected = Blender(config).get_dataparser_outputs(split)
    expect_the_same(found, expected)


@pytest.mark.parametrize(
    ("change", "split", "error", "sentence"),
    [
        (lambda m: m.update(train_filenames=["images/x.png"]), "train", RuntimeError, "split train were not found: "),
        (lambda m: m.update(train_filenames=[]), "val", RuntimeError, "list of filenames for split val is missing"),
        (lambda m: m["frames"][1].update(depth_file_path="d.png"), "train", ValueError, "image and depth filenames"),
        (lambda m: m["frames"][1].pop("fl_x"), "train", ValueError, "fx not specified in frame"),
        (dict, "other", ValueError, "Unknown dataparser split other"),
    ],
)
def test_a_file_that_was_not_checked_is_refused_as_by_nerfstudio(
    change: Callable[[dict[str, Any]], Any], split: str, error: type[Exception], sentence: str, tmp_path: Path
):
    config = nerfstudio_data(tmp_path)
    config.load_3D_points = False
    meta = read_json(tmp_path / "transforms.json")
    change(meta)
    write_json(tmp_path / "transforms.json", meta)
    with pytest.raises(error, match=sentence):
        TransformsParser(config).get_dataparser_outputs(split)
    with pytest.raises((error, AssertionError), match=sentence):
        Nerfstudio(config).get_dataparser_outputs(split)


def test_the_poses_of_a_colmap_model_are_read_once_for_all_splits(
    colmap: ColmapDataParserConfig, monkeypatch: pytest.MonkeyPatch
):
    read = colmap_parsing_utils.read_images_binary
    files: list[Path] = []

    def counted(file: Path) -> Any:
        files.append(file)
        return read(file)

    monkeypatch.setattr(colmap_parsing_utils, "read_images_binary", counted)
    colmap.load_3D_points = False
    parser = ColmapParser(colmap)
    for split in ("train", "val"):
        expect_the_same(parser.get_dataparser_outputs(split), ColmapParser(colmap).get_dataparser_outputs(split))
    assert len(files) == 1 + 2
