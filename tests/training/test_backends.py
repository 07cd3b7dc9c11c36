"""Runs with the gsplat backend, and without gsplat's CUDA code; without a GPU, torch functions stand in for kernels."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import gsplat
import pytest
import torch
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig

from helpers.gsplat_stub import stub_gsplat
from helpers.kill_and_resume import set_up
from helpers.refusals import refusal
from helpers.short_runs import ITERATIONS, configure, is_finite, train
from sadgs_ns.cli import export
from sadgs_ns.distributed.world import World
from sadgs_ns.gsplat_compat import RADII_PER_AXIS
from sadgs_ns.render import rasterization
from sadgs_ns.training import config as config_module
from sadgs_ns.training import model as model_module
from sadgs_ns.training.config import SadgsTrainerConfig
from sadgs_ns.training.kernels_ahead import compilation
from sadgs_ns.training.kernels_ahead.probes import Stages
from sadgs_ns.training.run.trainer import SadgsTrainer

ON_GPU = torch.cuda.is_available()


@pytest.fixture
def config(colmap: ColmapDataParserConfig, tmp_path: Path) -> SadgsTrainerConfig:
    """A run with AbsGS and structure steps, and with matrices of colours."""
    config = configure(tmp_path, colmap, ITERATIONS)
    config.pipeline.model.backend = "gsplat"
    config.pipeline.model.color_model = "affine"
    config.pipeline.views_per_iteration = 2
    return config


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """The numbers of Gaussians that gsplat composited; without a GPU its stubs run on the CPU."""
    if not ON_GPU:
        stub_gsplat(monkeypatch, RADII_PER_AXIS)
        for module in (rasterization, model_module, config_module):
            monkeypatch.setattr(module, "choose_backend", lambda wanted, *place: wanted)
    composite = gsplat.rasterize_to_pixels
    numbers = []

    def counted(means2d: torch.Tensor, *args: Any, **options: Any) -> Any:
        numbers.append(means2d.shape[1])
        return composite(means2d, *args, **options)

    monkeypatch.setattr(gsplat, "rasterize_to_pixels", counted)
    return numbers


def resumed(config: SadgsTrainerConfig, whole: SadgsTrainer, folder: Path) -> SadgsTrainer:
    config.output_dir = folder
    config.load_dir = whole.checkpoint_dir
    config.load_step = ITERATIONS // 2
    return train(config)


def test_it_trains_resumes_and_exports(
    config: SadgsTrainerConfig, drawn: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    config.steps_per_save = ITERATIONS // 2
    config.save_only_latest_checkpoint = False
    config.max_num_iterations = ITERATIONS
    whole = train(config)
    model = whole.pipeline.model
    assert model.backend == "gsplat"
    assert len(drawn) >= ITERATIONS
    assert is_finite(model)
    steps: Any = model.strategy_state["structure_steps"]
    assert sum(step["split"] for step in steps) > 0
    assert model.num_points > steps[0]["before"]
    assert model.color_matrices is not None
    assert model.color_matrices.detach().abs().sum() > 0
    again = resumed(config, whole, tmp_path / "again")
    assert is_finite(again.pipeline.model)
    assert again.pipeline.model.step == ITERATIONS - 1
    if not ON_GPU:  # There, atomic additions round in any order.
        for name, value in model.gauss_params.items():
            assert torch.equal(again.pipeline.model.gauss_params[name], value), name
    path = tmp_path / "splat.ply"
    status = export.main([str(whole.base_dir), "--output", str(path)])
    assert status == 0
    assert f"element vertex {model.num_points}\n".encode() in path.read_bytes()


def test_it_begins_as_a_run_of_another_backend_does(config: SadgsTrainerConfig, drawn: list[int], tmp_path: Path):
    losses: list[list[float]] = []
    config.max_num_iterations = 3
    for backend in ("gsplat", "torch"):
        config.pipeline.model.backend = backend
        config.output_dir = tmp_path / backend
        trainer = set_up(config)
        of_run = []
        iterate = trainer.train_iteration

        def noted(step: int, iterate: Any = iterate, of_run: list[float] = of_run) -> Any:
            result = iterate(step)
            of_run.append(float(result[0].detach()))
            return result

        trainer.train_iteration = noted  # type: ignore[method-assign]
        trainer.train()
        losses.append(of_run)
    assert drawn
    assert len(losses[0]) == 3
    expected = pytest.approx(losses[1][0], rel=1e-4)
    assert losses[0][0] == expected
    assert losses[0] == pytest.approx(losses[1], rel=1e-2)  # Adam steps as far where rounding decides a sign.


def test_of_kernels_that_draw_none_is_compiled_ahead(config: SadgsTrainerConfig, drawn: list[int]):
    pipeline = set_up(config).pipeline
    drawn.clear()  # With CUDA the setup compiles, too.
    stages = Stages(compilation.choose_kernels(pipeline, {}))
    stages.project()
    assert stages.after_projection().keys() == {"η", "compositing with AbsGS"}
    for stage in stages.after_projection().values():
        stage()
    assert drawn == [64, 64]


@pytest.mark.hard_case("the gsplat backend without CUDA, or on several GPUs", "refused in one sentence")
def test_where_it_cannot_draw_it_is_refused(config: SadgsTrainerConfig, monkeypatch: pytest.MonkeyPatch):
    config.machine.device_type = "cpu"
    with refusal(r"^The backend gsplat needs a CUDA device, and this is cpu: set .+\.yml\.$"):
        set_up(config)
    with refusal(r"^The backend gsplat works on one device only, and this run takes several: "):
        rasterization.choose_backend("gsplat", torch.device("cuda"), single_process=False)
    config.pipeline.model.backend = "auto"
    model = set_up(config).pipeline.model
    world = World()
    asked: list[Any] = []
    monkeypatch.setattr(model_module, "choose_backend", lambda *args: asked.append(args))
    model.shard(world)
    assert asked == [("auto", world.device, True)]


@pytest.mark.hard_case("gsplat's CUDA code was never compiled", "Triton trains, renders and exports")
def test_with_triton_nothing_calls_gsplats_cuda_code(
    scene: Path, colmap: ColmapDataParserConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setitem(sys.modules, "gsplat.cuda._backend", None)  # Importing it is an error.
    with pytest.raises(ImportError, match="_backend"):
        gsplat.spherical_harmonics(0, torch.ones(1, 3), torch.ones(1, 1, 3))
    if not ON_GPU:
        interpreted = pytest.importorskip("helpers.interpreted_rasterizer", exc_type=ImportError)
        interpreted.use_our_rasterizer(monkeypatch)
    config = configure(tmp_path, colmap, ITERATIONS)
    trainer = train(config)
    model = trainer.pipeline.model
    assert model.backend == "triton"
    assert is_finite(model)
    steps: Any = model.strategy_state["structure_steps"]
    assert sum(step["split"] for step in steps) > 0
    cameras = trainer.pipeline.datamanager.eval_dataset.cameras
    with torch.no_grad():
        outputs = model.get_outputs(cameras[0:1].to(model.device))
        normals = model.get_normals(cameras[0:1].to(model.device))
    assert outputs["rgb"].isfinite().all()
    assert (outputs["depth"] > 0).any()
    assert normals.shape == outputs["rgb"].shape
    run = [str(trainer.base_dir), "--data", str(scene)]
    status = export.main([*run, "--output", str(tmp_path / "splat.ply"), "--min-views", "1"])
    assert status == 0
