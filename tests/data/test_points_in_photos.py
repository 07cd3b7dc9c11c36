"""The warning for SfM points whose colours are not those of the photos where the poses put them."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from PIL import Image

from examples.drawn_scene.scene import SPARSE_FOLDER, write_scene
from helpers.json_files import read_json, write_json
from sadgs_ns.data.checks import check_data
from sadgs_ns.data.checks.colmap import check_colmap
from sadgs_ns.data.layouts import ParserOptions

K1 = -0.2  # Of a lens that bends more than those of phones


def as_transforms(data: Path) -> None:
    """Write a COLMAP reconstruction as another program would: a transforms.json, and a PLY of the points."""
    model = pycolmap.Reconstruction(data / SPARSE_FOLDER)
    model.export_PLY(data / "points.ply")
    frames = []
    for image in model.images.values():
        pose = np.eye(4)
        pose[:3] = image.cam_from_world().inverse().matrix() * [1, -1, -1, 1]  # OpenGL's axes
        camera = model.cameras[image.camera_id]
        intrinsics = {"fl_x": camera.focal_length_x, "fl_y": camera.focal_length_y, "w": camera.width}
        intrinsics |= {"cx": camera.principal_point_x, "cy": camera.principal_point_y, "h": camera.height}
        frames.append({"file_path": f"images/{image.name}", "transform_matrix": pose.tolist(), **intrinsics})
    write_json(data / "transforms.json", {"frames": frames, "ply_file_path": "points.ply"})


@pytest.fixture(params=["colmap", "transforms"])
def layout(request: pytest.FixtureRequest) -> str:
    return request.param


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The drawn scene, to be read only."""
    folder = tmp_path_factory.mktemp("room") / "scene"
    write_scene(folder, 96, 72, 12, 1500)
    return folder


@pytest.fixture
def capture(layout: str, room: Path, tmp_path: Path) -> Callable[..., Path]:
    """Writes a drawn scene in a layout, after a change of its points and one of its photos."""

    def write(
        change: Callable[[pycolmap.Point3D], None] = lambda point: None,
        repaint: Callable[[list[Path]], None] = lambda photos: None,
    ) -> Path:
        shutil.copytree(room, tmp_path, dirs_exist_ok=True)
        model = pycolmap.Reconstruction(tmp_path / SPARSE_FOLDER)
        for point in model.points3D.values():
            change(point)
        model.write(tmp_path / SPARSE_FOLDER)
        repaint(sorted((tmp_path / "images").iterdir()))
        if layout == "transforms":
            as_transforms(tmp_path)
        return tmp_path

    return write


def remarks(data: Path) -> list[str]:
    return [finding.sentence for finding in check_data(data) if finding.severity != "note"]


def swap(point: pycolmap.Point3D) -> None:
    point.xyz = point.xyz[[0, 2, 1]]


def paint_grey(point: pycolmap.Point3D) -> None:
    point.color = np.full(3, 127, np.uint8)


def shift(photos: list[Path]) -> None:
    contents = [photo.read_bytes() for photo in photos]
    for photo, content in zip(photos, contents[1:] + contents[:1], strict=True):
        photo.write_bytes(content)


def blank(photos: list[Path]) -> None:
    for number, photo in enumerate(photos):
        noise = np.random.default_rng(number).integers(126, 129, (72, 96, 3))
        Image.fromarray(noise.astype(np.uint8)).save(photo)


def damage(photos: list[Path]) -> None:
    for photo in photos:
        photo.write_bytes(photo.read_bytes()[:200])


@pytest.mark.hard_case(
    "points in other axes or units than the poses; photos exchanged between poses", "trains, with a warning"
)
@pytest.mark.parametrize("wrong", [{"change": swap}, {"repaint": shift}], ids=["axes", "photos"])
def test_points_that_do_not_fit_the_photos_are_warned_of(
    wrong: dict[str, Callable], capture: Callable[..., Path], layout: str
):
    data = capture(**wrong)
    (told,) = remarks(data)
    path = data / (SPARSE_FOLDER / "points3D.bin" if layout == "colmap" else "points.ply")
    leave_out = "--load-3D-points False`" if layout == "colmap" else f"remove ply_file_path from {data}/transforms.json"
    start = f"{path} has points whose colours are not those of the photos where the poses put them, as where "
    assert told.startswith(start)
    assert told.endswith(f"{leave_out} to start from random points.")


@pytest.mark.parametrize(
    "unclear",
    [{}, {"change": paint_grey}, {"repaint": blank}, {"change": swap, "repaint": blank}],
    ids=["they fit", "one colour", "one tone", "wrong axes, and one tone"],
)
def test_nothing_is_told_where_points_fit_or_colours_cannot_tell(
    unclear: dict[str, Callable], capture: Callable[..., Path]
):
    assert remarks(capture(**unclear)) == []


def test_damaged_photos_are_told_of_alone(capture: Callable[..., Path]):
    (told,) = remarks(capture(change=swap, repaint=damage))
    assert ".png (and 11 more) cannot be read as an image" in told


@pytest.mark.parametrize("layout", ["colmap"], indirect=True)
def test_photos_stay_closed_where_they_need_not_exist(capture: Callable[..., Path]):
    options = ParserOptions(colmap_path=SPARSE_FOLDER)
    findings = check_colmap(capture(change=swap), options, open_images=False)
    actual = [finding for finding in findings if finding.severity != "note"]
    assert actual == []


@pytest.mark.parametrize("layout", ["transforms"], indirect=True)
@pytest.mark.parametrize("is_told", [True, False])
def test_points_are_projected_as_a_lens_distorts(is_told: bool, capture: Callable[..., Path]):
    data = capture()
    path = data / "transforms.json"
    meta = read_json(path)
    for frame in meta["frames"]:
        K = np.array([[frame["fl_x"], 0, frame["cx"]], [0, frame["fl_y"], frame["cy"]], [0, 0, 1]])
        pixels = np.stack(np.meshgrid(np.arange(96), np.arange(72)), -1).reshape(-1, 1, 2) + 0.5
        straight = cv2.undistortPoints(pixels, K, np.array([K1, 0, 0, 0]), P=K).reshape(72, 96, 2) - 0.5
        x, y = straight.transpose(2, 0, 1).astype(np.float32).copy()
        photo = cv2.imread(str(data / frame["file_path"]))
        cv2.imwrite(str(data / frame["file_path"]), cv2.remap(photo, x, y, cv2.INTER_LINEAR))
    write_json(path, meta | {"k1": -K1 if is_told else K1})
    assert len(remarks(data)) == is_told
