"""The moving picture of a splat: where its camera goes, what a picture shows, and the file."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from numpy.testing import assert_allclose
from PIL import Image

from examples import gallery_page, turn
from examples.drawn_scene.scene import arc_views
from sadgs_ns.errors import InputError
from sadgs_ns.formats import ply
from sadgs_ns.formats.gaussians import DEFAULTS, Gaussians

POSE = np.array([[1.0, 0, 0, 0.5], [0, 0, -1, -2], [0, 1, 0, 0.3]])
"""A camera that looks along y, with z upwards."""
TARGET = np.array([0.5, 1.0, 0.3])


def test_the_camera_looks_at_the_point_from_the_same_distance_all_along_and_ends_where_it_began():
    poses = turn.ellipse(POSE, TARGET, math.radians(25), math.radians(8), frames=16)
    towards = TARGET - poses[:, :, 3]
    actual = np.linalg.norm(towards, axis=1)
    assert_allclose(actual, 3.0, atol=1e-12)
    actual = -poses[:, :, 2]
    assert_allclose(actual, towards / 3, atol=1e-12)
    steps = np.linalg.norm(poses[:, :, 3] - np.roll(poses[:, :, 3], 1, axis=0), axis=1)
    assert steps.max() < 0.6 and steps.min() > 0


def test_the_camera_goes_to_both_sides_up_and_down():
    right, left = (turn.turned(POSE, TARGET, angle, 0.0)[:, 3] for angle in (0.4, -0.4))
    assert right[0] > POSE[0, 3] > left[0] and right[2] == pytest.approx(POSE[2, 3])
    high, low = (turn.turned(POSE, TARGET, 0.0, angle)[:, 3] for angle in (-0.4, 0.4))
    assert high[2] > POSE[2, 3] > low[2] and high[0] == pytest.approx(POSE[0, 3])


class Model:
    """It draws one colour, which tells the size and the opacity of its Gaussian."""

    device = torch.device("cpu")

    def __init__(self) -> None:
        means = torch.from_numpy(TARGET)[None].float()
        scales = torch.nn.Parameter(torch.zeros(1, 3))
        opacities = torch.nn.Parameter(torch.zeros(1, 1))
        self.gauss_params = {"means": means, "scales": scales, "opacities": opacities}

    def get_outputs_for_camera(self, camera: Cameras) -> dict[str, torch.Tensor]:
        size = float(self.gauss_params["scales"].detach().exp().mean())
        opacity = float(self.gauss_params["opacities"].detach().sigmoid())
        return {"rgb": torch.full((int(camera.height), int(camera.width), 3), 0.8 * size * opacity)}


def test_a_picture_shows_the_splat_and_beside_it_the_shrunk_gaussians(tmp_path: Path):
    cameras = Cameras(torch.tensor(POSE)[None].float(), 80.0, 80.0, 40.0, 30.0, 80, 60)
    dataset = SimpleNamespace(cameras=cameras)
    pipeline = SimpleNamespace(model=Model(), datamanager=SimpleNamespace(train_dataset=dataset))
    options = turn.Turn(Path("run"), tmp_path / "turn.webp", frames=3, width=40, shrink=2.0)
    pictures = turn.draw(pipeline, options)  # type: ignore[arg-type]
    shapes = [picture.shape for picture in pictures]
    assert shapes == [(30, 80, 3)] * 3
    assert pictures[0][0, 0].tolist() == [102] * 3 and pictures[0][0, 79].tolist() == [101] * 3
    for name in ("scales", "opacities"):
        assert pipeline.model.gauss_params[name].abs().max() < 1e-6


@pytest.mark.parametrize("name", ["turn.webp", "turn.gif"])
def test_the_file_moves_and_begins_again(name: str, tmp_path: Path):
    pictures = [np.full((16, 24, 3), 80 * number, np.uint8) for number in range(3)]
    turn.write(tmp_path / name, pictures, seconds=0.6, quality=60)
    with Image.open(tmp_path / name) as image:
        assert (image.n_frames, image.size, image.info["loop"]) == (3, (24, 16), 0)  # type: ignore[attr-defined]
        image.seek(1)
        image.load()
        assert image.info["duration"] == 200
    names = [path.name for path in tmp_path.iterdir()]
    assert names == [name]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--output", "turn.mp4"], "--output turn.mp4 must end in .webp or .gif."),
        (["--output", "turn.gif", "--frames", "1"], "--frames must be 2 or more"),
        (["--output", "turn.gif"], "config.yml"),
    ],
)
def test_wrong_input_is_refused_in_a_sentence(
    words: list[str], sentence: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.chdir(tmp_path)
    status = turn.main(["run", *words])
    assert status == 2
    errors = capsys.readouterr().err
    assert sentence in errors
    assert not list(tmp_path.iterdir())


def test_the_page_of_the_drawn_room_begins_at_the_drawn_scene_s_first_camera():
    view = arc_views(9, 320, 240)[0]
    start = gallery_page.ROOM.start
    assert_allclose(start.position, view.position, atol=1e-3)
    forward = np.subtract(start.target, view.position)
    actual = forward / np.linalg.norm(forward)
    expected = view.rotation[2]
    assert_allclose(actual, expected, atol=1e-3)
    assert math.tan(math.radians(start.degrees) / 2) == pytest.approx(view.width / 2 / view.focal, abs=1e-3)


def test_the_page_of_the_building_site_begins_with_a_look_at_the_ground_from_the_side():
    start = gallery_page.SITE.start
    forward = np.subtract(start.target, start.position)
    downward = -forward @ gallery_page.SITE.up / np.linalg.norm(forward)
    assert math.degrees(math.asin(downward)) == pytest.approx(45, abs=0.1)


PAGES = pytest.mark.parametrize("entry", gallery_page.ENTRIES, ids=lambda entry: entry.page)


def write_points(path: Path, means: np.ndarray) -> None:
    """Write a splat of grey Gaussians at positions [N, 3]."""
    count = len(means)
    gaussians = Gaussians(
        means=means.astype(np.float32),
        scales=np.zeros((count, 3), np.float32),
        quats=np.tile(np.eye(1, 4, dtype=np.float32), (count, 1)),
        opacities=np.zeros(count, np.float32),
        features_dc=np.zeros((count, 3), np.float32),
        features_rest=np.zeros((count, 0, 3), np.float32),
    )
    with path.open("wb") as file:
        ply.write(file, gaussians, DEFAULTS)


@PAGES
def test_a_page_is_upright_and_its_camera_sees_in_the_splat_what_it_shall_see(
    entry: gallery_page.Entry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    written = []
    monkeypatch.setattr(gallery_page.html, "write", lambda file, *content: written.append(content))
    position = np.array(entry.start.position)
    target = np.array(entry.start.target)
    right = np.cross(target - position, entry.up)
    right /= np.linalg.norm(right)
    points = np.array([position, target, target + entry.up, target + right])
    write_points(tmp_path / entry.splat, points)
    gallery_page.page_of(entry, tmp_path / entry.splat)
    gaussians, context = written[0]
    assert (context.title, context.start.degrees) == (entry.title, entry.start.degrees)
    position, target, above, beside = gaussians.means
    assert_allclose(context.start.position, position, atol=1e-5)
    assert_allclose(context.start.target, target, atol=1e-5)
    assert_allclose(above - target, [0, 0, 1], atol=1e-3)
    assert_allclose(beside - target, [1, 0, 0], atol=1e-3)
    assert target[1] - position[1] > 0.5, "A camera that looks straight down has no heading."


@PAGES
def test_the_gallery_has_the_link_where_the_page_was_made_and_nothing_where_it_was_not(entry: gallery_page.Entry):
    page = SimpleNamespace(file=SimpleNamespace(src_uri=gallery_page.GALLERY))
    text = (Path(__file__).parents[2] / "docs" / gallery_page.GALLERY).read_text("utf8")
    assert text.count(entry.marker) == 1
    for made in ([], [entry.page]):
        files = SimpleNamespace(get_file_from_path=lambda name, made=made: name if name in made else None)
        actual = gallery_page.on_page_markdown(text, page, None, files)
        assert actual.count("[Turn it with the mouse](") == len(made)
        assert actual.count(entry.link) == len(made)


def test_pages_and_their_places_have_names_of_their_own():
    for attribute in ("splat", "page", "marker", "title"):
        names = {getattr(entry, attribute) for entry in gallery_page.ENTRIES}
        assert len(names) == len(gallery_page.ENTRIES)


def test_without_what_makes_pages_the_site_is_built_without_the_pages(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    def refuse(entry: gallery_page.Entry, splat: Path) -> bytes:
        raise InputError(f"{splat.name}: there is no Node.js.")

    monkeypatch.setattr(gallery_page, "page_of", refuse)
    with caplog.at_level("INFO"):
        actual = gallery_page.on_files([], SimpleNamespace(docs_dir="docs"))
        assert actual == []
    for entry in gallery_page.ENTRIES:
        assert f'no page "{entry.title}". {entry.splat}: there is no Node.js.' in caplog.text


class GeneratedFile:
    """It stands for mkdocs's file, since mkdocs may not be installed."""

    def __init__(self, name: str) -> None:
        self.name = name

    @staticmethod
    def generated(config: SimpleNamespace, name: str, content: bytes) -> GeneratedFile:
        """Return a file of the site."""
        assert content == b"page"
        return GeneratedFile(name)


@PAGES
def test_only_the_page_whose_splat_is_missing_is_left_out(
    entry: gallery_page.Entry, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    monkeypatch.setattr(gallery_page.html, "write", lambda file, *content: file.write(b"page"))
    for name in ("mkdocs", "mkdocs.structure"):
        monkeypatch.setitem(sys.modules, name, ModuleType(name))
    monkeypatch.setitem(sys.modules, "mkdocs.structure.files", SimpleNamespace(File=GeneratedFile))
    (tmp_path / "figures").mkdir()
    others = [other for other in gallery_page.ENTRIES if other != entry]
    for other in others:
        write_points(tmp_path / "figures" / other.splat, np.zeros((1, 3)))
    with caplog.at_level("INFO"):
        files = gallery_page.on_files([], SimpleNamespace(docs_dir=tmp_path))
    actual = [file.name for file in files]
    expected = [other.page for other in others]
    assert actual == expected
    (message,) = caplog.messages
    assert message.startswith(f'The gallery has no page "{entry.title}". ')
    assert f"{entry.splat} cannot be read" in message
