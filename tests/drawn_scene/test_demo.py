"""The demo's drawn scene against geometry, nerfstudio's reader, and the PLY it leaves."""

from __future__ import annotations

import dataclasses
import filecmp
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image
from plyfile import PlyData

from examples.drawn_scene import scene as demo_scene
from examples.drawn_scene.drawing import Rectangle, Sphere, View, expected_wavelength_map, render, trace
from examples.drawn_scene.scene import (
    EVAL_INTERVAL,
    SPARSE_FOLDER,
    SceneDescription,
    arc_views,
    describe_scene,
    room_surfaces,
    write_scene,
)
from helpers.generators import seeded
from sadgs_ns.cli.export import write_gaussians
from sadgs_ns.files import atomic_path

WIDTH = 48
HEIGHT = 36
VIEWS = 9


@contextmanager
def quiet_import() -> Iterator[None]:
    """Import nerfstudio without the warnings of its own modules and of what they import."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, SceneDescription]:
    folder = tmp_path_factory.mktemp("demo") / "scene"
    return folder, write_scene(folder, WIDTH, HEIGHT, VIEWS, points=200)


def wall(distance: float = 2.0, wavelength: float = 0.2, angle: float = 0.0, **changes) -> Rectangle:
    """A large wall at z = distance, seen by `camera`."""
    corner = np.array([-20.0, -20.0, distance])
    u = np.array([40.0, 0, 0])
    v = np.array([0, 40.0, 0])
    plain = Rectangle("wall", corner, u, v, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), "grating", wavelength, angle)
    return dataclasses.replace(plain, **changes)


def camera(focal: float = 100.0) -> View:
    return View("view.png", np.eye(3), np.zeros(3), focal, WIDTH, HEIGHT)


def test_scene_is_deterministic(written: tuple[Path, SceneDescription], tmp_path: Path) -> None:
    folder, _ = written
    again = tmp_path / "again"
    write_scene(again, WIDTH, HEIGHT, VIEWS, points=200)
    files = sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())
    expected = sorted(str(path.relative_to(again)) for path in again.rglob("*") if path.is_file())
    assert files == expected
    actual = filecmp.cmpfiles(folder, again, files, shallow=False)
    assert actual == (files, [], [])


def test_seed_moves_only_the_points() -> None:
    first = describe_scene(WIDTH, HEIGHT, VIEWS, 50, 0)
    second = describe_scene(WIDTH, HEIGHT, VIEWS, 50, 1)
    assert not np.array_equal(first.points, second.points)
    assert first.wavelengths == second.wavelengths
    actual = first.views[3].rotation
    expected = second.views[3].rotation
    assert_array_equal(actual, expected)


def test_poses_are_rotations() -> None:
    for view in arc_views(VIEWS, WIDTH, HEIGHT):
        actual = view.rotation @ view.rotation.T
        expected = np.eye(3)
        assert_allclose(actual, expected, atol=1e-12)
        assert np.linalg.det(view.rotation) == pytest.approx(1)
        assert view.rotation[1, 2] < 0  # the image's down is the world's down


def test_rays_and_projection_agree() -> None:
    view = arc_views(3, WIDTH, HEIGHT)[2]
    pixels, depth = view.project(view.position + 1.7 * view.rays())
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    expected = np.stack([columns.ravel(), rows.ravel()], -1)
    assert_allclose(pixels, expected, atol=1e-9)
    assert_allclose(depth, 1.7)


def test_points_project_onto_their_colours() -> None:
    # The median, because noise of a pixel turns into another colour on a fine grating or at an edge.
    scene = describe_scene(160, 120, VIEWS, points=400)
    errors = []
    for index, view in enumerate(scene.views[:3]):
        seen = scene.tracks[:, index]
        image = render(scene.surfaces, view).astype(float)
        pixels, depth = view.project(scene.points[seen])
        assert (depth > 0).all()
        column, row = np.clip(pixels.T, 0, [[view.width - 1], [view.height - 1]]).astype(int)
        errors.append(np.abs(image[row, column] - scene.colours[seen]).mean(1))
    assert np.median(np.concatenate(errors)) < 12  # of 255; colours drawn at random differ by about 70


def test_every_point_is_seen_twice(written: tuple[Path, SceneDescription]) -> None:
    _, scene = written
    assert len(scene.points) == 200
    assert (scene.tracks.sum(1) >= 2).all()


def test_every_texture_is_in_sight() -> None:
    shown = np.zeros(len(room_surfaces()), dtype=int)
    for view in arc_views(VIEWS, WIDTH, HEIGHT):
        index, _ = trace(room_surfaces(), view.position, view.rays())
        shown += np.bincount(index[index >= 0], minlength=len(shown))
    hidden = {surface.name for surface, count in zip(room_surfaces(), shown, strict=True) if count == 0}
    assert not hidden & {"floor", "fine wall", "coarse wall", "tall box top", "faint box top", "sphere"}


def test_nerfstudio_reads_the_scene(written: tuple[Path, SceneDescription]) -> None:
    with quiet_import():
        from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig

    folder, scene = written
    parser = ColmapDataParserConfig(
        data=folder, colmap_path=SPARSE_FOLDER, downscale_factor=1, eval_mode="interval", eval_interval=EVAL_INTERVAL
    ).setup()
    train = parser.get_dataparser_outputs("train")
    held_out = parser.get_dataparser_outputs("val")
    names = [path.name for path in held_out.image_filenames]
    assert names == ["000.png", "008.png"]
    assert len(train.image_filenames) == VIEWS - 2
    with Image.open(train.image_filenames[0]) as image:
        assert image.size == (WIDTH, HEIGHT)
    assert train.metadata["points3D_xyz"].shape == (200, 3)
    assert (train.metadata["points3D_num_points2D"] >= 2).all()
    # What nerfstudio made of poses and points still projects to the same pixels.
    pose = train.cameras.camera_to_worlds[0]
    view = scene.views[1]
    points = train.metadata["points3D_xyz"]
    local = (points - pose[:, 3]) @ pose[:, :3] * torch.tensor([1.0, -1.0, -1.0])  # OpenGL → OpenCV
    pixels = view.focal * local[:, :2] / local[:, 2:] + torch.tensor([WIDTH / 2, HEIGHT / 2])
    expected = view.project(scene.points)[0]
    assert_allclose(pixels.numpy(), expected, atol=1e-2)


@pytest.mark.parametrize("angle", [0.0, 0.7])
def test_wavelength_of_a_fronto_parallel_wall(angle: float) -> None:
    expected = 0.2 * 100.0 / 2.0  # wavelength · focal / depth, whatever the direction
    actual = expected_wavelength_map([wall(angle=angle)], camera())
    assert_allclose(actual, expected, rtol=1e-5)


def test_checker_wavelength_is_its_fundamental() -> None:
    checker = wall(texture="checker", wavelength=0.4)
    actual = expected_wavelength_map([checker], camera())
    assert_allclose(actual, 0.4 * 100.0 / 2.0, rtol=1e-5)
    row = render([checker], camera(), 1)[0, :, 0]
    changes = np.flatnonzero(np.diff(row.astype(int)))
    expected = 20.0 / np.sqrt(2.0)
    assert_allclose(np.diff(changes).mean(), expected, atol=1.0)  # a square's side


def test_wavelength_is_foreshortened_along_the_grating_only() -> None:
    tilt = np.radians(60)
    along = np.array([np.cos(tilt), 0.0, np.sin(tilt)])
    tilted = wall(corner=np.array([0, -20.0, 2.0]) - 2 * along, edge_u=4 * along, edge_v=np.array([0, 40.0, 0]))
    view = View("view.png", np.eye(3), np.zeros(3), 100.0, 1, 1)  # its one pixel looks along z, at depth 2
    actual = expected_wavelength_map([tilted], view)[0, 0]
    expected = pytest.approx(10 * np.cos(tilt), rel=1e-5)
    assert actual == expected
    across = dataclasses.replace(tilted, angle=0.5 * np.pi)
    actual = expected_wavelength_map([across], view)[0, 0]
    expected = pytest.approx(10, rel=1e-5)
    assert actual == expected


def test_wavelength_matches_the_drawn_image() -> None:
    row = render([wall()], camera(), 8)[HEIGHT // 2, :40, 0] / 255.0
    spectrum = np.abs(np.fft.rfft(row - row.mean()))
    assert 40 / spectrum.argmax() == pytest.approx(10)  # four periods in 40 px


def test_no_wavelength_where_there_is_no_texture() -> None:
    ball = Sphere("ball", np.array([0.0, 0.0, 3.0]), 0.4, (1.0, 0.5, 0.2))
    values = expected_wavelength_map([ball, wall(texture="plain", wavelength=float("nan"), distance=5)], camera())
    assert np.isnan(values).all()


@pytest.mark.parametrize(
    ("changes", "named"), [({"width": 8}, "width"), ({"views": 8}, "views"), ({"points": 0}, "points")]
)
def test_too_small_a_scene_is_refused(changes: dict[str, int], named: str) -> None:
    with pytest.raises(ValueError, match=f"the demo scene's {named} is .*; give at least"):
        describe_scene(**changes)


def test_foreign_folders_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "thesis.tex").write_text("all of it")
    with pytest.raises(FileExistsError, match="holds files that are not a demo scene"):
        write_scene(tmp_path, WIDTH, HEIGHT, VIEWS)
    with pytest.raises(FileExistsError, match="is a file"):
        write_scene(tmp_path / "thesis.tex", WIDTH, HEIGHT, VIEWS)
    names = [path.name for path in tmp_path.iterdir()]
    assert names == ["thesis.tex"]
    status = demo_scene.main([str(tmp_path)])
    assert status == 2
    errors = capsys.readouterr().err
    assert errors.startswith("error: ")


def test_an_earlier_scene_is_replaced_and_a_failed_one_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "scene"
    write_scene(folder, 16, 16, 10, points=10)
    write_scene(folder, 16, 16, 9, points=10)
    assert len(list((folder / "images").iterdir())) == 9

    def fail(*_: object) -> None:
        raise OSError("no space left")

    monkeypatch.setattr(demo_scene, "_write_colmap", fail)
    with pytest.raises(OSError, match="no space left"):
        write_scene(folder, 16, 16, 12, points=10)
    names = [path.name for path in tmp_path.iterdir()]
    assert names == ["scene"]
    assert len(list((folder / "images").iterdir())) == 9


def gaussians(count: int, bands: int) -> dict[str, Any]:
    generator = seeded(0)
    shapes: dict[str, tuple[int, ...]] = {
        "means": (3,),
        "scales": (3,),
        "quats": (4,),
        "opacities": (1,),
        "features_dc": (3,),
    }
    shapes["features_rest"] = (bands, 3)
    return {name: torch.randn((count, *shape), generator=generator) for name, shape in shapes.items()}


@pytest.mark.parametrize("bands", [0, 15])
def test_ply_round_trip(tmp_path: Path, bands: int) -> None:
    params = gaussians(7, bands)
    path = tmp_path / "new folder/splat.ply"
    assert write_gaussians(path, params) == 7
    vertex = PlyData.read(str(path))["vertex"]
    columns = [p.name for p in vertex.properties]
    expected = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    assert columns[:9] == expected
    expected = ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert columns[-8:] == expected
    assert len(columns) == 17 + 3 * bands

    def read(*names: str) -> np.ndarray:
        return np.stack([vertex[name] for name in names], -1)

    assert_array_equal(read("x", "y", "z"), params["means"])
    assert_array_equal(read("opacity"), params["opacities"])
    assert_array_equal(read("scale_0", "scale_1", "scale_2"), params["scales"])
    rotations = torch.nn.functional.normalize(params["quats"], dim=-1)
    actual = read("rot_0", "rot_1", "rot_2", "rot_3")
    assert_allclose(actual, rotations, rtol=1e-6)
    for band in range(bands):
        names = [f"f_rest_{colour * bands + band}" for colour in range(3)]
        expected = params["features_rest"][:, band]
        assert_array_equal(read(*names), expected)


def test_ply_drops_what_is_not_finite(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    params = gaussians(5, 3)
    params["means"][1, 0] = torch.nan
    params["features_rest"][3, 2, 1] = torch.inf
    assert write_gaussians(tmp_path / "splat.ply", params) == 3
    printed = capsys.readouterr().out
    assert "dropped 2 of 5 Gaussians" in printed
    actual = PlyData.read(str(tmp_path / "splat.ply"))["vertex"]["x"]
    expected = params["means"][[0, 2, 4], 0]
    assert_array_equal(actual, expected)


def test_ply_names_the_tensor_of_another_shape(tmp_path: Path) -> None:
    params = gaussians(5, 3)
    params["quats"] = params["quats"][:, :3]
    with pytest.raises(ValueError, match=r"quats must have the shape \[5, 4\], got \[5, 3\]"):
        write_gaussians(tmp_path / "splat.ply", params)
    assert list(tmp_path.iterdir()) == []


def test_atomic_path_keeps_the_old_file_on_failure(tmp_path: Path) -> None:
    path = tmp_path / "result.txt"
    path.write_text("old")
    with pytest.raises(RuntimeError), atomic_path(path) as partial:
        partial.write_text("half")
        raise RuntimeError
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_demo_refuses_too_few_iterations(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with quiet_import():
        from examples.drawn_scene.__main__ import main

    status = main(["--output", str(tmp_path / "out"), "--max-num-iterations", "3"])
    assert status == 2
    errors = capsys.readouterr().err
    assert errors == "error: --max-num-iterations is 3; give at least 30, or nothing is split\n"
    assert not (tmp_path / "out").exists()
