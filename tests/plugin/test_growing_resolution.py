"""Runs that render early steps small: which steps, which views, what a checkpoint keeps, and what stays as it is."""

from __future__ import annotations

import math
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from kill_and_resume import differences, set_up
from nerfstudio.data.dataparsers.base_dataparser import DataParserConfig
from runs import checkpoint, configure, is_finite, nerfstudio_data
from torch import Tensor

from sadgs_ns.errors import InputError
from sadgs_ns.method import resolution
from sadgs_ns.method import strategy as strategy_module
from sadgs_ns.method.resolution import FULL_SHARE, reduce_image, reduce_intrinsics, reduce_mask
from sadgs_ns.plugin import growing_resolution, views
from sadgs_ns.plugin.growing_resolution import GrowingResolution
from sadgs_ns.plugin.memory_plan import image_bytes
from sadgs_ns.plugin.pipeline import SadgsPipelineConfig
from sadgs_ns.plugin.trainer import SadgsTrainer, SadgsTrainerConfig
from sadgs_ns.render.rasterization import visible

WIDTH, HEIGHT = 64, 48
"""px; a quarter of it is as large as the window of SSIM asks for."""
TRAIN_VIEWS = 9
"""Of 10, nerfstudio's parser holds out one."""
ITERATIONS, VIEWS_PER_STEP = 40, 2
WINDOWS = {"absgs_every": 3, "structure_every": 9, "refine_stop_iter": 22, "eta_every": 4}


@pytest.fixture(autouse=True)
def small_images_are_reduced(monkeypatch: pytest.MonkeyPatch) -> None:
    """The tests' images have fewer pixels than a reduced one keeps."""
    monkeypatch.setattr(resolution, "LEAST_PIXELS", 1)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> DataParserConfig:
    """Views of the room, to be read only."""
    return nerfstudio_data(tmp_path_factory.mktemp("data"), [(WIDTH, HEIGHT)])


@pytest.fixture
def growing(data: DataParserConfig, tmp_path: Path) -> SadgsTrainerConfig:
    return configured(tmp_path, data)


def configured(folder: Path, parser: DataParserConfig, on: bool = True, **strategy: Any) -> SadgsTrainerConfig:
    config = configure(folder, parser, ITERATIONS, **{**WINDOWS, "max_gaussians": 500, **strategy})
    config.machine.device_type = "cpu"
    config.pipeline.views_per_iteration = VIEWS_PER_STEP
    config.pipeline.growing_resolution = on
    return config


def follow(trainer: SadgsTrainer) -> list[dict[str, Any]]:
    """Note what each step renders and compares, and the level after it."""
    model, steps = trainer.pipeline.model, []
    render, compare = model.get_training_outputs, model.get_loss_dict
    update = trainer._update_viewer_state

    def rendering(
        viewmats: Tensor, Ks: Tensor, width: int, height: int, indices: list[int], tensors: Any, reduced: bool
    ) -> Any:
        steps.append({"step": model.step, "size": (width, height), "views": indices, "Ks": Ks, "tensors": tensors})
        return render(viewmats, Ks, width, height, indices, tensors, reduced)

    def comparing(outputs: Any, batch: Any, *more: Any) -> Any:
        steps[-1] |= batch
        return compare(outputs, batch, *more)

    def updating(step: int) -> None:
        steps[-1]["level"] = trainer.pipeline.resolution.level
        update(step)

    model.get_training_outputs, model.get_loss_dict = rendering, comparing  # type: ignore[method-assign]
    trainer._update_viewer_state = updating  # type: ignore[method-assign]
    return steps


def scripted(monkeypatch: pytest.MonkeyPatch, *lengths: float) -> None:
    """Have the Gaussians measure so many px, one number after the other and the last one again and again."""
    left = list(lengths)
    monkeypatch.setattr(
        growing_resolution, "typical_length", lambda *_: torch.tensor(left.pop(0) if len(left) > 1 else left[0])
    )


def set_sync_debug_mode(mode: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch says that the mode is a prototype.
        torch.cuda.set_sync_debug_mode(mode)


def train(config: SadgsTrainerConfig) -> tuple[SadgsTrainer, list[dict[str, Any]]]:
    trainer = set_up(config)
    steps = follow(trainer)
    trainer.train()
    return trainer, steps


def end_of(trainer: SadgsTrainer, step: int = ITERATIONS - 1) -> dict[str, Any]:
    state = checkpoint(trainer, step)
    # These say how the run was asked for, not what came of it.
    for name in ("growing_resolution", "growing_resolution_strength"):
        state["pipeline"]["_extra_state"]["settings"].pop(name)
    return state


# --- a run ---


def test_a_run_grows_through_the_levels_and_its_images_and_cameras_with_it(
    growing: SadgsTrainerConfig, monkeypatch: pytest.MonkeyPatch
):
    scripted(monkeypatch, 9.0, 5.0, 5.0, 2.5, 7.0, 2.5)  # The Gaussians grow longer once.
    trainer, steps = train(growing)
    pipeline, strategy = trainer.pipeline, trainer.pipeline.model.strategy
    levels = [step["level"] for step in steps]
    assert levels == sorted(levels, reverse=True) and set(levels) == {4, 2, 1}
    assert [levels.index(level) for level in (2, 1)] == [8, 21], "after the third densification, and with the last one"
    rendered = set()
    for step, before in zip(steps, [4, *levels], strict=False):
        number = step["step"]
        observes, densifies = strategy.observes(number), strategy.densifies(number)
        assert (step["tensors"] is not None) == observes
        level = 1 if observes or densifies or number >= WINDOWS["refine_stop_iter"] else before
        assert step["size"] == (WIDTH // level, HEIGHT // level), number
        rendered.add(level)
        if observes:
            assert step["tensors"].shape == (VIEWS_PER_STEP, HEIGHT, WIDTH, 3)
        for view, image, K in zip(step["views"], step["image"], step["Ks"], strict=True):
            full = pipeline.datamanager.cached_train[view]["image"]
            assert torch.equal(image, reduce_image(full, level))
            assert torch.equal(K, reduce_intrinsics(pipeline.views.cameras[1][view], level))
    assert rendered == {4, 2, 1}
    visits = Counter(view for step in steps for view in step["views"])
    assert len(visits) == TRAIN_VIEWS and max(visits.values()) - min(visits.values()) <= 1
    assert is_finite(pipeline.model)


def test_absgs_reads_the_full_steps_and_no_others(
    data: DataParserConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    scripted(monkeypatch, 4.0)
    trainer = set_up(configured(tmp_path, data, absgs_every=8, structure_every=24, refine_stop_iter=24, eta_every=5))
    steps, strategy = follow(trainer), trainer.pipeline.model.strategy
    after_backward, grow = strategy.step_post_backward, strategy_module.grow
    seen: dict[int, Tensor] = {}
    counts: list[Tensor] = []

    def noting_gradients(params: Any, optimizers: Any, state: Any, step: int, infos: list[dict[str, Any]]) -> None:
        if hasattr(infos[0]["means2d"], "absgrad"):
            seen[step] = visible(infos[0]).sum(dim=0).float()
        after_backward(params, optimizers, state, step, infos)

    def noting_counts(params: Any, optimizers: Any, state: Any, **options: Any) -> tuple[int, int]:
        counts.append(state["grad_count"].clone())
        return grow(params, optimizers, state, **options)

    monkeypatch.setattr(strategy, "step_post_backward", noting_gradients)
    monkeypatch.setattr(strategy_module, "grow", noting_counts)
    trainer.train()
    # η is observed at every fifth step; the last quarter before the AbsGS steps 7 and 15 is two steps.
    assert list(seen) == [0, 5, 6, 7, 10, 14, 15]
    assert [step["step"] for step in steps if step["size"] == (WIDTH, HEIGHT)] == [*seen, 20, *range(23, ITERATIONS)]
    for counted, read in zip(counts, ([0, 5, 6, 7], [10, 14, 15]), strict=True):
        assert torch.equal(counted, torch.stack([seen[step] for step in read]).sum(dim=0)) and counted.max() > 2


def test_the_gaussians_themselves_decide_and_strength_keeps_images_small_longer(data: DataParserConfig, tmp_path: Path):
    small = []
    for strength in (0.01, 0.5, 100.0):
        config = configured(tmp_path / str(strength), data)
        config.pipeline.growing_resolution_strength = strength
        _, steps = train(config)
        levels = [step["level"] for step in steps]
        assert levels == sorted(levels, reverse=True) and levels[-1] == 1
        small.append(sum(level > 1 for level in levels))
    assert small[0] == 0 and small == sorted(small) and small[-1] == WINDOWS["refine_stop_iter"] - 1


@pytest.mark.parametrize(("stop", "last"), [(0, 0), (6, 5), (25, 23)])
def test_images_are_full_from_the_end_of_densification_and_in_the_last_share_of_the_run(
    stop: int, last: int, growing: SadgsTrainerConfig, monkeypatch: pytest.MonkeyPatch
):
    assert int((1 - FULL_SHARE) * ITERATIONS) == 24
    scripted(monkeypatch, math.inf)
    growing.pipeline.model.strategy.refine_stop_iter = stop
    _, steps = train(growing)
    small = [step["step"] for step in steps if step["size"] != (WIDTH, HEIGHT)]
    due = [s for s in range(ITERATIONS) if s < min(stop, 24) and s % 4 and (s + 1) % 3 and s + 1 != stop]
    # η is not observed after the last structure step, which may be before densification ends.
    assert set(due) <= set(small) <= set(range(last))


def test_the_last_images_are_reduced_once_and_forgotten(growing: SadgsTrainerConfig, monkeypatch: pytest.MonkeyPatch):
    scripted(monkeypatch, 4.0, 2.0)
    reduced, trainer = Counter(), set_up(growing)
    steps = follow(trainer)

    def counting(image: Tensor, level: int) -> Tensor:
        reduced[image.data_ptr(), level] += 1
        return reduce_image(image, level)

    monkeypatch.setattr(views, "reduce_image", counting)
    trainer.train()
    assert steps and set(reduced.values()) == {1} and {level for _, level in reduced} == {4, 2}
    assert not trainer.pipeline.views._reduced


# --- what is kept and what stays ---


def test_a_resumed_run_equals_one_that_was_never_stopped(growing: SadgsTrainerConfig, monkeypatch: pytest.MonkeyPatch):
    growing.steps_per_save, growing.save_only_latest_checkpoint = 6, False
    growing.pipeline.growing_resolution_strength = 3.0

    def at_level(level: int) -> Callable[..., Tensor]:
        return lambda *_: torch.tensor(level / 3.0)

    lengths = iter([4, 4, 4, 2])  # The level falls at the third densification; step 12 is saved at level 2.
    monkeypatch.setattr(growing_resolution, "typical_length", lambda *_: at_level(next(lengths, 2))())
    undisturbed, steps = train(growing)
    assert steps[12]["level"] == 2
    monkeypatch.setattr(growing_resolution, "typical_length", at_level(2))
    for step in (12, 30):
        resumed_config = configured(growing.output_dir / f"resumed {step}", growing.pipeline.datamanager.dataparser)
        resumed_config.pipeline.growing_resolution_strength = 3.0
        resumed_config.load_dir, resumed_config.load_step = undisturbed.checkpoint_dir, step
        resumed = set_up(resumed_config)
        assert resumed.pipeline.resolution.level == (2 if step == 12 else 1)
        resumed.train()
        assert differences(end_of(undisturbed), end_of(resumed)) == []


def test_nothing_changes_where_it_is_off_or_images_are_too_small(
    data: DataParserConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def never(*_: Any) -> Any:
        raise AssertionError("This belongs to reduced images.")

    with monkeypatch.context() as patched:
        patched.setattr(growing_resolution, "typical_length", never)
        patched.setattr(views, "reduce_image", never)
        patched.setattr(GrowingResolution, "grow", never)
        off, _ = train(configured(tmp_path / "off", data, on=False))
    monkeypatch.setattr(resolution, "LEAST_PIXELS", WIDTH * HEIGHT * VIEWS_PER_STEP)
    too_small, steps = train(configured(tmp_path / "small", data))
    assert {step["size"] for step in steps} == {(WIDTH, HEIGHT)}
    assert differences(end_of(off), end_of(too_small)) == []


def test_a_run_goes_on_with_the_option_switched(growing: SadgsTrainerConfig, monkeypatch: pytest.MonkeyPatch):
    scripted(monkeypatch, 4.0)
    growing.steps_per_save, growing.save_only_latest_checkpoint = 5, False
    first, _ = train(growing)
    config = configured(growing.output_dir / "off", growing.pipeline.datamanager.dataparser, on=False)
    config.load_dir, config.load_step = first.checkpoint_dir, 5
    config.steps_per_save, config.save_only_latest_checkpoint = 5, False
    without, steps = train(config)
    assert {step["size"] for step in steps} == {(WIDTH, HEIGHT)} and is_finite(without.pipeline.model)
    config = configured(growing.output_dir / "on", growing.pipeline.datamanager.dataparser)
    config.load_dir = without.checkpoint_dir
    for step, level in ((10, 4), (25, 1)):  # The Gaussians decide where the checkpoint had no level, up to step 22.
        config.load_step = step
        assert set_up(config).pipeline.resolution.level == level


@pytest.mark.parametrize(
    "options",
    [{"masks": True, "sizes": [(WIDTH, HEIGHT), (53, 45)]}, {"sizes": [(WIDTH, HEIGHT)], "alpha": True}],
    ids=["masks and sizes", "alpha"],
)
def test_masks_transparency_and_sizes_train_alike_wherever_images_are_kept(
    options: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    ends = []
    for tier in ("gpu", "cpu"):  # The first is the device of training.
        scripted(monkeypatch, 4.0, 4.0, 2.0)
        config = configured(tmp_path / tier, nerfstudio_data(tmp_path / f"data {tier}", **options))
        config.pipeline.datamanager.cache_images = tier  # type: ignore[assignment]
        trainer, steps = train(config)
        assert {step["size"] for step in steps} >= {(WIDTH // 4, HEIGHT // 4), (WIDTH // 2, HEIGHT // 2)}
        small = next(step for step in steps if step["size"] == (WIDTH // 4, HEIGHT // 4))
        if "masks" in options:
            assert {step["size"] for step in steps} >= {(13, 11), (26, 22)}
            assert small["mask"].shape[1:] == (HEIGHT // 4, WIDTH // 4, 1)
            assert not small["mask"][:, :, : WIDTH // 8].any() and small["mask"][:, :, WIDTH // 8 :].all()
        ends.append({name: value.clone() for name, value in trainer.pipeline.model.gauss_params.items()})
        assert is_finite(trainer.pipeline.model)
    assert all(torch.equal(ends[0][name], ends[1][name]) for name in ends[0])


def test_the_line_of_what_was_chosen_names_the_first_level(
    growing: SadgsTrainerConfig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    scripted(monkeypatch, 4.0)
    set_up(growing)
    assert "9 times, at first in images of 1/4 of the width and height." in capsys.readouterr().out
    growing.pipeline.growing_resolution = False
    set_up(growing)
    assert "9 times." in capsys.readouterr().out


def test_reduced_images_are_planned_with(growing: SadgsTrainerConfig):
    datamanager = set_up(growing).pipeline.datamanager
    assert image_bytes(datamanager, growing=True) - image_bytes(datamanager) == 3 * TRAIN_VIEWS * WIDTH * HEIGHT / 4


def test_a_strength_must_be_positive():
    with pytest.raises(InputError, match=r"^pipeline\.growing_resolution_strength must be positive and finite, got 0"):
        SadgsPipelineConfig(growing_resolution_strength=0.0).check()


# --- on a GPU ---


@pytest.mark.skipif(not torch.cuda.is_available(), reason="the CPU trains without graphs and waits for nothing")
@pytest.mark.parametrize("graphs", [False, True])
def test_a_gpu_trains_on_reduced_images(
    graphs: bool, growing: SadgsTrainerConfig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    scripted(monkeypatch, 4.0, 2.0)
    growing.machine.device_type, growing.cuda_graphs = "cuda", graphs
    strategy = growing.pipeline.model.strategy
    growing.max_num_iterations, strategy.eta_every = 10 * ITERATIONS, 40
    strategy.absgs_every, strategy.structure_every, strategy.refine_stop_iter = 30, 90, 220
    trainer, steps = train(growing)
    assert {step["size"] for step in steps} == {(WIDTH // level, HEIGHT // level) for level in (4, 2, 1)}
    assert is_finite(trainer.pipeline.model) and not trainer.pipeline.views._reduced
    if trainer.graphed is not None:
        assert trainer.graphed.failure == "" and trainer.graphed.replayed > 0
    assert "could not be compiled" not in capsys.readouterr().out


@pytest.mark.skipif(not torch.cuda.is_available(), reason="only a GPU can be waited for")
@pytest.mark.parametrize("channels", [3, 4])
def test_nothing_waits_for_reduced_images(channels: int):
    image = torch.randint(0, 256, (96, 130, channels), dtype=torch.uint8).cuda()
    mask, Ks = torch.ones((96, 130, 1), dtype=torch.bool).cuda(), torch.eye(3).expand(2, 3, 3).cuda()
    expected = reduce_image(image.cpu(), 4)
    set_sync_debug_mode("error")
    try:
        reduced, _, _ = reduce_image(image, 4), reduce_mask(mask, 4), reduce_intrinsics(Ks, 4)
    finally:
        set_sync_debug_mode("default")
    if channels == 3:  # Weighted means may round otherwise.
        assert torch.equal(reduced.cpu(), expected)
