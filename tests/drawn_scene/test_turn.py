"""The moving picture of a splat: where its camera goes, what a picture shows, and the file."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from numpy.testing import assert_allclose
from PIL import Image

from examples import gallery_page, turn
from examples.drawn_scene.scene import arc_views
from sadgs_ns.errors import InputError

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


def test_the_gallery_s_page_begins_at_the_drawn_scene_s_first_camera():
    view = arc_views(9, 320, 240)[0]
    assert_allclose(gallery_page.START.position, view.position, atol=1e-3)
    forward = np.subtract(gallery_page.START.target, view.position)
    actual = forward / np.linalg.norm(forward)
    expected = view.rotation[2]
    assert_allclose(actual, expected, atol=1e-3)
    assert math.tan(math.radians(gallery_page.START.degrees) / 2) == pytest.approx(
        view.width / 2 / view.focal, abs=1e-3
    )


def test_the_gallery_has_the_link_where_the_page_was_made_and_nothing_where_it_was_not():
    page = SimpleNamespace(file=SimpleNamespace(src_uri=gallery_page.GALLERY))
    text = (Path(__file__).parents[2] / "docs" / gallery_page.GALLERY).read_text("utf8")
    assert text.count(gallery_page.MARKER) == 1
    for made, links in (("a page", 1), (None, 0)):
        files = SimpleNamespace(get_file_from_path=lambda name, made=made: made)
        actual = gallery_page.on_page_markdown(text, page, None, files).count(gallery_page.LINK)
        assert actual == links


def test_without_what_makes_pages_the_site_is_built_without_the_page(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
):
    def refuse(splat: Path) -> bytes:
        raise InputError(f"{splat.name}: there is no Node.js.")

    monkeypatch.setattr(gallery_page, "page_of", refuse)
    with caplog.at_level("INFO"):
        actual = gallery_page.on_files([], SimpleNamespace(docs_dir="docs"))
        assert actual == []
    assert "no page of the drawn room. room.ply: there is no Node.js." in caplog.text
