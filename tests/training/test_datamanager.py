"""SfM points as nerfstudio's parsers give them, read once and faster."""

from __future__ import annotations

import copy
import dataclasses
import shutil
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig, DataparserOutputs
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParser, ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import Nerfstudio
from nerfstudio.data.dataparsers.scannet_dataparser import ScanNetDataParserConfig
from nerfstudio.data.utils import colmap_parsing_utils
from nerfstudio.process_data.colmap_utils import create_ply_from_colmap
from numpy.testing import assert_allclose
from plyfile import PlyData, PlyElement
from torch.testing import assert_close

from examples.drawn_scene.scene import SPARSE_FOLDER
from helpers.closeness import assert_within
from helpers.json_files import read_json, write_json
from helpers.refusals import refusal
from helpers.short_runs import blender_data, nerfstudio_data
from sadgs_ns.data import ply
from sadgs_ns.data.checks.capture import check_capture
from sadgs_ns.data.checks.geometry import check_ply
from sadgs_ns.data.coordinates import Similarity
from sadgs_ns.errors import InputError
from sadgs_ns.training.config import SadgsDatamanagerConfig
from sadgs_ns.training.datamanager import SadgsDatamanager

READ = ("points3D_xyz", "points3D_rgb")


def load(parser: DataParserConfig) -> SadgsDatamanager:
    config = SadgsDatamanagerConfig(dataparser=copy.deepcopy(parser))
    datamanager = config.setup(device="cpu")
    assert config.dataparser == parser  # it goes into the run's config.yml
    return datamanager


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
            assert metadata[name].dtype == expected[name].dtype
            assert torch.equal(metadata[name], expected[name])


def test_matches_of_points_are_left_to_nerfstudio(colmap: ColmapDataParserConfig, reads: list[Path]):
    datamanager = load(dataclasses.replace(colmap, max_2D_matches_per_3D_point=-1))
    assert len(reads) == 1
    assert "points3D_points2D_xy" in datamanager.train_dataset.metadata


MARK = b"\xef\xbb\xbf"


def text_model(colmap: ColmapDataParserConfig, data: Path) -> ColmapDataParserConfig:
    """A copy of a scene with COLMAP's files as text."""
    shutil.copytree(colmap.data, data)
    folder = data / SPARSE_FOLDER
    model = colmap_parsing_utils.read_model(str(folder), ".bin")
    assert model is not None
    for path in folder.iterdir():
        path.unlink()
    colmap_parsing_utils.write_model(*model, str(folder), ".txt")
    return dataclasses.replace(colmap, data=data)


@pytest.mark.hard_case(
    "Windows's line ends in COLMAP's `cameras.txt`, `images.txt`, `points3D.txt`", "read as without them"
)
@pytest.mark.parametrize("comments", [True, False])
def test_colmap_s_text_with_windows_s_line_ends_is_read_as_without_them(
    comments: bool, colmap: ColmapDataParserConfig, tmp_path: Path
):
    parser = text_model(colmap, tmp_path / "scene")
    expected = load(parser).train_dataparser_outputs
    for path in (parser.data / SPARSE_FOLDER).iterdir():
        lines = path.read_bytes().splitlines()
        path.write_bytes(b"".join(line + b"\r\n" for line in lines if comments or not line.startswith(b"#")))
    assert check_capture(SadgsDatamanagerConfig(dataparser=parser))
    assert_equal_outputs(load(parser).train_dataparser_outputs, expected)


@pytest.mark.hard_case(
    "a byte order mark in `transforms.json`, Blender's files or COLMAP's text", "one sentence naming the file"
)
@pytest.mark.parametrize("kind", ["transforms.json", "blender", "cameras.txt", "images.txt", "points3D.txt"])
def test_a_byte_order_mark_is_refused_by_the_file_s_name(kind: str, colmap: ColmapDataParserConfig, tmp_path: Path):
    if kind.endswith(".txt"):
        parser: DataParserConfig = text_model(colmap, tmp_path / "scene")
        file = parser.data / SPARSE_FOLDER / kind
    elif kind == "blender":
        parser = blender_data(tmp_path, "white")
        file = tmp_path / "transforms_train.json"
    else:
        parser = nerfstudio_data(tmp_path)
        file = tmp_path / kind
    file.write_bytes(MARK + file.read_bytes())
    with pytest.raises(InputError) as refused:
        check_capture(SadgsDatamanagerConfig(dataparser=parser))
    told = f"{file} starts with a byte order mark, which nerfstudio cannot read: save it as UTF-8 without one."
    assert str(refused.value) == told


def assert_equal_outputs(outputs: DataparserOutputs, expected: DataparserOutputs) -> None:
    assert outputs.image_filenames == expected.image_filenames
    assert torch.equal(outputs.cameras.camera_to_worlds, expected.cameras.camera_to_worlds)
    assert torch.equal(outputs.cameras.fx, expected.cameras.fx)
    for name in READ:
        assert (name in outputs.metadata) == (name in expected.metadata)
        assert name not in expected.metadata or torch.equal(outputs.metadata[name], expected.metadata[name])


@pytest.mark.hard_case(
    "`transforms.json` of an old ns-process-data (a COLMAP model beside it, no PLY)",
    "COLMAP's points are read; nothing is asked or rewritten",
)
@pytest.mark.parametrize("transform", [None, [[1, 0, 0, 2], [0, 0, -1, 0], [0, 1, 0, 0.5]]])
def test_colmap_s_points_of_an_old_ns_process_data_are_read_without_a_question(
    transform: list | None, colmap: ColmapDataParserConfig, tmp_path: Path, reads: list[Path]
):
    parser = nerfstudio_data(tmp_path)
    path = tmp_path / "transforms.json"
    shutil.copytree(colmap.data / SPARSE_FOLDER, tmp_path / "colmap/sparse/0")
    before = {**read_json(path), **({} if transform is None else {"applied_transform": transform})}
    write_json(path, before)
    metadata = load(parser).train_dataset.metadata  # a question would raise: pytest gives it no terminal
    of_file = load(dataclasses.replace(parser, data=path)).train_dataset.metadata
    assert torch.equal(of_file["points3D_xyz"], metadata["points3D_xyz"])
    assert read_json(path) == before
    assert reads == []
    applied = torch.tensor(transform or [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]], dtype=torch.float32)
    create_ply_from_colmap("p.ply", tmp_path / "colmap/sparse/0", tmp_path, applied)  # what it would do after a yes
    write_json(path, {**before, "applied_transform": applied.tolist(), "ply_file_path": "p.ply"})
    expected = load(parser).train_dataset.metadata
    assert_within(metadata["points3D_xyz"], expected["points3D_xyz"], 3e-6)  # 6 digits
    assert torch.equal(metadata["points3D_rgb"], expected["points3D_rgb"])


def change_description(data: Path, **values: Any) -> dict[str, Any]:
    """Change values of the transforms.json of a capture, and return all."""
    described = read_json(data / "transforms.json") | values
    write_json(data / "transforms.json", described)
    return described


def test_views_that_are_added_move_nothing_in_a_frame_that_the_data_fix(colmap: ColmapDataParserConfig, tmp_path: Path):
    parser = nerfstudio_data(tmp_path)
    parser.eval_mode = "all"
    shutil.copytree(colmap.data / SPARSE_FOLDER, tmp_path / "colmap/sparse/0")
    frames = change_description(tmp_path, applied_transform=np.eye(4)[:3].tolist())["frames"]

    def parsed(**values: Any) -> DataparserOutputs:
        change_description(tmp_path, **values)
        return load(parser).train_dataparser_outputs

    first = parsed(frames=frames[:6])
    added = parsed(frames=frames)
    assert abs(added.dataparser_scale - first.dataparser_scale) > 0.01
    frame = {"dataparser_transform": first.dataparser_transform.tolist(), "dataparser_scale": first.dataparser_scale}
    fixed = parsed(**frame)
    assert torch.equal(fixed.dataparser_transform, first.dataparser_transform)
    assert fixed.dataparser_scale == first.dataparser_scale
    assert len(fixed.cameras) == len(frames)
    same = [fixed.image_filenames.index(path) for path in first.image_filenames]
    actual = fixed.cameras.camera_to_worlds[same]
    assert_within(actual, first.cameras.camera_to_worlds, 1e-6)
    actual = fixed.metadata["points3D_xyz"]
    expected = first.metadata["points3D_xyz"]
    assert_within(actual, expected, 1e-6)


@pytest.mark.hard_case(
    "`transforms.json` with a `dataparser_transform` that is no rotation and translation, or without its scale",
    "one sentence",
)
@pytest.mark.parametrize(
    ("values", "told"),
    [
        ({"dataparser_transform": [[1, 0, 0, 0], [0, 2, 0, 0], [0, 0, 1, 0]], "dataparser_scale": 1.0}, "no rotation"),
        ({"dataparser_transform": [[1, 0, 0, 0]] * 2, "dataparser_scale": 1.0}, "no transform of 3 rows"),
        ({"dataparser_scale": 1.0}, "'dataparser_transform'"),
    ],
)
def test_a_frame_that_is_none_is_refused(values: dict[str, Any], told: str, tmp_path: Path):
    parser = nerfstudio_data(tmp_path)
    change_description(tmp_path, **values)
    with refusal(rf"transforms.json does not tell with .* is to be moved \(.*{told}"):
        load(parser)


POSITIONS = np.array([[0.0, 0.0, 1.0], [1.0, 0.5, 1.0], [-2.0, 0.25, 3.0]])
COLORS = np.array([[9, 120, 255], [0, 1, 2], [254, 128, 77]])


def ply_scene(
    folder: Path,
    text: bool = False,
    colors: np.ndarray | None = COLORS,
    names: Sequence[str] = ("red", "green", "blue"),
    positions: np.ndarray = POSITIONS,
) -> DataParserConfig:
    """A dataset with the points above in a PLY file."""
    parser = nerfstudio_data(folder)
    path = folder / "transforms.json"
    write_json(path, {**read_json(path), "ply_file_path": "points.ply"})
    kind = [] if colors is None else [(name, colors.dtype.str) for name in names]
    vertices = np.empty(len(positions), [(axis, "<f8") for axis in "xyz"] + kind)
    for k in range(3):
        vertices["xyz"[k]] = positions[:, k]
        if colors is not None:
            vertices[names[k]] = colors[:, k]
    PlyData([PlyElement.describe(vertices, "vertex")], text=text).write(str(folder / "points.ply"))
    return parser


def move_model(folder: Path, by: np.ndarray, suffix: str = ".bin") -> None:
    """Move the cameras and points of a COLMAP model, and write it as other files beside the first if asked."""
    model = colmap_parsing_utils.read_model(str(folder), ".bin")
    assert model is not None
    for index, image in model[1].items():
        model[1][index] = image._replace(tvec=image.tvec - image.qvec2rotmat() @ by)
    for index, point in model[2].items():
        model[2][index] = point._replace(xyz=point.xyz + by)
    colmap_parsing_utils.write_model(*model, str(folder), suffix)


@pytest.mark.hard_case(
    "cameras and points in coordinates of a map (UTM), thousands of kilometres from the origin",
    "**trains** as well as at the origin, also where float32 has steps of half a metre there",
)
@pytest.mark.parametrize("kind", ["a COLMAP model", "a PLY", "an old ns-process-data"])
def test_a_capture_on_a_map_trains_as_at_the_origin(kind: str, colmap: ColmapDataParserConfig, tmp_path: Path):
    by = np.array([5e5, 5.4e6, 200.0])
    applied = np.array([[0, 1, 0, 3], [1, 0, 0, 0], [0, 0, -1, 5.0]])
    outputs = []
    for folder, offset in ((tmp_path / "near", 0 * by), (tmp_path / "far", by)):
        if kind == "a COLMAP model":
            shutil.copytree(colmap.data, folder)
            parser: DataParserConfig = dataclasses.replace(colmap, data=folder)
            move_model(folder / SPARSE_FOLDER, offset)
        else:
            parser = ply_scene(folder, colors=None, positions=(POSITIONS + offset) @ applied[:, :3].T + applied[:, 3])
            described = change_description(folder, applied_transform=applied.tolist())
            for frame in described["frames"]:
                pose = np.array(frame["transform_matrix"])
                pose[:3, 3] += applied[:, :3] @ offset
                frame["transform_matrix"] = pose.tolist()
            if kind == "an old ns-process-data":
                described.pop("ply_file_path")
                shutil.copytree(colmap.data / SPARSE_FOLDER, folder / "colmap/sparse/0")
                move_model(folder / "colmap/sparse/0", offset)
            write_json(folder / "transforms.json", described)
        outputs.append(load(parser).train_dataparser_outputs)
    near, far = outputs
    assert_within(far.cameras.camera_to_worlds, near.cameras.camera_to_worlds, 1e-5)
    points = [each.metadata["points3D_xyz"] for each in outputs]
    assert_within(points[1], points[0], 1e-5)
    maps = [Similarity.of(each.dataparser_scale * each.dataparser_transform.double().numpy()) for each in outputs]
    there = maps[0].inverse().positions(points[0].double().numpy())
    here = maps[1].inverse().positions(points[1].double().numpy())
    assert_allclose(here - by, there, atol=1e-4)


def test_poses_that_shall_not_be_centred_stay_or_are_refused(colmap: ColmapDataParserConfig, tmp_path: Path):
    data = Path(shutil.copytree(colmap.data, tmp_path / "scene"))
    still = {"orientation_method": "none", "center_method": "none", "auto_scale_poses": False}
    parser = dataclasses.replace(colmap, data=data, assume_colmap_world_coordinate_convention=False, **still)
    move_model(data / SPARSE_FOLDER, np.array([100.0, 0.0, 0.0]))
    outputs = load(parser).train_dataparser_outputs
    assert torch.equal(outputs.dataparser_transform, torch.eye(4)[:3])
    assert outputs.cameras.camera_to_worlds[:, 0, 3].min() > 90
    move_model(data / SPARSE_FOLDER, np.array([1e6, 0.0, 0.0]))
    with refusal(r"^--center-method none leaves the cameras where float32 rounds .*: leave it"):
        load(parser)


@pytest.mark.hard_case(
    "a COLMAP model as text beside another one in binary",
    "the text is read, with its own points; they were the other's",
)
def test_points_are_those_of_the_model_whose_cameras_are_read(colmap: ColmapDataParserConfig, tmp_path: Path):
    parser = dataclasses.replace(colmap, data=Path(shutil.copytree(colmap.data, tmp_path / "scene")))
    expected = load(parser).train_dataparser_outputs.metadata["points3D_xyz"]
    move_model(parser.data / SPARSE_FOLDER, np.array([1.0, 2.0, 3.0]), ".txt")
    found = load(parser).train_dataparser_outputs.metadata["points3D_xyz"]
    assert_within(found, expected, 1e-5)


@pytest.mark.parametrize("text", [True, False], ids=["text", "binary"])
def test_points_of_a_ply_file_are_read_once_and_without_open3d(
    text: bool, tmp_path: Path, reads: list[Path], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setitem(sys.modules, "open3d", None)  # importing it fails, as where it lacks a system library
    mine: list[Path] = []
    read = ply.read_points
    monkeypatch.setattr(ply, "read_points", lambda path: mine.append(path) or read(path))
    parser = ply_scene(tmp_path, text, COLORS.astype(np.uint8))
    datamanager = load(parser)
    assert reads == []
    assert mine == [tmp_path / "points.ply"]
    outputs = datamanager.train_dataparser_outputs
    homogeneous = torch.cat([torch.tensor(POSITIONS), torch.ones(3, 1)], dim=1)
    expected = (homogeneous @ outputs.dataparser_transform.T.double() * outputs.dataparser_scale).float()
    actual = outputs.metadata["points3D_xyz"]
    assert_close(actual, expected)
    assert outputs.metadata["points3D_rgb"].tolist() == COLORS.tolist()


@pytest.mark.hard_case(
    "points of a PLY for `blender-data --ply-path` or `scannet-data`, without libusb-1.0", "read without open3d"
)
def test_other_parsers_read_a_ply_without_open3d(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    ply_scene(tmp_path / "ply", colors=COLORS.astype(np.uint8))
    parser = blender_data(tmp_path / "blender", "white")
    parser.ply_path = tmp_path / "ply/points.ply"
    parser.scale_factor = 3.0
    metadata = load(parser).train_dataset.metadata
    assert_allclose(metadata["points3D_xyz"], 3 * POSITIONS)
    assert metadata["points3D_rgb"].tolist() == COLORS.tolist()
    folder = tmp_path / "scannet"
    for i, image in enumerate(sorted((tmp_path / "ply/images").iterdir())):
        for kind in ("color", "depth", "pose"):
            (folder / kind).mkdir(parents=True, exist_ok=True)
            shutil.copy(image, folder / f"{kind}/{i}.png")
        (folder / f"pose/{i}.png").unlink()
        np.savetxt(folder / f"pose/{i}.txt", np.eye(4) + i * np.eye(4, k=3))
    (folder / "intrinsic").mkdir()
    np.savetxt(folder / "intrinsic/intrinsic_color.txt", np.diag([30.0, 30.0, 1.0, 1.0]))
    for path, count in ((tmp_path / "ply/points.ply", 3), (tmp_path / "none.ply", 0)):
        scannet = ScanNetDataParserConfig(data=folder, ply_file_path=path)
        assert len(load(scannet).train_dataset.metadata.get("points3D_xyz", ())) == count


def test_points_of_a_ply_file_are_nerfstudio_s(tmp_path: Path, open3d: None):
    parser = ply_scene(tmp_path, colors=COLORS.astype(np.uint8))
    expected = parser.setup().get_dataparser_outputs("train").metadata
    metadata = load(parser).train_dataset.metadata
    assert torch.equal(metadata["points3D_xyz"], expected["points3D_xyz"])
    difference = metadata["points3D_rgb"].int() - expected["points3D_rgb"].int()
    assert ((difference == 0) | (difference == 1)).all()  # nerfstudio rounds down after it divided by 255


@pytest.mark.parametrize(
    ("colors", "expected"),
    [
        (None, [[ply.GREY] * 3] * 3),
        (COLORS.astype(np.float32) / 255, COLORS.tolist()),
        (COLORS.astype(np.uint16), COLORS.tolist()),
        (COLORS.astype(np.uint16) * 257, COLORS.tolist()),
        (COLORS.astype(np.float32), COLORS.tolist()),
    ],
    ids=["none", "fractions", "wide", "65,535", "floats to 255"],
)
@pytest.mark.hard_case(
    "a PLY of points whose colours are floating-point numbers to 1 or 255, or integers to 255 or 65,535",
    "read as they are meant, by the largest of them; grey where there are none",
)
def test_colours_of_a_ply_file(colors: np.ndarray | None, expected: list, tmp_path: Path):
    metadata = load(ply_scene(tmp_path, colors=colors)).train_dataset.metadata
    assert metadata["points3D_rgb"].dtype == torch.uint8
    assert metadata["points3D_rgb"].tolist() == expected


@pytest.mark.hard_case(
    "a PLY of points whose colours are named r, g, b, or Red, or diffuse_red, or scalar_R, as CloudCompare writes",
    "read",
)
@pytest.mark.parametrize(
    "names",
    [
        "rgb",
        ("Red", "Green", "Blue"),
        ("diffuse_red", "diffuse_green", "diffuse_blue"),
        *(
            [prefix + name for name in names]
            for prefix, names in (("scalar_", "RGB"), ("vertex_", ("red", "green", "blue")), ("color_", "rgb"))
        ),
    ],
)
def test_colours_are_known_by_the_names_in_use(names: Sequence[str], tmp_path: Path):
    ply_scene(tmp_path, colors=COLORS.astype(np.float32), names=names)
    assert ply.read_points(tmp_path / "points.ply")[1].tolist() == COLORS.tolist()


@pytest.mark.hard_case(
    "a PLY of points with doubles, alpha, lists, other elements before and after, in big endian or text", "read"
)
@pytest.mark.parametrize("order", ["<", ">", "text"])
@pytest.mark.parametrize("kind", ["<u2", "<i2", "<i4", "<f8"])
def test_points_are_found_among_what_else_a_ply_holds(kind: str, order: Any, tmp_path: Path):
    fields = [(axis, "<f8") for axis in "xyz"] + [(name, kind) for name in ("red", "green", "blue")]
    # plyfile writes big-endian elements with lists wrongly.
    fields += [("alpha", "u1")] if order == ">" else [("track", "O")]
    other = (lambda i: i) if order == ">" else (lambda i: np.arange(i + 1))
    rows = [(*place, *color, other(i)) for i, (place, color) in enumerate(zip(POSITIONS, COLORS, strict=True))]
    vertices = np.array(rows, fields)
    faces = np.array([([0, 1, 2],)], [("vertex_indices", "<i4", (3,))])
    before = PlyElement.describe(faces, "face")
    after = PlyElement.describe(faces, "edge")
    points = PlyElement.describe(vertices, "vertex", len_types={"track": "u1"}, val_types={"track": "i4"})
    whole = PlyData([before, points, after], text=order == "text", byte_order="<" if order == "text" else order)
    whole.write(str(tmp_path / "a.ply"))
    positions, colors = ply.read_points(tmp_path / "a.ply")
    assert positions.tolist() == POSITIONS.tolist()
    assert colors.tolist() == COLORS.tolist()


@pytest.mark.hard_case("a PLY of points without colours", "trains from grey points; the check notes it")
@pytest.mark.parametrize("colors", [None, COLORS.astype(np.uint8)], ids=["without", "with"])
def test_points_without_colours_are_noted(colors: np.ndarray | None, tmp_path: Path):
    ply_scene(tmp_path, colors=colors)
    notes = [finding.sentence for finding in check_ply(tmp_path / "points.ply", [], "restore it")]
    actual = any("without colours" in note for note in notes)
    assert actual == (colors is None)


@pytest.mark.hard_case("a splat's PLY as points", "read with its colours of degree 0")
def test_colours_of_a_splat_are_those_of_degree_0(tmp_path: Path):
    coefficients = (COLORS / 255 - 0.5) / 0.28209479177387814
    coefficients[0] = [9, -9, np.nan]
    ply_scene(tmp_path, colors=coefficients.astype(np.float32), names=[f"f_dc_{index}" for index in range(3)])
    _, colors = ply.read_points(tmp_path / "points.ply")
    expected = [[255, 0, 128], *COLORS[1:].tolist()]
    assert colors.tolist() == expected


def test_what_is_no_ply_file_of_points_is_named(tmp_path: Path):
    (tmp_path / "points.ply").write_text("ply\nformat ascii 1.0\nelement face 1\nend_header\n")
    with refusal(r"points\.ply is not a PLY file of points \(.+\): restore it\.$"):
        ply.read_points(tmp_path / "points.ply")


def test_points_that_are_not_asked_for_are_not_read(colmap: ColmapDataParserConfig, reads: list[Path]):
    parser = dataclasses.replace(colmap, load_3D_points=False)
    datamanager = load(parser)
    assert reads == []
    assert not datamanager.train_dataset.metadata.keys() & set(READ)
