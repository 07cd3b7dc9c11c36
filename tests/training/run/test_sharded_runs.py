"""Runs whose Gaussians are spread over several processes do what a run of one process does."""

from __future__ import annotations

import copy
import functools
import math
import os
import signal
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from nerfstudio.engine import trainer as nerfstudio_trainer
from nerfstudio.engine.callbacks import TrainingCallback, TrainingCallbackLocation
from nerfstudio.scripts import train as train_script
from nerfstudio.utils.rich_utils import CONSOLE
from torch.multiprocessing.spawn import ProcessExitedException, ProcessRaisedException

from helpers.closeness import assert_within_share
from helpers.gloo_ranks import run_ranks
from helpers.kill_and_resume import configure, differences, set_up
from helpers.refusals import refusal
from helpers.sharded_training import STRUCTURE_EVERY, few_steps, record, record_together, set_up_together
from helpers.short_runs import nerfstudio_data
from helpers.small_scenes import HEIGHT, POINTS, WIDTH
from sadgs_ns.distributed.world import World
from sadgs_ns.errors import RunError
from sadgs_ns.training.config import SadgsTrainerConfig
from sadgs_ns.training.presets import sadgs
from sadgs_ns.training.run import trainer as trainer_module
from sadgs_ns.training.run.trainer import SadgsTrainer


@pytest.mark.parametrize(("ranks", "views"), [(2, 2), (3, 2)])
def test_the_first_steps_are_those_of_one_process(ranks: int, views: int, scene: Path, tmp_path: Path):
    torch.manual_seed(0)
    expected = record(set_up(few_steps(scene, tmp_path / "alone", views)))
    assert expected["steps"][0]["split"] > 0
    results = run_ranks(record_together, ranks, tmp_path / "meet", few_steps(scene, tmp_path / "together", views))
    assert_same_first_steps(results, expected)


@pytest.mark.hard_case("images of several sizes with several processes", "trains as in one process")
@pytest.mark.parametrize("tier", ["gpu", "compressed"])
def test_images_of_several_sizes_train_as_in_one_process(tier: Any, tmp_path: Path):
    """Each step has one view of one size and two of another, or three of one; the small views are one process's."""
    parser = nerfstudio_data(tmp_path / "data", [(WIDTH, HEIGHT), (40, 30)], masks=True)

    def configured(name: str, tier: Any) -> SadgsTrainerConfig:
        config = few_steps(parser.data, tmp_path / name, views=3)
        config.pipeline.datamanager.dataparser = parser
        config.pipeline.datamanager.cache_images = tier
        config.pipeline.model.num_random = POINTS
        return config

    torch.manual_seed(0)
    expected = record(set_up(configured("alone", "gpu")))
    assert expected["steps"][0]["split"] > 0
    results = run_ranks(record_together, 2, tmp_path / "meet", configured("together", tier))
    assert_same_first_steps(results, expected)


def assert_same_first_steps(results: list[dict[str, Any]], expected: dict[str, Any]) -> None:
    """Compare what `record_together` returned in all processes with what `record` returned in one."""
    for result in results:
        first = torch.tensor(result["losses"][:STRUCTURE_EVERY])
        alone = torch.tensor(expected["losses"][:STRUCTURE_EVERY])
        assert_within_share(first, alone, 1e-5)
        assert result["steps"] == expected["steps"]
        assert result["gaussians"] == expected["gaussians"]
    for name, value in expected["statistics"].items():
        together = torch.cat([result["statistics"][name] for result in results])
        # A sample that lies at a threshold may fall to either side of it.
        close = torch.isclose(together, value, rtol=1e-3, atol=1e-4 * float(value.abs().max()))
        assert close.float().mean() > 0.995, name


@pytest.mark.hard_case(
    "matrices of colours or a paused start with several processes",
    "refused by name",
)
@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("pipeline.model.color_model", "affine"),
        ("start_paused", True),
    ],
)
def test_what_needs_one_device_is_refused_by_name(
    option: str, value: Any, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    config = few_steps(scene, tmp_path, 2)
    *path, name = option.split(".")
    setattr(functools.reduce(getattr, path, config), name, value)
    config.check()
    monkeypatch.setenv("WORLD_SIZE", "2")
    with refusal(f"{option} works on one device only, and this run takes several: "):
        config.check()


def train_until(world: World, config: SadgsTrainerConfig, stop: int | None) -> dict[str, Any]:
    """Train, until the last process alone is sent SIGTERM in the step `stop`.

    Returns:
        What the process held at the start and holds at the end, the exit code, and the last step's loss.
    """
    trainer = set_up_together(world, config)
    return train_set_up(trainer, stop if world.rank == world.num_ranks - 1 else None)


def held(trainer: SadgsTrainer) -> dict[str, torch.Tensor]:
    """The Gaussians of this process, with Adam's moments, by names."""
    values = {name: value.detach().clone() for name, value in trainer.pipeline.model.gauss_params.items()}
    for name in list(values):
        for state in trainer.optimizers.optimizers[name].state.values():
            values |= {f"{name}.{key}": state[key].clone() for key in ("exp_avg", "exp_avg_sq")}
    return values


def train_set_up(trainer: SadgsTrainer, stop: int | None) -> dict[str, Any]:
    """`train_until` of a trainer that is set up."""
    result: dict[str, Any] = {"start": held(trainer), "code": 0}
    iterate = trainer.train_iteration

    def noted(step: int) -> Any:
        if step == stop:
            os.kill(os.getpid(), signal.SIGTERM)
        outcome = iterate(step)
        result["loss"] = float(outcome[0])
        return outcome

    trainer.train_iteration = noted  # type: ignore[method-assign]
    try:
        trainer.train()
    except SystemExit as ending:
        result["code"] = ending.code
    return result | {"end": held(trainer), "gaussians": trainer.pipeline.model.num_gaussians}


def saved(folder: Path) -> tuple[int, dict[str, torch.Tensor]]:
    """The step of the only checkpoint, and what `held` returns of a process that has all of it."""
    (path,) = folder.glob("*.ckpt")
    state = torch.load(path, weights_only=True)
    parameters = {
        name.rpartition(".")[2]: value for name, value in state["pipeline"].items() if ".gauss_params." in name
    }
    for name in list(parameters):
        for moments in state["optimizers"][name]["state"].values():
            parameters |= {f"{name}.{key}": moments[key] for key in ("exp_avg", "exp_avg_sq")}
    return state["step"], parameters


@pytest.mark.hard_case(
    "SIGTERM to one of several processes; a checkpoint of three processes, resumed with two and with one",
    "all stop after the same step and save one checkpoint; each process takes its part",
)
def test_a_run_goes_on_with_fewer_processes(scene: Path, tmp_path: Path):
    """With three, then with two, which a signal to one of them ends, then with one."""
    config = configure(scene, tmp_path / "runs", 20, save_every=0)
    config.pipeline.views_per_iteration = 2
    folder = config.get_checkpoint_dir()
    parameters: dict[str, torch.Tensor] = {}
    for ranks, stop in ((3, 5), (2, 11)):
        results = run_ranks(train_until, ranks, tmp_path / str(ranks), copy.deepcopy(config), stop)
        codes = [result["code"] for result in results]
        assert codes == [128 + signal.SIGTERM] * ranks
        if parameters:
            together = {name: torch.cat([result["start"][name] for result in results]) for name in parameters}
            assert not differences(together, parameters), "each process should take its part of the checkpoint"
        last, parameters = saved(folder)
        assert last == stop
        together = {name: torch.cat([result["end"][name] for result in results]) for name in parameters}
        assert not differences(together, parameters), "the checkpoint should hold what the processes have"
        sizes = [len(result["end"]["means"]) for result in results]
        assert max(sizes) <= 1.1 * min(sizes) + 1
        assert sum(sizes) == results[0]["gaussians"]
        config.load_dir = folder
    alone = train_set_up(set_up(copy.deepcopy(config)), None)
    assert not differences(alone["start"], parameters)
    assert saved(folder)[0] == 19
    undisturbed = configure(scene, tmp_path / "undisturbed", 20, save_every=0)
    undisturbed.pipeline.views_per_iteration = 2
    expected = train_set_up(set_up(undisturbed), None)
    assert alone["loss"] == pytest.approx(expected["loss"], rel=0.05)
    assert alone["gaussians"] == pytest.approx(expected["gaussians"], rel=0.1)


@pytest.mark.slow
def test_a_whole_run_reaches_the_quality_of_one_process(scene: Path, tmp_path: Path):
    def configured(name: str) -> SadgsTrainerConfig:
        config = configure(scene, tmp_path / name, 50, save_every=0)
        config.pipeline.views_per_iteration = 2
        return config

    alone = set_up(configured("alone"))
    alone.train()
    together = configured("together")
    run_ranks(train_until, 2, tmp_path / "meet", copy.deepcopy(together), None)
    together.load_dir = together.get_checkpoint_dir()
    trainers = alone, set_up(copy.deepcopy(together))
    psnr = [trainer.pipeline.get_average_eval_image_metrics()["psnr"] for trainer in trainers]
    assert psnr[0] > 15, psnr
    assert abs(psnr[1] - psnr[0]) < 0.5, psnr


def fade_and_train(world: World, config: SadgsTrainerConfig, faint: tuple[int, ...]) -> dict[str, Any]:
    """Train, where at first all Gaussians of some processes are too faint to outlive the first pruning."""
    trainer = set_up_together(world, config)
    if world.rank in faint:
        trainer.pipeline.model.gauss_params["opacities"].data[:] = -6.0
    return train_set_up(trainer, None)


@pytest.mark.hard_case("a process that loses all its Gaussians in a prune", "gets others in the same step")
@pytest.mark.parametrize("faint", [(0,), (0, 1, 2)])
def test_a_process_that_loses_all_its_gaussians_gets_others(faint: tuple[int, ...], scene: Path, tmp_path: Path):
    """Where none would be left in any process, none is pruned."""
    config = configure(scene, tmp_path / "runs", 10, save_every=0)
    config.pipeline.model.strategy.structure_every = 0
    results = run_ranks(fade_and_train, 3, tmp_path / "meet", config, faint)
    sizes = [len(result["end"]["means"]) for result in results]
    assert min(sizes) > 50
    assert max(sizes) <= 1.1 * min(sizes) + 1
    assert sum(sizes) == results[0]["gaussians"]
    for result in results:
        assert math.isfinite(result["loss"])


def compile_together(world: World, config: SadgsTrainerConfig) -> tuple[float, float]:
    """When this process began and ended to compile kernels, which takes the first one half a second."""
    times: list[float] = []

    def compile_kernels(*_: Any) -> None:
        times.append(time.time())
        time.sleep(0.5 if world.rank == 0 else 0)
        times.append(time.time())

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trainer_module, "compile_kernels", compile_kernels)
        set_up_together(world, config)
    return times[0], times[1]


def test_the_first_process_compiles_before_the_others(scene: Path, tmp_path: Path):
    config = configure(scene, tmp_path / "runs", 20, save_every=0)
    (_, first_end), *others = run_ranks(compile_together, 3, tmp_path / "meet", config)
    assert all(start >= first_end for start, _ in others)


def die_in_setup(world: World, config: SadgsTrainerConfig) -> str:
    """Be killed while compiling, or say by which error another process's end ends this one."""
    with pytest.MonkeyPatch.context() as patch, pytest.raises(RunError) as error:
        patch.setattr(trainer_module, "compile_kernels", lambda *_: os.kill(os.getpid(), signal.SIGKILL))
        set_up_together(world, config)
    return str(error.value)


@pytest.mark.hard_case("one of several processes is killed before the first step", "the others say so")
def test_a_process_that_is_killed_before_the_first_step_ends_the_others(scene: Path, tmp_path: Path):
    config = configure(scene, tmp_path / "runs", 20, save_every=0)
    _, *messages = run_ranks(die_in_setup, 3, tmp_path / "meet", config, doomed=(0,))
    for message in messages:
        assert message == (
            "Another process of the run ended, and this one with it: stopped before an iteration was done; "
            "the same command starts again."
        )


def train_and_die(world: World, config: SadgsTrainerConfig, doomed: int) -> tuple[str, int]:
    """Train, and kill one process before step 4; by which error the others end, and the last step that they begin."""
    trainer = set_up_together(world, config)
    begun = []

    def die(step: int) -> None:
        begun.append(step)
        if step == 4 and world.rank == doomed:
            os.kill(os.getpid(), signal.SIGKILL)

    trainer.callbacks.append(TrainingCallback([TrainingCallbackLocation.BEFORE_TRAIN_ITERATION], die))
    with pytest.raises(RunError) as error:
        trainer.train()
    return str(error.value), begun[-1]


@pytest.mark.hard_case(
    "one of several processes is killed",
    "all end in that step; the others say so and name the last checkpoint, from which the run resumes",
)
def test_a_killed_process_ends_the_others_with_a_sentence_that_names_the_checkpoint(scene: Path, tmp_path: Path):
    config = configure(scene, tmp_path / "runs", 20, save_every=3)
    # Messages between processes are waited for longer than `run_ranks` lets a process live.
    endings = run_ranks(train_and_die, 3, tmp_path / "meet", config, 1, doomed=(1,))
    for message, last_step in (endings[0], endings[2]):
        assert message.startswith("Another process of the run ended, and this one with it: what"), message
        assert str(config.get_checkpoint_dir()) in message
        assert last_step == 4
    assert saved(config.get_checkpoint_dir())[0] == 3


def train_where_it_is_quickest(world: World, config: SadgsTrainerConfig) -> dict[str, Any]:
    """Train, and return what this process printed; the others wait until it has ended."""
    try:
        trainer = config.setup(local_rank=world.rank, world_size=world.num_ranks)
        with CONSOLE.capture() as printed:
            trainer.setup()
    except SystemExit as ending:
        return {"code": ending.code, "ended": time.time()}
    assert trainer.world.is_single
    assert torch.distributed.get_world_size() == 1
    return train_set_up(trainer, None) | {"printed": printed.get(), "ended": time.time()}


def test_steps_of_few_pixels_train_on_one_device(scene: Path, tmp_path: Path):
    def configured(name: str) -> SadgsTrainerConfig:
        config = configure(scene, tmp_path / name, 6, save_every=0)
        config.share_always = False
        return config

    alone = train_set_up(set_up(configured("alone")), None)
    first, *others = run_ranks(train_where_it_is_quickest, 3, tmp_path / "meet", configured("together"))
    codes = [other["code"] for other in others]
    assert codes == [0, 0]
    for other in others:
        assert other["ended"] > first["ended"], "nerfstudio ends all with the first that ends"
    assert "Training on one device: a step draws 0.00 megapixels, and 3 devices are expected" in first["printed"]
    assert first["loss"] == alone["loss"]
    assert not differences(first["end"], alone["end"])
    assert saved(configured("together").get_checkpoint_dir())[0] == 5


def ask_for_a_viewer(world: World, config: SadgsTrainerConfig) -> tuple[bool, str]:
    """Set a run up, in place of whose viewer stands another object; whether it was made, and what was printed."""
    with pytest.MonkeyPatch.context() as patch, CONSOLE.capture() as printed:
        patch.setattr(nerfstudio_trainer, "ViewerState", lambda *_, **__: SimpleNamespace(viewer_info=[]))
        try:
            trainer = config.setup(local_rank=world.rank, world_size=world.num_ranks)
            trainer.setup()
        except SystemExit:  # It has waited for the first process, which goes on alone.
            return False, ""
    return trainer.viewer_state is not None, printed.get()


@pytest.mark.parametrize("share", [True, False])
def test_a_run_has_its_viewer_where_it_goes_on_with_one_device(share: bool, scene: Path, tmp_path: Path):
    config = configure(scene, tmp_path / "runs", 6, save_every=0)
    config.share_always = share
    config.vis = "viewer+tensorboard"
    first, second = run_ranks(ask_for_a_viewer, 2, tmp_path / "meet", config)
    assert first[0] is not share
    assert ("The viewer is off" in first[1]) is share
    assert not second[0]


@pytest.mark.parametrize(
    ("error", "sentence"),
    [
        (
            ProcessExitedException("process 1 terminated with signal SIGKILL", 1, 7, -9, "SIGKILL"),
            "A process of the run ended, and the others with it (process 1 terminated with signal SIGKILL): what ",
        ),
        (
            ProcessRaisedException("\n\n-- Process 1 terminated with the following error:\nTraceback …\n"
                                   "sadgs_ns.errors.InputError: The folder is empty: fill it.\n", 1, 7),
            "The folder is empty: fill it.",
        ),
    ],
)  # fmt: skip
def test_what_ended_a_process_of_nerfstudios_is_told_in_a_sentence(
    error: Exception, sentence: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def fail() -> None:
        raise error

    context = SimpleNamespace(join=fail)
    monkeypatch.setattr(train_script, "mp", SimpleNamespace(spawn=lambda *arguments, **options: context))
    monkeypatch.setattr("nerfstudio.utils.profiler.flush_profiler", lambda config: None)
    with pytest.raises(type(error)) as raised:
        train_script.launch(train_script.train_loop, 2, config=sadgs.config)
    sys.excepthook(type(error), error, raised.value.__traceback__)
    errors = capsys.readouterr().err
    assert errors.startswith(f"error: {sentence}")
