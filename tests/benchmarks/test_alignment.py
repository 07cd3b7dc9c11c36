"""Held-out cameras are aligned on frozen Gaussians before they are measured, for every method the same way."""

from __future__ import annotations

import copy
import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from nerfstudio.cameras.cameras import Cameras
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.models import splatfacto
from nerfstudio.models.splatfacto import SplatfactoModel, SplatfactoModelConfig

from benchmarks import alignment, protocol, table
from benchmarks.__main__ import Benchmark
from benchmarks.evaluate import quality
from helpers.kill_and_resume import set_up
from helpers.short_runs import configure
from sadgs_ns.geometry.poses import corrected
from sadgs_ns.render.rasterization import rasterize, viewmats_from_camera_to_world
from sadgs_ns.render.types import Cameras as Pinholes
from sadgs_ns.render.types import Gaussians, RenderOptions
from sadgs_ns.training.model import SadgsModel
from sadgs_ns.training.run.trainer import SadgsTrainer


@pytest.fixture(scope="module")
def started(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> SadgsTrainer:
    """A run on the drawn scene before its first step: what training makes of it would depend on the processor."""
    from helpers.kill_and_resume import parser_of

    config = configure(tmp_path_factory.mktemp("aligned"), parser_of(scene), 60)
    config.machine.device_type = "cpu"
    trainer = set_up(config)
    trainer.pipeline.eval()
    return trainer


def disturbed(camera: Cameras, pixels: float, model: Any) -> Cameras:
    """The camera, moved so that its image moves by some pixels."""
    viewmats = viewmats_from_camera_to_world(camera.camera_to_worlds)
    units = alignment._units(model, camera)
    direction = torch.tensor([[0.5, -0.6, 0.2, 0.4, 0.3, -0.3]])
    moved = copy.copy(camera)
    moved.camera_to_worlds = alignment._camera_to_world(corrected(viewmats, pixels * units * direction))
    return moved


def photo_of(model: Any, camera: Cameras) -> dict[str, Any]:
    """The model's own picture, which is best seen from the camera."""
    with torch.no_grad():
        return {"image": model.get_outputs(camera)["rgb"]}


def distance(one: Cameras, other: Cameras) -> float:
    return float((one.camera_to_worlds - other.camera_to_worlds).norm())


def test_a_disturbed_camera_comes_back_and_no_parameter_changes(started: SadgsTrainer):
    model = started.pipeline.model
    camera, _ = started.pipeline.datamanager.fixed_indices_eval_dataloader[0]
    before = {name: value.clone() for name, value in model.state_dict().items() if isinstance(value, torch.Tensor)}
    away = disturbed(camera, 1.0, model)
    batch = photo_of(model, camera)
    aligned = alignment.align(model, (away, batch))
    assert distance(aligned, camera) < 0.2 * distance(away, camera)
    (plain,) = quality(model, [(away, batch)])["view_psnr"]
    found = alignment.aligned_quality(model, [(away, batch)])
    assert found["aligned_view_psnr"][0] > plain + 3
    assert {"aligned_psnr", "aligned_ssim", "aligned_lpips"} <= found.keys()
    for name, value in before.items():
        assert torch.equal(model.state_dict()[name], value), name
    for parameter in model.gauss_params.values():
        assert parameter.requires_grad
        assert parameter.grad is None


def test_a_camera_that_is_right_stays_or_fits_better(started: SadgsTrainer):
    model = started.pipeline.model
    views = started.pipeline.datamanager.fixed_indices_eval_dataloader
    for view in (views[0], views[1]):
        plain = alignment._loss(model, view[0], view[0].camera_to_worlds, view[1]["image"])
        aligned = alignment.align(model, view)
        fitted = alignment._loss(model, aligned, aligned.camera_to_worlds, view[1]["image"])
        assert float(fitted) <= float(plain) + 1e-7


def splatfacto_of(model: SadgsModel, monkeypatch: pytest.MonkeyPatch) -> SplatfactoModel:
    """splatfacto with the same Gaussians, drawn by our torch backend where gsplat needs CUDA."""
    monkeypatch.setattr(torch.Tensor, "cuda", lambda tensor: tensor)
    compiled: Any = splatfacto.get_viewmat
    monkeypatch.setattr(splatfacto, "get_viewmat", compiled._torchdynamo_orig_callable)  # It takes a minute to compile.

    def rasterization(
        means: Any, quats: Any, scales: Any, opacities: Any, colors: Any, viewmats: Any, Ks: Any, width: int,
        height: int, sh_degree: int, **_: Any,
    ) -> Any:  # fmt: skip
        gaussians = Gaussians(means, quats, scales, opacities, colors)
        options = RenderOptions(sh_degree=sh_degree, expected_depth=True, backend="torch")
        return rasterize(gaussians, Pinholes(viewmats, Ks, width, height), options)

    monkeypatch.setattr(splatfacto, "rasterization", rasterization)
    other: Any = object.__new__(SplatfactoModel)
    torch.nn.Module.__init__(other)
    other.config = SplatfactoModelConfig(num_downscales=0, background_color="black")
    other.gauss_params = model.gauss_params
    other.crop_box = None
    other.step = 3000
    other.background_color = torch.zeros(3)
    other.device_indicator_param = model.device_indicator_param
    other.strategy = SimpleNamespace(absgrad=False)
    return other.eval()


def test_splatfacto_s_cameras_are_aligned_the_same_way(started: SadgsTrainer, monkeypatch: pytest.MonkeyPatch):
    model = splatfacto_of(started.pipeline.model, monkeypatch)
    camera, _ = started.pipeline.datamanager.fixed_indices_eval_dataloader[0]
    away = disturbed(camera, 1.0, model)
    batch = photo_of(model, camera)
    aligned = alignment.align(model, (away, batch))
    assert distance(aligned, camera) < 0.2 * distance(away, camera)


def test_the_pose_that_a_run_refined_is_not_taken_for_the_given_one(colmap: ColmapDataParserConfig, tmp_path: Path):
    """A camera of a training view is aligned from the pose that it brings."""
    config = configure(tmp_path, colmap, 2)
    config.machine.device_type = "cpu"
    config.pipeline.model.poses = "refined"
    trainer = set_up(config)
    model = trainer.pipeline.model
    trainer.pipeline.eval()
    dataset = trainer.pipeline.datamanager.train_dataset
    camera = dataset.cameras[0:1]
    aligned = alignment.align(model, (camera, trainer.pipeline.datamanager.cached_train[0]))
    assert aligned.metadata == {}
    assert camera.metadata != {}


# --- the command ---


def test_the_option_is_part_of_a_run_s_key_only_where_it_is_given():
    scene = protocol.Scene("room", "room", "colmap")
    row = protocol.Row("ours", "sadgs")
    plain = protocol.Job(scene, row, 0)
    aligned = protocol.Job(scene, dataclasses.replace(row, aligned=True), 0)
    assert plain.key != aligned.key
    actual = protocol.Row(**dataclasses.asdict(aligned.row))
    assert actual == aligned.row


def test_the_command_aligns_all_rows_if_asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    file = tmp_path / "protocol.yaml"
    file.write_text(
        "scenes: {room: {data: room, dataparser: colmap}}\nseeds: [0]\nrows:\n  - {label: a, method: sadgs}\n"
    )
    monkeypatch.setattr("benchmarks.datasets.check", lambda *_: None)
    for aligned in (False, True):
        command = Benchmark(file, tmp_path, tmp_path / "rows.jsonl", aligned=aligned)
        actual = [job.row.aligned for job in command.selected()]
        assert actual == [aligned]


def test_the_table_has_the_columns_if_a_row_has_them():
    row: dict[str, Any] = {
        "key": "room/ours/0", "scene": "room", "label": "ours", "seed": 0, "status": "ok", "psnr": 30.0, "ssim": 0.9,
        "lpips": 0.1, "view_psnr": [30.0], "gaussians": 10, "loop_seconds": 1.0, "peak_gb": 1.0,
    }  # fmt: skip
    assert "aligned" not in table.markdown([row])
    text = table.markdown([row | {"aligned_psnr": 31.25, "aligned_ssim": 0.91, "aligned_lpips": 0.09}])
    header, _, line = text.splitlines()
    assert "| PSNR, aligned | SSIM, aligned | LPIPS, aligned |" in header
    assert "31.25" in line
    assert ".9100" in line
