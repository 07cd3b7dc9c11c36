"""The kernels that are compiled before a run starts: the run does not notice, unless one fails."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from helpers.triton_compiler import run_with_the_compiler
from sadgs_ns import kernels
from sadgs_ns.training.config import SadgsTrainerConfig
from sadgs_ns.training.kernels_ahead import compilation
from sadgs_ns.training.kernels_ahead import probes as stages
from sadgs_ns.training.run.trainer import SadgsTrainer

FIRST_RUN = """
import sys
from pathlib import Path
sys.path.insert(0, sys.argv[1])
from helpers.kill_and_resume import configure
from helpers.compile_timer import CompileTimer
from sadgs_ns.training.run.trainer import SadgsTrainer

config = configure(Path(sys.argv[2]), Path(sys.argv[3]), 100, save_every=0)
config.machine.device_type = "cuda"
config.pipeline.views_per_iteration = int(sys.argv[4])
before, after = CompileTimer(), CompileTimer()
with before:
    trainer = SadgsTrainer(config)
    trainer.setup()
with after:
    trainer.train()
trainer.shutdown()
print("compiled", before.seconds > 0, after.seconds)
"""


@pytest.mark.skipif(not torch.cuda.is_available(), reason="the kernels are compiled for the GPU that is there")
@pytest.mark.parametrize("views", [1, 2, 4])
def test_training_compiles_nothing_that_was_not_compiled_ahead(scene: Path, tmp_path: Path, views: int):
    arguments = str(Path(__file__).parents[2]), str(scene), str(tmp_path / "out"), str(views)
    run = run_with_the_compiler(tmp_path / "cache", FIRST_RUN, *arguments)
    assert run.returncode == 0, run.stderr[-3000:]
    assert "compiled True 0" in run.stdout, run.stdout[-3000:]


def test_without_a_gpu_there_is_nothing_to_compile(config: SadgsTrainerConfig, monkeypatch: pytest.MonkeyPatch):
    trainer = SadgsTrainer(config)
    made: list[object] = []
    monkeypatch.setattr(compilation, "Stages", lambda *choice: made.append(choice))
    trainer.setup()
    trainer.shutdown()
    assert made == []


def test_tile_lists_are_tried_in_the_size_of_the_run(config: SadgsTrainerConfig, monkeypatch: pytest.MonkeyPatch):
    """More tiles than 16 bits number have a kernel of their own."""
    trainer = SadgsTrainer(config)
    trainer.setup()
    sizes = []

    def rasterize(gaussians, cameras, options):
        sizes.append((cameras.width, cameras.height))
        return None, None, {}

    monkeypatch.setattr(stages, "rasterize", rasterize)
    monkeypatch.setattr(kernels, "available", lambda device: True)
    monkeypatch.setattr(trainer.pipeline.structure_cache, "of_images", None)
    for name in ("quantize", "photometric_loss", "observe"):
        monkeypatch.setattr(stages, name, None)  # the stages that need a GPU end at once
    compilation.compile_kernels(trainer.pipeline, trainer.optimizers.optimizers)
    cameras = trainer.pipeline.datamanager.train_dataset.cameras
    assert (int(cameras.width.max()), int(cameras.height.max())) in sizes
    assert (64, 64) in sizes
    trainer.shutdown()


@pytest.mark.hard_case("a run some of whose kernels cannot be compiled", "goes on")
@pytest.mark.skipif(torch.cuda.is_available(), reason="this is tried in Triton's interpreter")
def test_what_cannot_be_compiled_leaves_the_run_as_it_was(
    config: SadgsTrainerConfig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """All run but the projection and what needs it."""
    pytest.importorskip("triton", reason="Triton is not installed")
    from sadgs_ns.kernels import adam, projection

    def fail(*args, **options):
        raise RuntimeError("no compiler")

    monkeypatch.setattr(projection, "project_forward", fail)
    trainer = SadgsTrainer(config)
    trainer.setup()
    launched = []
    monkeypatch.setattr(stages, "_SIZE", 12)  # the interpreter is slow, and would take half a minute for S̄
    monkeypatch.setattr(trainer.pipeline.structure_cache, "of_images", lambda image: image)
    monkeypatch.setattr(kernels, "available", lambda device: True)
    names = dict.fromkeys(("quantize", "photometric_loss", "rasterize", "observe", "activate"), stages)
    for name, module in (names | {"adam_step": adam}).items():
        original = getattr(module, name)

        def launch(*args, name=name, original=original, **options):
            launched.append(name)
            return original(*args, **options)

        monkeypatch.setattr(module, name, launch)
    parameters = {name: value.detach().clone() for name, value in trainer.pipeline.model.gauss_params.items()}
    random_state = torch.get_rng_state()
    compilation.compile_kernels(trainer.pipeline, trainer.optimizers.optimizers)
    expected = [*["activate"] * 2, "adam_step", *["photometric_loss"] * 2, "quantize", "rasterize"]
    assert sorted(launched) == expected
    output = capsys.readouterr().out
    assert "The kernels of rasterization could not be compiled and tried before training (no compiler)" in output
    assert torch.equal(torch.get_rng_state(), random_state)
    assert all(torch.equal(trainer.pipeline.model.gauss_params[name], value) for name, value in parameters.items())
    for optimizer in trainer.optimizers.optimizers.values():
        assert not optimizer.state
    trainer.shutdown()


@pytest.mark.hard_case("kernels that cannot be compiled before training", "named with the first reason in one sentence")
def test_kernels_that_fail_are_told_in_one_sentence(
    config: SadgsTrainerConfig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    trainer = SadgsTrainer(config)
    trainer.setup()

    def full(*args, **options):
        raise torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 2 GiB.\nOf no interest.")

    monkeypatch.setattr(kernels, "available", lambda device: True)
    monkeypatch.setattr(stages, "rasterize", lambda *args, **options: (None, None, {}))
    monkeypatch.setattr(trainer.pipeline.structure_cache, "of_images", lambda image: image)
    monkeypatch.setattr(stages, "observe", lambda *args, **options: None)
    monkeypatch.setattr(stages.Stages, "update", lambda self: None)
    monkeypatch.setattr(stages, "quantize", full)
    monkeypatch.setattr(stages, "photometric_loss", full)
    capsys.readouterr()
    compilation.compile_kernels(trainer.pipeline, trainer.optimizers.optimizers)
    told = " ".join(capsys.readouterr().out.split())
    assert told.count("could not be compiled") == 1
    assert "The kernels of the loss, S̄" in told
    assert "(CUDA out of memory. Tried to allocate 2 GiB): training tries them again" in told
    trainer.shutdown()


def test_a_run_of_the_defaults_takes_the_kernels_that_are_chosen_without_it(config: SadgsTrainerConfig):
    """Those that can be compiled before the data is known."""
    trainer = SadgsTrainer(config)
    trainer.setup()
    chosen = compilation.choose_kernels(trainer.pipeline, trainer.optimizers.optimizers)
    drawing = replace(chosen.drawing, backend="triton")
    default = stages.KernelChoice(trainer.pipeline.device, views=chosen.views, size=chosen.size)
    assert replace(chosen, drawing=drawing) == default
    trainer.shutdown()
