"""SfM points as nerfstudio's parsers give them, read once and faster."""

from __future__ import annotations

import copy
import dataclasses
import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParser, ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import Nerfstudio
from nerfstudio.data.utils import colmap_parsing_utils
from test_nerfstudio import nerfstudio_data

from sadgs_ns.datamanager import SadgsDatamanager, SadgsDatamanagerConfig
from sadgs_ns.demo.scene import SPARSE_FOLDER

READ = ("points3D_xyz", "points3D_rgb")


def load(parser: DataParserConfig) -> SadgsDatamanager:
    return SadgsDatamanagerConfig(dataparser=copy.deepcopy(parser)).setup(device="cpu")


@pytest.fixture
def reads(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """The files of points that nerfstudio's own parsers read from now on."""
    paths: list[Path] = []

    def noted(function: Callable[..., object]) -> Callable[..., object]:
        def load_3d_points(self: object, path: Path, *args: object) -> object:
            paths.append(path)
            return function(self, path, *args)

        return load_3d_points

    for parser in (ColmapDataParser, Nerfstudio):
        monkeypatch.setattr(parser, "_load_3D_points", noted(parser._load_3D_points))
    return paths


@pytest.mark.parametrize("kind", ["bin", "txt"])
@pytest.mark.parametrize("options", [{}, {"orientation_method": "none", "center_method": "none", "scale_factor": 3.0}])
def test_colmap_s_points_are_nerfstudio_s_to_the_bit(
    kind: str, options: dict, colmap: ColmapDataParserConfig, tmp_path: Path, reads: list[Path]
):
    data = Path(shutil.copytree(colmap.data, tmp_path / "scene"))
    if kind == "txt":
        model = colmap_parsing_utils.read_model(str(data / SPARSE_FOLDER), ".bin")
        assert model is not None
        for path in (data / SPARSE_FOLDER).iterdir():
            path.unlink()
        colmap_parsing_utils.write_model(*model, str(data / SPARSE_FOLDER), ".txt")
    parser = dataclasses.replace(colmap, data=data, **options)
    expected = parser.setup().get_dataparser_outputs("train").metadata
    reads.clear()
    datamanager = load(parser)
    assert reads == []
    for metadata in (datamanager.train_dataparser_outputs.metadata, datamanager.train_dataset.metadata):
        for name in READ:
            assert metadata[name].dtype == expected[name].dtype and torch.equal(metadata[name], expected[name])
    assert datamanager.config.dataparser == parser  # it goes into the run's config.yml


def test_matches_of_points_are_left_to_nerfstudio(colmap: ColmapDataParserConfig, reads: list[Path]):
    datamanager = load(dataclasses.replace(colmap, max_2D_matches_per_3D_point=-1))
    assert len(reads) == 1 and "points3D_points2D_xy" in datamanager.train_dataset.metadata


def test_points_of_a_ply_file_are_read_once(tmp_path: Path, reads: list[Path]):
    parser = nerfstudio_data(tmp_path)
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), "ply_file_path": "points.ply"}))
    header = ["ply", "format ascii 1.0", "element vertex 2", *(f"property float {axis}" for axis in "xyz")]
    lines = [*header, *(f"property uchar {name}" for name in ("red", "green", "blue")), "end_header"]
    (tmp_path / "points.ply").write_text("\n".join([*lines, "0 0 1 9 9 9", "1 0 1 9 9 9", ""]))
    datamanager = load(parser)
    assert reads == [tmp_path / "points.ply"] and len(datamanager.train_dataset.metadata["points3D_xyz"]) == 2
    assert datamanager.config.dataparser == parser


def test_points_that_are_not_asked_for_are_not_read(colmap: ColmapDataParserConfig, reads: list[Path]):
    parser = dataclasses.replace(colmap, load_3D_points=False)
    datamanager = load(parser)
    assert reads == [] and not datamanager.train_dataset.metadata.keys() & set(READ)
    assert datamanager.config.dataparser == parser
