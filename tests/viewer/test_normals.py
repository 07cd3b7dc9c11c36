"""The output `normals`: which way Gaussians face, and that only those who read it wait for it."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from nerfstudio.data.scene_box import OrientedBox
from nerfstudio.scripts.render import DatasetRender
from PIL import Image
from torch.testing import assert_close

from helpers.closeness import assert_within
from helpers.kill_and_resume import set_up
from helpers.short_runs import in_the_viewer
from helpers.small_scenes import HEIGHT, WIDTH, camera
from sadgs_ns.render.normals import normals_map
from sadgs_ns.render.types import Cameras
from sadgs_ns.training.config import SadgsTrainerConfig
from sadgs_ns.training.model import NORMALS, SadgsModel
from sadgs_ns.training.outputs import LazyOutputs
from sadgs_ns.training.pipeline import SadgsPipeline
from sadgs_ns.training.run.run_folder import write_config
from sadgs_ns.training.run.trainer import SadgsTrainer
from sadgs_ns.viewer.elements import shows_output


def discs(angles: list[float], spacing: float = 1.5) -> dict[str, torch.Tensor]:
    """Flat Gaussians 4 units before the camera, beside each other along x, turned about y by angles in rad."""
    half = torch.tensor(angles) / 2
    number = len(angles)
    x = (torch.arange(number) - (number - 1) / 2) * spacing
    return {
        "means": torch.stack([x, torch.zeros(number), torch.full((number,), 4.0)], dim=-1),
        "quats": 2 * torch.stack([half.cos(), torch.zeros(number), half.sin(), torch.zeros(number)], dim=-1),
        "scales": torch.tensor([[0.3, 0.3, 0.01]]).log().repeat(number, 1),
        "opacities": torch.full((number, 1), 6.0),
    }


def test_a_normal_is_the_thinnest_axis_turned_towards_the_camera():
    viewmats, Ks = camera(64, 48)
    for angle in (0.0, 0.4, -0.7, math.pi, math.pi + 0.4):
        seen = normals_map(discs([angle]), Cameras(viewmats, Ks, 64, 48))
        facing = math.atan(math.tan(angle))  # A disc that is turned by π faces the camera again.
        expected = torch.tensor([-math.sin(facing), 0.0, -math.cos(facing)])
        actual = seen[24, 32]
        assert_within(actual, expected, 1e-5)
        assert (seen[0, 0] == 0).all(), "nothing is there"


def test_normals_are_in_the_world_s_axes_and_of_unit_length():
    """The camera and what it sees are turned together: what it sees is the same, and its normals are turned."""
    viewmats, Ks = camera(64, 48)
    plain = discs([0.3, -0.5])
    turn = torch.tensor(1.1)
    rotation = torch.tensor([[turn.cos(), -turn.sin(), 0], [turn.sin(), turn.cos(), 0], [0, 0, 1]])
    about_z = torch.tensor([(turn / 2).cos(), 0, 0, (turn / 2).sin()])
    w, x, y, z = plain["quats"].unbind(-1)
    a = about_z[0]
    d = about_z[3]
    turned = plain | {
        "means": plain["means"] @ rotation.T,
        "quats": torch.stack([a * w - d * z, a * x - d * y, a * y + d * x, a * z + d * w], dim=-1),
    }
    viewmat = viewmats[0].clone()
    viewmat[:3, :3] = rotation.T
    before = normals_map(plain, Cameras(viewmats, Ks, 64, 48))
    after = normals_map(turned, Cameras(viewmat[None], Ks, 64, 48))
    assert_within(after, before @ rotation.T, 1e-4)
    lengths = before.norm(dim=-1)
    actual = lengths[lengths > 0]
    expected = torch.ones_like(lengths[lengths > 0])
    assert_close(actual, expected)
    assert 0 < (lengths == 0).sum() < lengths.numel()


def test_what_is_read_later_is_computed_once_and_only_then():
    calls: list[str] = []

    def normals() -> torch.Tensor:
        calls.append("normals")
        return torch.ones(2)

    outputs = LazyOutputs({"rgb": torch.zeros(2), "normals": normals}, unclamped=lambda: torch.zeros(2))
    assert "normals" in outputs
    assert list(outputs) == list(outputs.keys()) == ["rgb", "normals"]
    outputs["rgba"] = outputs["rgb"]
    assert len(outputs) == 3
    assert not calls
    assert torch.equal(outputs["normals"], torch.ones(2))
    assert outputs.get("normals") is outputs["normals"]
    for value in outputs.values():
        assert isinstance(value, torch.Tensor)
    assert calls == ["normals"]


@pytest.fixture
def trainer(config: SadgsTrainerConfig) -> SadgsTrainer:
    return set_up(config)


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> Callable[[], int]:
    """How often normals were rendered."""
    calls = [0]
    render = SadgsModel.get_normals

    def get_normals(*args: Any) -> torch.Tensor:
        calls[0] += 1
        return render(*args)

    monkeypatch.setattr(SadgsModel, "get_normals", get_normals)
    return lambda: calls[0]


def test_evaluation_renders_no_normals_and_who_reads_them_gets_pictures(
    trainer: SadgsTrainer, counted: Callable[[], int]
):
    pipeline: SadgsPipeline = trainer.pipeline
    model = pipeline.model
    pipeline.eval()
    pipeline.get_average_eval_image_metrics()
    view = pipeline.datamanager.train_dataset.cameras[:1]
    outputs = model.get_outputs_for_camera(view)
    assert counted() == 0
    assert list(outputs)[:3] == ["rgb", "depth", "accumulation"]
    assert NORMALS in outputs
    normals = outputs[NORMALS].cpu()
    assert counted() == 1
    assert normals.shape == (HEIGHT, WIDTH, 3)
    drawn = outputs["accumulation"][..., 0].cpu() > 0
    assert (normals[~drawn] == 0).all()
    assert drawn.any()
    actual = (2 * normals[drawn] - 1).norm(dim=-1)
    expected = torch.ones(int(drawn.sum()))
    assert_within(actual, expected, 1e-4)
    towards = view.camera_to_worlds[0, :, 2].to(normals)  # against the direction of view
    assert ((2 * normals[drawn] - 1) @ towards > 0).float().mean() > 0.9


def test_normals_are_of_the_gaussians_that_the_crop_box_shows(trainer: SadgsTrainer):
    model: SadgsModel = trainer.pipeline.model
    trainer.pipeline.eval()
    view = trainer.pipeline.datamanager.train_dataset.cameras[:1]
    box = OrientedBox(torch.eye(3), model.means.detach().cpu().median(dim=0).values, torch.full((3,), 0.4))
    cropped = model.get_outputs_for_camera(view, box)
    whole = model.get_outputs_for_camera(view)
    assert ((cropped[NORMALS] > 0).any(dim=-1) == (cropped["accumulation"][..., 0] > 0)).all()
    assert not torch.equal(cropped[NORMALS], whole[NORMALS])
    nothing = OrientedBox(torch.eye(3), torch.full((3,), 1e3), torch.ones(3))
    assert (model.get_outputs_for_camera(view, nothing)[NORMALS] == 0).all()


def test_the_viewer_renders_normals_only_where_it_shows_them(trainer: SadgsTrainer, counted: Callable[[], int]):
    pipeline: SadgsPipeline = trainer.pipeline
    pipeline.eval()
    view = pipeline.datamanager.train_dataset.cameras[:1]
    panel = SimpleNamespace(output_render="rgb", split=False, split_output_render=NORMALS)
    pipeline.structure.viewer.viewer = SimpleNamespace(control_panel=panel)  # type: ignore[assignment]

    def seen() -> dict[str, torch.Tensor]:
        return in_the_viewer(lambda: pipeline.model.get_outputs_for_camera(view))

    outputs = seen()
    assert isinstance(outputs, dict)
    assert torch.equal(outputs[NORMALS], outputs["rgb"])
    assert counted() == 0
    panel.output_render = NORMALS
    outputs = seen()
    assert not torch.equal(outputs[NORMALS], outputs["rgb"])
    assert counted() == 1
    panel.output_render = "depth"
    panel.split = True
    seen()
    assert counted() == 2
    assert not shows_output(SimpleNamespace(), NORMALS)  # type: ignore[arg-type]  # before there is a viewer


def test_ns_render_writes_depth_and_normals(trainer: SadgsTrainer, tmp_path: Path, counted: Callable[[], int]):
    trainer.save_checkpoint(0)
    config = write_config(trainer.config)
    output = tmp_path / "renders"
    command = DatasetRender(config, output_path=output, image_format="png")
    command.rendered_output_names = ["rgb", "depth"]
    command.main()
    assert counted() == 0
    command.rendered_output_names = ["normals", "raw-depth"]
    command.main()
    pictures = sorted((output / "test/normals").iterdir())
    assert counted() == len(pictures) == len(list((output / "test/raw-depth").iterdir())) > 0
    with Image.open(pictures[0]) as picture:
        assert picture.size == (WIDTH, HEIGHT)
        assert np.asarray(picture).max() > 128


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_normals_on_a_gpu_are_those_of_the_cpu():
    viewmats, Ks = camera(64, 48)
    params = discs([0.0, 0.4, -0.7], spacing=0.8)
    on_cpu = normals_map(params, Cameras(viewmats, Ks, 64, 48))
    moved = {name: value.cuda() for name, value in params.items()}
    on_gpu = normals_map(moved, Cameras(viewmats.cuda(), Ks.cuda(), 64, 48)).cpu()
    both = (on_cpu != 0).any(dim=-1) & (on_gpu != 0).any(dim=-1)
    assert (both == (on_cpu != 0).any(dim=-1)).float().mean() > 0.98  # A rim of 1/255 may round either way.
    assert_within(on_gpu[both], on_cpu[both], 1e-3)
