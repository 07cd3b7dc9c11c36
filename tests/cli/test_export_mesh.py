"""`sadgs-export --output ….mesh.ply`: the mesh of Gaussians on the drawn room's surfaces, and what is refused."""

from __future__ import annotations

import importlib.abc
import math
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from numpy.testing import assert_allclose
from plyfile import PlyData
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from examples.drawn_scene.drawing import Sphere
from examples.drawn_scene.scene import room_surfaces, write_scene
from helpers.drawn_surfaces import nearest
from helpers.json_files import write_json
from helpers.refusals import refusal
from sadgs_ns.cli import export, meshing
from sadgs_ns.data.coordinates import Similarity
from sadgs_ns.data.run_cameras import read_cameras
from sadgs_ns.formats import mesh
from sadgs_ns.formats.gaussians import DEGREE_0
from sadgs_ns.render.types import RenderOptions

ROOM = room_surfaces()
WIDTH = 80
HEIGHT = 60
VIEWS = 12
SPACING = 0.04
"""Between the centres of Gaussians, in the room's units; their long standard deviations are half of it."""
MOVED = Similarity(0.4, Rotation.from_euler("xyz", [0.3, -0.5, 1.2]).as_matrix(), np.array([0.1, -0.2, 0.05]))
"""How nerfstudio is said to have moved the room."""


def gaussians_of_the_room(rng: np.random.Generator) -> dict[str, torch.Tensor]:
    """Flat, opaque Gaussians on all surfaces, as training holds them, in the moved frame."""
    parts = []
    for surface in ROOM:
        points = surface.sample(math.ceil(surface.area / SPACING**2), rng)
        if isinstance(surface, Sphere):
            normals = (points - surface.centre) / surface.radius
        else:
            normals = np.broadcast_to(surface.normal, points.shape)
        axes, _, _ = np.linalg.svd(normals[:, :, None])  # The first column is ± the normal.
        axes = MOVED.orthogonal @ axes[..., [1, 2, 0]]
        axes *= np.linalg.det(axes)[:, None, None]
        parts.append((MOVED.positions(points), Rotation.from_matrix(axes).as_quat()[:, [3, 0, 1, 2]],
                      surface.colour(points)))  # fmt: skip
    means, quats, colors = (torch.from_numpy(np.concatenate(part)).float() for part in zip(*parts, strict=True))
    scales = SPACING * torch.tensor([0.5, 0.5, 0.05]) * MOVED.scale
    return {
        "means": means,
        "quats": quats,
        "scales": scales.log().repeat(len(means), 1),
        "opacities": torch.full((len(means), 1), 4.0),
        "features_dc": (colors - 0.5) / DEGREE_0,
        "features_rest": torch.zeros((len(means), 3, 3)),
    }


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A capture of the room, and what a run on it leaves."""
    folder = tmp_path_factory.mktemp("mesh")
    write_scene(folder / "scene", WIDTH, HEIGHT, VIEWS, points=50)
    (folder / "run/nerfstudio_models").mkdir(parents=True)
    params = gaussians_of_the_room(np.random.default_rng(0))
    pipeline = {f"_model.gauss_params.{name}": value for name, value in params.items()}
    state = {"step": 7, "pipeline": pipeline, "optimizers": {}, "scalers": {}}
    torch.save(state, folder / "run/nerfstudio_models/step-000000007.ckpt")
    transform = np.c_[MOVED.orthogonal, MOVED.translation / MOVED.scale]
    noted = {"transform": transform.tolist(), "scale": MOVED.scale}
    write_json(folder / "run/dataparser_transforms.json", noted)
    (folder / "run/config.yml").write_text("!!python/object/apply:os.abort []")  # nobody may execute it
    return folder / "scene", folder / "run"


def command(run: tuple[Path, Path], output: Path, *options: str) -> int:
    return export.main([str(run[1]), "--output", str(output), "--data", str(run[0]), *options])


@pytest.mark.usefixtures("open3d")
def test_the_mesh_lies_on_the_room_s_surfaces_in_both_frames(
    run: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    voxel = 0.06  # of the room; what is drawn first of opaque Gaussians lies about a standard deviation before them
    size = ["--voxel-size", str(voxel * MOVED.scale)]
    for frame in ("colmap", "nerfstudio"):
        path = tmp_path / f"{frame}.mesh.ply"
        status = command(run, path, *size, "--frame", frame)
        assert status == 0
        found = PlyData.read(str(path))
        said = rf"{path}: {found['face'].count:,} triangles fused from rendered depth, .* in the frame of {frame}\n"
        printed = capsys.readouterr().out
        assert re.fullmatch(said, printed)
    paths = (tmp_path / f"{frame}.mesh.ply" for frame in ("colmap", "nerfstudio"))
    in_room, in_run = (trimesh.load(path, process=False) for path in paths)
    assert isinstance(in_room, trimesh.Trimesh)
    assert isinstance(in_run, trimesh.Trimesh)
    assert len(in_room.vertices) == len(in_run.vertices)
    apart, _ = KDTree(in_run.vertices).query(MOVED.positions(in_room.vertices))  # Threads decide about their order.
    assert apart.max() < 1e-5
    distances, which = nearest(ROOM, in_room.vertices)
    assert np.median(distances) < 0.5 * voxel
    assert np.quantile(distances, 0.9) < voxel
    middles = in_room.triangles_center
    distances, which = nearest(ROOM, middles)
    for index, axis in ((0, 2), (1, 1), (2, 0)):  # The room's corner is at the origin.
        on = (which == index) & (distances < voxel)
        assert (in_room.face_normals[on, axis] > 0).mean() > 0.99
        colors = in_room.visual.vertex_colors[in_room.faces[on, 0], :3] / 255  # type: ignore[union-attr]
        errors = np.abs(ROOM[index].colour(in_room.vertices[in_room.faces[on, 0]]) - colors)
        assert np.median(errors) < 0.15
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"colmap.mesh.ply", "nerfstudio.mesh.ply"}


@pytest.mark.usefixtures("open3d")
def test_without_a_size_voxels_are_two_pixels_wide_or_as_many_as_fit(
    run: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    params, _ = export.read_checkpoint(run[1])
    cameras = read_cameras(run[1], run[0])
    views = list(meshing.render_depths(params, cameras, range(3), RenderOptions(max_off_axis=4.0)))
    depths = np.median([np.median(view.depth[view.depth > 0]) for view in views])
    size = meshing.derive_voxel_size(views)
    assert size == pytest.approx(2 * depths / (0.8 * WIDTH), rel=1e-4)
    monkeypatch.setattr(mesh, "MOST_VOXELS", 60 * 16**3)
    larger = meshing.derive_voxel_size(views)
    assert larger > size
    assert mesh.Fusion(larger).has_room_for(views)
    assert not mesh.Fusion(larger / 2**0.5).has_room_for(views)
    monkeypatch.setattr(mesh, "MOST_VOXELS", 16**3)
    with refusal(r"^A mesh of voxels of 0\.02 does not fit in memory: .*--voxel-size 0\.04\.$"):
        meshing.write_mesh(tmp_path / "b.mesh.ply", params, cameras, voxel_size=0.02)


@pytest.mark.usefixtures("open3d")
def test_what_is_cleaned_away_is_not_in_the_mesh(run: tuple[Path, Path], tmp_path: Path):
    whole = tmp_path / "whole.mesh.ply"
    cut = tmp_path / "cut.mesh.ply"
    status = command(run, whole)
    assert status == 0
    vertices = trimesh.load(whole, process=False).vertices  # type: ignore[union-attr]
    middle = float(np.median(vertices[:, 0]))
    status = command(run, cut, "--crop", f"{middle}", "-9", "-9", "9", "9", "9")
    assert status == 0
    left = trimesh.load(cut, process=False).vertices  # type: ignore[union-attr]
    assert len(left) > 100
    assert left[:, 0].min() > middle - 3 * SPACING * MOVED.scale


@torch.no_grad()
def test_depth_is_along_the_axis_and_pixels_that_are_mostly_empty_are_left_out():
    """A Gaussian of opacity .8 at a depth of 2: its middle is seen in its own colour, its rim is not seen."""
    params = {
        "means": torch.tensor([[0.0, 0.0, -2.0]]),
        "quats": torch.tensor([[1.0, 0, 0, 0]]),
        "scales": torch.full((1, 3), 0.3).log(),
        "opacities": torch.tensor([[math.log(4)]]),
        "features_dc": (torch.tensor([[0.9, 0.5, 0.1]]) - 0.5) / DEGREE_0,
        "features_rest": torch.zeros((1, 0, 3)),
    }
    pose = torch.eye(4)[None, :3]
    K = torch.tensor([[[40.0, 0, 16], [0, 40, 16], [0, 0, 1]]])
    cameras = meshing.RunCameras(pose, K, [(32, 32)])
    (view,) = meshing.render_depths(params, cameras, [0], RenderOptions(max_off_axis=0.0))
    assert view.depth[16, 16] == pytest.approx(2.0)
    assert view.depth[0, 0] == 0
    alpha = 0.8 * np.exp(-0.5 * ((np.arange(32) + 0.5 - 16) ** 2) / ((0.3 * 20) ** 2 + 0.3))
    assert ((view.depth[16] > 0) == (alpha * np.exp(-0.5 * 0.25 / 36.3) >= 0.5)).all()
    actual = view.color[16, 16]
    expected = [0.9, 0.5, 0.1]
    assert_allclose(actual, expected, atol=1e-5)


@pytest.mark.hard_case(
    "a mesh without a surface, with voxels of 0 or NaN", "refused: names the option; nothing is written"
)
@pytest.mark.usefixtures("open3d")
@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        ("--voxel-size 0", r"--voxel-size 0 must be more than 0: leave it out to have it derived\."),
        ("--voxel-size nan", r"--voxel-size nan must be more than 0: .*\."),
        ("--voxel-size 1e-7", r"No surface came out of \d+ training views with voxels of 1e-07: .*\."),
        ("--max-extent 1e-9", r"These options take away all .* Gaussians: nothing is written, so take fewer away\."),
        ("--crop 50 50 50 51 51 51", r"These options take away all .* fewer away\."),
    ],
)
def test_what_gives_no_mesh_is_one_sentence_and_leaves_nothing(
    run: tuple[Path, Path], options: str, sentence: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    status = command(run, tmp_path / "a.mesh.ply", *options.split())
    assert status == 2
    errors = capsys.readouterr().err
    assert re.fullmatch(f"sadgs-export: {sentence}\n", errors)
    assert not list(tmp_path.iterdir())


@pytest.mark.hard_case("a mesh without views, or of faint Gaussians alone", "refused: there is no surface")
@pytest.mark.usefixtures("open3d")
def test_no_views_and_gaussians_that_are_all_faint_have_no_surface(run: tuple[Path, Path], tmp_path: Path):
    params, _ = export.read_checkpoint(run[1])
    nowhere = meshing.RunCameras(torch.zeros(0, 3, 4), torch.zeros(0, 3, 3), [])
    with refusal(r"^The capture has no training views to fuse .* give another with --data\.$"):
        meshing.write_mesh(tmp_path / "a.mesh.ply", params, nowhere)
    params["opacities"] = torch.full_like(params["opacities"], -6.0)
    with refusal(r"^The training views see no surface that is half opaque: train longer, or "):
        meshing.write_mesh(tmp_path / "a.mesh.ply", params, read_cameras(run[1], run[0]))
    assert not list(tmp_path.iterdir())


@pytest.mark.hard_case("a mesh without open3d", "refused before anything is rendered: what to install")
def test_voxels_are_for_meshes_and_open3d_is_asked_for_first(
    run: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    status = command(run, tmp_path / "a.ply", "--voxel-size", "0.1")
    assert status == 2
    said = "sadgs-export: --voxel-size is for meshes: let --output end in .mesh.ply, or leave it out.\n"
    errors = capsys.readouterr().err
    assert errors == said
    monkeypatch.setitem(sys.modules, "open3d", None)  # Importing it fails.
    status = command(run, tmp_path / "a.mesh.ply")
    assert status == 2
    remedy = "install open3d and libusb-package with pip"
    said = rf"sadgs-export: A mesh is made by open3d, which cannot be imported \(.*\): {remedy}\.\n"
    errors = capsys.readouterr().err
    assert re.fullmatch(said, errors)
    assert not list(tmp_path.iterdir())


@pytest.mark.hard_case("a mesh on a system without OpenGL's libraries", "refused: which packages have them")
def test_a_missing_library_of_opengl_is_named_with_its_packages(monkeypatch: pytest.MonkeyPatch):
    class NoLibrary(importlib.abc.MetaPathFinder):
        """Fails as the import of open3d does without the library."""

        def find_spec(self, name: str, *_: Any) -> None:
            if name == "open3d":
                raise ImportError("libEGL.so.1: cannot open shared object file: No such file or directory")

    monkeypatch.delitem(sys.modules, "open3d", raising=False)
    monkeypatch.setattr(sys, "meta_path", [NoLibrary(), *sys.meta_path])
    with refusal(r"libEGL\.so\.1: .*: install the system's packages libegl1 and libgl1\.$"):
        mesh.load_open3d()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("bands", [0, 3])
def test_what_views_see_on_a_gpu_is_what_they_see_on_the_cpu(run: tuple[Path, Path], bands: int):
    params = gaussians_of_the_room(np.random.default_rng(0))
    params["features_rest"] = params["features_rest"][:, :bands].contiguous()
    cameras = read_cameras(run[1], run[0])
    moved = {name: value.cuda() for name, value in params.items()}
    both = (meshing.render_depths(p, cameras, range(2), RenderOptions(max_off_axis=4.0)) for p in (params, moved))
    for on_cpu, on_gpu in zip(*both, strict=True):
        seen = (on_cpu.depth > 0) & (on_gpu.depth > 0)
        assert (seen == (on_cpu.depth > 0)).mean() > 0.99
        assert np.median(np.abs(on_cpu.depth - on_gpu.depth)[seen]) < 1e-4
        assert np.median(np.abs(on_cpu.color - on_gpu.color)[seen]) < 1e-3
