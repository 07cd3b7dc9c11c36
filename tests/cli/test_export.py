"""sadgs-export: the mathematics of changing frames, the file as foreign readers see it, and what errors say."""

from __future__ import annotations

import dataclasses
import json
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
import torch
import trimesh
import yaml
from gsplat.cuda._torch_impl import _quat_scale_to_covar_preci, _spherical_harmonics
from hypothesis import given
from hypothesis import strategies as st
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanagerConfig
from numpy.testing import assert_allclose, assert_array_equal
from plyfile import PlyData
from scipy.spatial.transform import Rotation

from examples.drawn_scene.scene import SPARSE_FOLDER, write_scene
from helpers.generators import seeded
from helpers.gsplat_like import splatted
from helpers.json_files import read_json, write_json
from helpers.kill_and_resume import configure, parser_of, set_up
from helpers.refusals import refusal
from helpers.short_runs import nerfstudio_data
from sadgs_ns.cli import export
from sadgs_ns.cli.export import Export
from sadgs_ns.data.coordinates import Similarity, from_data, spherical_harmonics
from sadgs_ns.data.run_cameras import find_capture, read_cameras
from sadgs_ns.formats import FORMATS, html
from sadgs_ns.geometry import cleaning
from sadgs_ns.training.run.run_folder import write_config
from sadgs_ns.training.run.trainer import SadgsTrainer

WIDTH = 48
HEIGHT = 36
VIEWS = 10
PARAMS = {
    "means": (3,),
    "scales": (3,),
    "quats": (4,),
    "opacities": (1,),
    "features_dc": (3,),
    "features_rest": (15, 3),
}
SWAP = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])
"""What nerfstudio does with COLMAP's axes: a rotation."""


def gaussians(n: int, seed: int = 0) -> dict[str, torch.Tensor]:
    generator = seeded(seed)
    return {name: torch.randn((n, *shape), generator=generator) for name, shape in PARAMS.items()}


def random_orthogonal(seed: int, reflection: bool) -> np.ndarray:
    matrix, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return matrix * np.linalg.det(matrix) * (-1 if reflection else 1)


def directions(n: int = 100) -> np.ndarray:
    vectors = np.random.default_rng(5).normal(size=(n, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def write_run(folder: Path, params: dict[str, torch.Tensor], transform: Any = None, scale: float = 1.0) -> Path:
    """What a training run leaves, as far as it is exported."""
    (folder / "nerfstudio_models").mkdir(parents=True)
    (folder / "config.yml").write_text("!!python/object/apply:os.abort []")  # nobody may read it
    pipeline = {f"_model.gauss_params.{name}": value for name, value in params.items()}
    state = {"step": 7, "pipeline": pipeline, "optimizers": {}, "scalers": {}}
    torch.save(state, folder / "nerfstudio_models/step-000000007.ckpt")
    if transform is not None:
        noted = {"transform": np.asarray(transform).tolist(), "scale": scale}
        write_json(folder / "dataparser_transforms.json", noted)
    return folder


def read(path: Path, *names: str) -> np.ndarray:
    vertex = PlyData.read(str(path))["vertex"]
    return np.stack([vertex[name] for name in names], -1)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, SadgsTrainer]:
    """A scene, and a short run on it whose colours and opacities are made to differ as those of a long one."""
    folder = tmp_path_factory.mktemp("export")
    write_scene(folder / "scene", WIDTH, HEIGHT, VIEWS, points=300)
    config = configure(folder / "scene", folder, iterations=12, save_every=0)
    config.pipeline.datamanager.dataparser.scale_factor = 0.4  # type: ignore[attr-defined]  # the scene's is about 1
    trainer = set_up(config)
    trainer.train()
    generator = seeded(0)
    params = trainer.pipeline.model.gauss_params
    params["features_rest"].data = 0.3 * torch.randn(params["features_rest"].shape, generator=generator)
    params["opacities"].data = torch.randn(params["opacities"].shape, generator=generator)
    trainer.save_checkpoint(11)
    write_config(trainer.config)
    return folder / "scene", trainer


# --- the mathematics ---


def test_the_harmonics_are_gsplat_s_and_orthonormal():
    basis = spherical_harmonics(directions(), 3)
    for band in range(16):
        coefficients = torch.eye(16, dtype=torch.float64)[band].repeat(100, 1)[..., None].expand(-1, -1, 3)
        theirs = _spherical_harmonics(3, torch.from_numpy(directions()), coefficients)[:, 0]
        actual = basis[:, band]
        assert_allclose(actual, theirs, atol=2e-14)
    identity = Similarity(1.0, np.eye(3), np.zeros(3)).harmonics(3)
    expected = np.eye(16)
    assert_allclose(identity, expected, atol=1e-14)


@given(seed=st.integers(0, 2**32 - 1), reflection=st.booleans(), degree=st.integers(0, 3))
def test_rotated_harmonics_in_rotated_directions_give_the_colours_of_before(seed: int, reflection: bool, degree: int):
    similarity = Similarity(2.0, random_orthogonal(seed, reflection), np.zeros(3))
    coefficients = np.random.default_rng(seed).normal(size=((degree + 1) ** 2, 3))
    before = spherical_harmonics(directions(), degree) @ coefficients
    rotated = similarity.harmonics(degree) @ coefficients
    after = spherical_harmonics(directions() @ similarity.orthogonal.T, degree) @ rotated
    assert_allclose(after, before, atol=1e-12)
    there_and_back = similarity.inverse().harmonics(degree) @ similarity.harmonics(degree)
    expected = np.eye(len(there_and_back))
    assert_allclose(there_and_back, expected, atol=1e-12)


def test_swapped_axes_swap_harmonics_exactly_to_rounding():
    """x' = y, y' = x, z' = −z: every harmonic becomes plus or minus one of the others."""
    becomes = {0: 0, 1: 3, 2: -2, 3: 1, 4: 4, 5: -7, 6: 6, 7: -5, 8: -8}
    becomes |= {9: -15, 10: -10, 11: 13, 12: -12, 13: 11, 14: 14, 15: -9}
    expected = np.zeros((16, 16))
    for before, after in becomes.items():
        expected[abs(after), before] = -1 if after < 0 else 1
    actual = Similarity(1.0, SWAP, np.zeros(3)).harmonics(3)
    assert_allclose(actual, expected, atol=2e-15)


@given(seed=st.integers(0, 2**32 - 1), reflection=st.booleans())
def test_covariances_turn_with_the_world(seed: int, reflection: bool):
    scale = 0.3
    orthogonal = random_orthogonal(seed, reflection)
    similarity = Similarity(scale, orthogonal, np.array([1.0, 2, 3]))
    generator = np.random.default_rng(seed)
    quats = generator.normal(size=(5, 4))
    scales = generator.normal(size=(5, 3))
    means = generator.normal(size=(5, 3))

    def covariances(quats: np.ndarray, scales: np.ndarray) -> np.ndarray:
        covars, _ = _quat_scale_to_covar_preci(torch.tensor(quats), torch.tensor(scales).exp(), True, False)
        assert covars is not None
        return covars.numpy()

    after = covariances(similarity.rotations(quats), similarity.log_scales(scales))
    expected = scale**2 * orthogonal @ covariances(quats, scales) @ orthogonal.T
    assert_allclose(after, expected, atol=1e-12 * np.abs(expected).max())
    broken = np.array([[0.0, 0, 0, 0], [np.nan, 0, 0, 0], [1, np.inf, 0, 0]])
    assert not np.isfinite(similarity.rotations(broken)[1:]).all(axis=1).any()  # the export then drops them
    moved = similarity.positions(means)
    actual = moved[1] - moved[0]
    assert_allclose(actual, scale * orthogonal @ (means[1] - means[0]), atol=1e-12)
    actual = similarity.inverse().positions(moved)
    assert_allclose(actual, means, atol=1e-12)


def test_a_float32_rotation_is_made_orthogonal():
    written = random_orthogonal(3, reflection=False).astype(np.float32)
    similarity = Similarity.of(np.c_[0.25 * written, [1, 2, 3]])
    actual = similarity.orthogonal @ similarity.orthogonal.T
    expected = np.eye(3)
    assert_allclose(actual, expected, atol=1e-14)
    assert similarity.scale == pytest.approx(0.25, abs=1e-7)


# --- the file ---


def test_the_export_in_colmap_s_frame_looks_through_colmap_s_cameras_as_the_model_does(
    trained: tuple[Path, SadgsTrainer], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    scene, trainer = trained
    model = trainer.pipeline.model.eval()
    dataset = trainer.pipeline.datamanager.train_dataset
    path = tmp_path / "splat.ply"
    export.main([str(trainer.base_dir / "config.yml"), "--output", str(path), "--frame", "colmap"])
    printed = capsys.readouterr().out
    size = path.stat().st_size
    assert f"{model.num_points:,} Gaussians, {size / 1e6:,.1f} MB, in the frame of colmap" in printed
    means = read(path, "x", "y", "z")
    rest = read(path, *(f"f_rest_{i}" for i in range(45))).reshape(-1, 3, 15).transpose(0, 2, 1)
    harmonics = np.concatenate([read(path, "f_dc_0", "f_dc_1", "f_dc_2")[:, None], rest], 1)
    quats = read(path, *(f"rot_{i}" for i in range(4)))
    scales = np.exp(read(path, "scale_0", "scale_1", "scale_2"))
    opacities = torch.sigmoid(torch.from_numpy(read(path, "opacity")[:, 0]))
    scale = trainer.pipeline.datamanager.train_dataparser_outputs.dataparser_scale
    assert scale < 0.5
    reconstruction = pycolmap.Reconstruction(scene / SPARSE_FOLDER)
    for index in (0, len(dataset) - 1):
        name = dataset.image_filenames[index].name
        image = next(image for image in reconstruction.images.values() if image.name == name)
        camera = reconstruction.cameras[image.camera_id]
        pose: Any = image.cam_from_world  # a method from pycolmap 3.12 on
        pose = pose() if callable(pose) else pose
        viewmat = np.eye(4)
        viewmat[:3] = pose.matrix()
        render, _, _ = splatted(
            torch.from_numpy(means),
            torch.from_numpy(quats),
            torch.from_numpy(scales),
            opacities,
            torch.from_numpy(harmonics),
            torch.from_numpy(viewmat).float()[None],
            torch.from_numpy(camera.calibration_matrix()).float()[None],
            camera.width,
            camera.height,
            near_plane=0.01 / scale,
            sh_degree=3,
        )
        shown = model.get_outputs(dataset.cameras[index : index + 1])["rgb"]
        assert float(shown.std()) > 0.05
        error = (render[0].clamp(0, 1) - shown).square().mean()
        assert float(-10 * error.log10()) > 70, name  # dB


def test_without_rotating_the_harmonics_the_picture_would_differ(trained: tuple[Path, SadgsTrainer]):
    """So that the test above tests them."""
    _, trainer = trained
    matrix = from_data(trainer.base_dir / "dataparser_transforms.json").inverse().harmonics(3)
    rest = trainer.pipeline.model.gauss_params["features_rest"].detach().numpy()
    assert np.abs(matrix[1:, 1:] @ rest - rest).max() > 0.3


def test_nerfstudio_s_frame_keeps_the_parameters_and_colmap_s_returns_to_the_points(
    trained: tuple[Path, SadgsTrainer], tmp_path: Path
):
    scene, trainer = trained
    model = trainer.pipeline.model
    assert export.export(Export(trainer.base_dir, tmp_path / "splat.ply")) == model.num_points
    actual = read(tmp_path / "splat.ply", "x", "y", "z")
    assert_array_equal(actual, model.means.detach())
    actual = read(tmp_path / "splat.ply", "f_rest_17")[:, 0]
    assert_array_equal(actual, model.shs_rest.detach()[:, 2, 1])
    # nerfstudio's own points, moved back, are COLMAP's.
    points = trainer.pipeline.datamanager.train_dataset.metadata["points3D_xyz"].double().numpy()
    back = from_data(trainer.base_dir / "dataparser_transforms.json").inverse().positions(points)
    reconstruction = pycolmap.Reconstruction(scene / SPARSE_FOLDER)
    expected = np.array([point.xyz for _, point in sorted(reconstruction.points3D.items())])
    actual = np.sort(back, 0)
    assert_allclose(actual, np.sort(expected, 0), atol=1e-5)


@pytest.mark.hard_case(
    "a GLB in the frame of data in which y is up, such as ARKit's, or z", "upright; it was upside down, or lay there"
)
@pytest.mark.parametrize(
    ("rows", "node"),
    {
        "x right, y up": ([0, 2, 1], [0, 0, 0, 1]),
        "z up": ([0, 1, 2], [-(0.5**0.5), 0, 0, 0.5**0.5]),
        "y down": ([0, 2, -1], [1, 0, 0, 0]),
    }.values(),
)
def test_a_glb_in_the_data_s_frame_is_upright(rows: list[int], node: list[float], tmp_path: Path):
    transform = np.zeros((3, 4))
    for row, column in enumerate(rows):  # Rows of the map from the data to z up; a negative one is −y.
        transform[row, abs(column)] = -1 if column < 0 else 1
    transform[1] *= np.linalg.det(transform[:, :3])
    tilt = Rotation.from_rotvec([0.2, -0.1, 0.0]).as_matrix()
    run = write_run(tmp_path / "run", gaussians(3), tilt @ transform, 2.0)
    export.export(Export(run, tmp_path / "splat.glb", "colmap"))
    data = (tmp_path / "splat.glb").read_bytes()
    (found,) = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])["nodes"]
    assert_allclose(found["rotation"], node, atol=1e-12)


@pytest.mark.parametrize("n", [1, 70_000])
def test_a_foreign_reader_finds_every_gaussian(n: int, tmp_path: Path):
    """70,000 are more than are written at a time."""
    params = gaussians(n)
    transform = np.c_[SWAP, [1.0, 2, 3]]
    run = write_run(tmp_path / "run", params, transform, scale=0.5)
    actual = export.export(Export(run, tmp_path / "splat.ply", "colmap"))
    assert actual == n
    cloud = trimesh.load(tmp_path / "splat.ply")
    expected = (params["means"].double().numpy() / 0.5 - [1, 2, 3]) @ SWAP
    assert_allclose(cloud.vertices, expected, rtol=1e-6, atol=1e-6)  # type: ignore[union-attr]
    vertex = PlyData.read(str(tmp_path / "splat.ply"))["vertex"]
    assert vertex.count == n
    assert_allclose(vertex["scale_1"], params["scales"][:, 1] + np.log(2), rtol=1e-5, atol=1e-6)
    assert_array_equal(vertex["opacity"], params["opacities"][:, 0])
    assert_array_equal(vertex["f_dc_2"], params["features_dc"][:, 2])


def test_what_is_not_finite_is_dropped_in_every_part_of_the_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    params = gaussians(140_000)
    params["means"][0, 0] = torch.nan
    params["features_rest"][69_000:, 2, 1] = torch.inf  # the last part is empty, and the count has a digit less
    params["means"][5, 1] = 3e38  # finite, but not in a frame in which the unit is smaller
    run = write_run(tmp_path / "run", params, np.eye(3, 4), scale=0.1)
    actual = export.export(Export(run, tmp_path / "splat.ply", "colmap"))
    assert actual == 68_998
    printed = capsys.readouterr().out
    assert "dropped 71002 of 140000 Gaussians that are not finite" in printed
    vertex = PlyData.read(str(tmp_path / "splat.ply"))["vertex"]
    assert vertex.count == 68_998
    for p in vertex.properties:
        assert np.isfinite(vertex[p.name]).all()
    assert len(trimesh.load(tmp_path / "splat.ply").vertices) == 68_998  # type: ignore[union-attr]


def test_colours_without_harmonics_become_those_of_degree_0(tmp_path: Path):
    params = gaussians(5) | {"features_rest": torch.zeros(5, 0, 3)}
    run = write_run(tmp_path / "run", params, np.eye(3, 4))
    export.export(Export(run, tmp_path / "splat.ply", "colmap"))
    shown = 0.5 + 0.28209479 * read(tmp_path / "splat.ply", "f_dc_0", "f_dc_1", "f_dc_2")
    expected = torch.sigmoid(params["features_dc"])
    assert_allclose(shown, expected, atol=1e-6)
    assert "f_rest_0" not in {p.name for p in PlyData.read(str(tmp_path / "splat.ply"))["vertex"].properties}


def test_a_reflection_of_the_world_is_undone_as_well(tmp_path: Path):
    params = gaussians(5)
    mirror = np.diag([1.0, 1, -1])
    run = write_run(tmp_path / "run", params, np.c_[mirror, np.zeros(3)])
    export.export(Export(run, tmp_path / "splat.ply", "colmap"))
    actual = read(tmp_path / "splat.ply", "x", "y", "z")
    expected = params["means"] @ mirror
    assert_allclose(actual, expected, atol=1e-6)
    # Of degree 1 only z, the second, changes sign.
    actual = read(tmp_path / "splat.ply", "f_rest_0")[:, 0]
    expected = params["features_rest"][:, 0, 0]
    assert_allclose(actual, expected, atol=1e-6)
    actual = read(tmp_path / "splat.ply", "f_rest_1")[:, 0]
    expected = -params["features_rest"][:, 1, 0]
    assert_allclose(actual, expected, atol=1e-6)


# --- the other formats ---


@pytest.mark.parametrize("suffix", [suffix for suffix in FORMATS if suffix not in (".ply", ".html")])
def test_every_format_is_written_of_a_run(
    suffix: str, trained: tuple[Path, SadgsTrainer], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    """tests/formats reads them back."""
    _, trainer = trained
    path = tmp_path / f"splat{suffix}"
    status = export.main([str(trainer.base_dir), "--output", str(path), "--frame", "colmap"])
    assert status == 0
    printed = capsys.readouterr().out
    assert f"splat{suffix}: {trainer.pipeline.model.num_points:,} Gaussians, " in printed
    assert path.stat().st_size > 1000


def test_the_cameras_of_a_run_are_those_of_training_however_it_moved_the_capture(trained: tuple[Path, SadgsTrainer]):
    """The run scaled the capture by 0.4, which the parser does not do by itself."""
    _, trainer = trained
    expected = trainer.pipeline.datamanager.train_dataset
    found = read_cameras(trainer.base_dir)
    assert_allclose(found.camera_to_worlds, expected.cameras.camera_to_worlds, atol=1e-5)
    assert_allclose(found.Ks, expected.cameras.get_intrinsics_matrices())
    assert found.sizes == [(WIDTH, HEIGHT)] * len(expected)


def write_parser_config(run: Path, parser: Any) -> None:
    """What nerfstudio writes of a run, as far as its cameras need it."""
    run.mkdir()
    manager = FullImageDatamanagerConfig(data=None, dataparser=parser)
    (run / "config.yml").write_text(yaml.dump({"pipeline": {"datamanager": manager}}))


@pytest.mark.hard_case(
    "a run on `colmap --colmap-path sparse/1` beside another model, and options that decide which views are held out",
    "files, pages and cleaning use the cameras that the run had",
)
def test_the_cameras_are_read_as_the_run_read_them(tmp_path: Path):
    write_scene(tmp_path / "scene", WIDTH, HEIGHT, VIEWS, points=300)
    (tmp_path / "scene/sparse/0").rename(tmp_path / "scene/sparse/1")
    write_scene(tmp_path / "other", WIDTH, HEIGHT, VIEWS - 1, points=300)
    (tmp_path / "other/sparse/0").rename(tmp_path / "scene/sparse/0")
    parser = parser_of(tmp_path / "scene")
    parser.colmap_path = Path("sparse/1")
    parser.eval_interval = 3
    expected = parser.setup().get_dataparser_outputs("train").cameras
    write_parser_config(tmp_path / "run", parser)
    found = read_cameras(tmp_path / "run")
    assert len(found.sizes) == len(expected) == VIEWS - len(range(0, VIEWS, 3))
    assert_array_equal(found.camera_to_worlds, expected.camera_to_worlds)


@pytest.mark.hard_case(
    "a run on another folder of images, on smaller ones that are gone, or with other options of its parser; a capture "
    "that has moved since",
    "the run's cameras, without a question",
)
@pytest.mark.parametrize(
    "options",
    [
        {"images_path": Path("photos"), "eval_mode": "fraction", "train_split_fraction": 0.5},
        {"downscale_factor": 2, "orientation_method": "none", "center_method": "none"},
        {"downscale_factor": 2, "downscale_rounding_mode": "ceil", "scale_factor": 3.0, "auto_scale_poses": False},
    ],
)
def test_the_cameras_of_a_moved_capture_are_the_run_s(options: dict, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    write_scene(tmp_path / "scene", WIDTH + 1, HEIGHT, VIEWS, points=300)
    parser = dataclasses.replace(parser_of(tmp_path / "scene"), **options)
    (tmp_path / "scene/images").rename(tmp_path / "scene" / parser.images_path)
    (tmp_path / "scene" / f"{parser.images_path}_2").mkdir()
    expected = parser.setup().get_dataparser_outputs("train")
    write_parser_config(tmp_path / "run", parser)
    (tmp_path / "scene" / f"{parser.images_path}_2").rmdir()
    (tmp_path / "scene").rename(tmp_path / "moved")
    monkeypatch.setattr("rich.prompt.Confirm.ask", None)
    found = read_cameras(tmp_path / "run", tmp_path / "moved")
    assert_array_equal(found.camera_to_worlds, expected.cameras.camera_to_worlds)
    assert_array_equal(found.Ks, expected.cameras.get_intrinsics_matrices())


@pytest.mark.hard_case(
    "a run on a transforms.json of another name, its folder with --data, or a copy of the capture in another layout",
    "the run's cameras where its parser can read the folder, else those of the parser that can",
)
def test_data_may_be_a_copy_of_another_layout(tmp_path: Path):
    parser = nerfstudio_data(tmp_path / "data")
    parser.data = (tmp_path / "data/transforms.json").rename(tmp_path / "data/other.json")
    parser.eval_mode = "interval"
    parser.eval_interval = 3
    write_parser_config(tmp_path / "run", parser)
    expected = parser.setup().get_dataparser_outputs("train").cameras.camera_to_worlds
    assert_array_equal(read_cameras(tmp_path / "run").camera_to_worlds, expected)
    with refusal(r"data cannot be read as a capture \(.*: give another with --data\.$"):
        read_cameras(tmp_path / "run", tmp_path / "data")
    parser.data.rename(tmp_path / "data/transforms.json")
    actual = read_cameras(tmp_path / "run", tmp_path / "data").camera_to_worlds
    assert_array_equal(actual, expected)
    write_scene(tmp_path / "copy", WIDTH, HEIGHT, VIEWS, points=300)
    actual = len(read_cameras(tmp_path / "run", tmp_path / "copy").sizes)
    assert actual == VIEWS - len(range(0, VIEWS, 8))


@pytest.mark.hard_case(
    "a page or cleaning of a capture with transforms.json, without libusb-1.0 or without a PLY of its points",
    "the cameras are read without the points: open3d is not imported, nothing is asked and nothing is written",
)
@pytest.mark.parametrize("ply", [True, False])
def test_cameras_are_read_without_their_points(ply: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    parser = nerfstudio_data(tmp_path / "data")
    meta = read_json(tmp_path / "data/transforms.json")
    meta.pop("ply_file_path", None)
    write_json(tmp_path / "data/transforms.json", meta | ({"ply_file_path": "points.ply"} if ply else {}))
    (tmp_path / "data/colmap/sparse/0").mkdir(parents=True)
    parser.load_3D_points = True
    write_parser_config(tmp_path / "run", parser)
    before = sorted((path, path.stat().st_mtime_ns) for path in (tmp_path / "data").rglob("*"))
    monkeypatch.setitem(sys.modules, "open3d", None)  # type: ignore[arg-type]  # Importing it raises ImportError.
    monkeypatch.setattr("rich.prompt.Confirm.ask", None)
    assert len(read_cameras(tmp_path / "run").sizes) > 1
    actual = sorted((path, path.stat().st_mtime_ns) for path in (tmp_path / "data").rglob("*"))
    assert actual == before


def test_a_page_opens_at_the_training_camera_in_the_middle_and_has_the_capture_s_name(
    trained: tuple[Path, SadgsTrainer], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    _, trainer = trained
    page = b'<title>Viewer</title>\n<script type="application/json" id="sse-bootstrap">{"settings": {}}</script>'
    monkeypatch.setattr(html, "_page", lambda: page)
    command = [str(trainer.base_dir / "config.yml"), "--output", str(tmp_path / "splat.html")]
    status = export.main([*command, "--title", "My room"])
    assert status == 0
    assert (tmp_path / "splat.html").read_text().startswith("<title>My room</title>")
    status = export.main(command)
    assert status == 0
    title, line = (tmp_path / "splat.html").read_text().splitlines()
    capture = trainer.config.pipeline.datamanager.dataparser.data
    assert title == f"<title>{capture.name}</title>"
    settings = json.loads(re.findall(r">(.*)<", line)[0])["settings"]
    positions = trainer.pipeline.datamanager.train_dataset.cameras.camera_to_worlds[:, :, 3].double().numpy()
    x, y, z = positions[html.middle_camera(positions)]
    actual = settings["cameras"][0]["initial"]["position"]
    expected = [x, z, -y]
    assert_allclose(actual, expected, atol=1e-5)


def test_the_capture_is_found_without_executing_the_config(tmp_path: Path):
    config = """!!python/object:a.Config
_target: !!python/name:b.C ''
other: !!python/object/apply:os.abort []
pipeline: !!python/object:c.Pipeline
  datamanager: !!python/object:d.Manager
    data: &id !!python/object/apply:pathlib.PosixPath [{}]
    dataparser: {{data: *id}}
"""
    parts = ", ".join(f"'{part}'" for part in tmp_path.parts)
    (tmp_path / "config.yml").write_text(config.format(parts))
    assert find_capture(tmp_path)[0] == tmp_path
    (tmp_path / "config.yml").write_text(config.format("gone"))
    with refusal(r"^gone, on which .* was trained, is not there: give the .* with --data\.$"):
        read_cameras(tmp_path)
    for broken in ("a: [", "a: 1", "!!python/object/apply:os.abort []"):
        (tmp_path / "config.yml").write_text(broken)
        with refusal(r"config\.yml does not tell where the capture is \(.+\): give .*--data\.$"):
            find_capture(tmp_path)


def test_a_capture_that_cannot_be_read_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    run = write_run(tmp_path / "run", gaussians(3))
    (tmp_path / "empty").mkdir()
    options = [str(run), "--output", str(tmp_path / "a.html"), "--data", str(tmp_path / "empty")]
    status = export.main(options)
    assert status == 2
    errors = capsys.readouterr().err
    assert re.fullmatch(r"sadgs-export: .*empty.*\.\n", errors)
    status = export.main([*options, "--frame", "colmap"])
    assert status == 2
    errors = capsys.readouterr().err
    assert errors.startswith("sadgs-export: --frame colmap is for files that other programs read: ")


# --- cleaning ---


def test_what_is_taken_away_is_told_and_not_in_the_file(
    trained: tuple[Path, SadgsTrainer], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    _, trainer = trained
    model = trainer.pipeline.model
    path = tmp_path / "splat.ply"
    means = model.means.detach().numpy()
    low = np.round(np.quantile(means, 0.1, axis=0), 3)
    high = np.round(np.quantile(means, 0.9, axis=0), 3)
    extents = model.scales.detach().exp().amax(dim=1).numpy()
    longest = float(np.round(np.quantile(extents, 0.9), 4))
    options = ["--crop", *map(str, low), *map(str, high), "--max-extent", str(longest), "--min-views", "2"]
    status = export.main([str(trainer.base_dir), "--output", str(path), *options, "--dust", "0.01"])
    assert status == 0
    told = [int(line.split()[0].replace(",", "")) for line in capsys.readouterr().out.splitlines()[:4]]
    inside = ((means >= low.astype(np.float32)) & (means <= high.astype(np.float32))).all(axis=1)
    assert told[0] == (~inside).sum() > 0
    assert told[1] == (extents[inside] > longest).sum() > 0
    kept = read(path, "x", "y", "z")
    assert len(kept) == model.num_points - sum(told) > 0
    assert (kept >= low - 1e-6).all()
    assert (kept <= high + 1e-6).all()
    known = {tuple(row) for row in means[inside & (extents <= longest)]}
    assert {tuple(row) for row in kept} <= known


@pytest.mark.hard_case(
    "cleaning that takes everything away, a box that is reversed, numbers that are negative or NaN",
    "refused: names the option",
)
@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ("--min-views -1", r"--min-views -1 must be 0, which takes nothing away, or more\."),
        ("--dust nan", r"--dust nan must be 0, .*\."),
        ("--max-extent 0", r"--max-extent 0 must be more than 0: leave it out to take nothing away\."),
        ("--crop 0 0 0 1 -1 1", r"--crop 0 0 0 1 -1 1 is no box: give the lowest x, y and z, then the highest .*\."),
        ("--max-extent 1e-9", r"These options take away all 3 Gaussians: nothing is written, so take fewer away\."),
        ("--min-views 2", r".*config\.yml does not tell where the capture is \(.*\): give its folder with --data\."),
    ],
)
def test_cleaning_that_cannot_be_meant_is_refused(
    options: str, sentence: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    run = write_run(tmp_path / "run", gaussians(3))
    status = export.main([str(run), "--output", str(tmp_path / "a.ply"), *options.split()])
    assert status == 2
    errors = capsys.readouterr().err
    assert re.fullmatch(f"sadgs-export: {sentence}\n", errors)
    assert not (tmp_path / "a.ply").exists()


# --- which run, and what goes wrong ---


def test_the_run_is_its_folder_its_config_or_a_checkpoint_and_the_latest_is_taken(tmp_path: Path):
    run = write_run(tmp_path / "run", gaussians(3))
    models = run / "nerfstudio_models"
    later = torch.load(models / "step-000000007.ckpt", weights_only=True)
    later["pipeline"] = {f"_model.gauss_params.{name}": value for name, value in gaussians(9).items()}
    torch.save(later, models / "step-000000011.ckpt")
    counts = [export.export(Export(path, tmp_path / "a.ply")) for path in (run, run / "config.yml", models)]
    assert counts == [9, 9, 9]
    actual = export.export(Export(models / "step-000000007.ckpt", tmp_path / "a.ply"))
    assert actual == 3


def test_a_damaged_latest_checkpoint_is_passed_over_aloud(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    run = write_run(tmp_path / "run", gaussians(3))
    (run / "nerfstudio_models/step-000000011.ckpt").write_bytes(b"half")
    actual = export.export(Export(run, tmp_path / "a.ply"))
    assert actual == 3
    printed = " ".join(capsys.readouterr().out.split())
    assert "step-000000011.ckpt is cut off, damaged" in printed
    assert "step-000000007.ckpt instead" in printed


@pytest.mark.parametrize(
    ("case", "sentence"),
    [
        ("no run", r".*nowhere does not exist: give the folder of a run, its config\.yml or a checkpoint .*\."),
        ("no checkpoint", r".*run holds no checkpoint: give the folder .*\."),
        ("damaged", r".*7\.ckpt is cut off, damaged .*: give another checkpoint step-\*\.ckpt of a run of sadgs .*\."),
        ("no means", r".*7\.ckpt holds no means of Gaussians, so another method made it: give another .*\."),
        ("wrong shape", r".*7\.ckpt holds no .* exported \(quats must .* \[3, 4\], got \[3, 3\]\): give another .*\."),
        ("degree 4", r".*7\.ckpt holds no .* exported \(features_rest must hold .*, got 24\): give another .*\."),
        ("no transform", r".*run/data\S+\.json does not tell how to return .* \(No such file .*\): copy it .*\."),
        ("shear", r".*transforms\.json does not tell .* \(it is no rotation, scale and translation\): copy .*\."),
        ("not json", r".*transforms\.json does not tell how to return to the data's frame \(.*\): copy it .*\."),
        ("nan", r".*transforms\.json does not tell .*\): copy it from the run again, or export in .*\."),
        ("far", r"--frame colmap puts the splat 1e\+08 units from .*, where float32 has steps of 8: leave it .*\."),
        ("suffix", r"--output .*a\.splat must end in \.ply, \.compressed\.ply, .* or \.mesh\.ply\."),
        ("folder", r"--output .*a\.ply is a folder: name a file in it\."),
    ],
)  # fmt: skip
def test_errors_are_one_sentence_and_leave_nothing(
    case: str, sentence: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    params = gaussians(3)
    if case == "no means":
        del params["means"]
    if case == "wrong shape":
        params["quats"] = params["quats"][:, :3]
    if case == "degree 4":
        params["features_rest"] = torch.zeros(3, 24, 3)
    transform = np.eye(3, 4)
    transform[0, 1] = {"shear": 0.1, "nan": np.nan}.get(case, 0.0)
    transform[0, 3] = 1e8 if case == "far" else 0.0
    run = write_run(tmp_path / "run", params, None if case == "no transform" else transform)
    checkpoint = run / "nerfstudio_models/step-000000007.ckpt"
    if case == "not json":
        (run / "dataparser_transforms.json").write_text("{")
    if case == "no checkpoint":
        checkpoint.unlink()
    if case == "damaged":
        checkpoint.write_bytes(checkpoint.read_bytes()[:-100])
    output = tmp_path / ("a.splat" if case == "suffix" else "a.ply")
    if case == "folder":
        output.mkdir()
    there = set(tmp_path.iterdir())
    run = tmp_path / "nowhere" if case == "no run" else run
    status = export.main([str(run), "--output", str(output), "--frame", "colmap"])
    assert status == 2
    printed = capsys.readouterr().err
    assert re.fullmatch(f"sadgs-export: {sentence}\n", printed), printed
    assert set(tmp_path.iterdir()) == there


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
def test_a_full_disk_leaves_the_file_that_was_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    run = write_run(tmp_path / "run", gaussians(3))
    output = tmp_path / "a.ply"
    output.write_text("earlier")
    partial = tmp_path / ".a.partial.ply"
    partial.symlink_to("/dev/full")
    status = export.main([str(run), "--output", str(output)])
    assert status == 2
    errors = capsys.readouterr().err
    assert "a.ply could not be written (No space left on device; " in errors
    assert output.read_text() == "earlier"
    assert not partial.is_symlink()


@pytest.mark.hard_case(
    "a full GPU while `sadgs-export` looks from the training views", "one sentence that names the remedy"
)
def test_a_gpu_that_is_full_is_one_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def full(*_: Any, **__: Any) -> None:
        raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 22.00 MiB.")

    run = write_run(tmp_path / "run", gaussians(3))
    monkeypatch.setattr(cleaning, "choose_remaining", full)
    command = [str(run), "--output", str(tmp_path / "a.ply")]
    status = export.main([*command, "--max-extent", "0.5"])
    assert status == 2
    told = f"sadgs-export: the GPU's memory does not hold {run}: end other programs on it, or work on the CPU: "
    assert capsys.readouterr().err.startswith(told)
    assert not (tmp_path / "a.ply").exists()

    def mistaken(*_: Any, **__: Any) -> None:
        raise RuntimeError("a mistake")

    monkeypatch.setattr(cleaning, "choose_remaining", mistaken)
    with pytest.raises(RuntimeError, match="a mistake"):
        export.main([*command, "--max-extent", "0.5"])
