"""Steps that are replayed as graphs train as steps whose kernels are launched one by one."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import torch
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.engine.callbacks import TrainingCallbackLocation
from torch import Tensor

from helpers.closeness import assert_within_share
from helpers.interpreted_rasterizer import use_our_rasterizer
from helpers.kill_and_resume import set_up
from helpers.short_runs import configure
from sadgs_ns import kernels
from sadgs_ns.render import backend_gsplat, backend_torch
from sadgs_ns.training.config import SadgsTrainerConfig
from sadgs_ns.training.run import exposure_start
from sadgs_ns.training.run.trainer import SadgsTrainer
from sadgs_ns.training.step import cuda_graphs, optimizers, poses, row_adam
from sadgs_ns.training.step.cuda_graphs import Results

adam = pytest.importorskip("sadgs_ns.kernels.adam", reason="Triton is not installed")

ITERATIONS = 13
on_cpu = pytest.mark.skipif(torch.cuda.is_available(), reason="on the CPU Triton is interpreted")


class Rerun:
    """A graph that calls what was captured again, and puts its results where those of the first replay are."""

    def __init__(self, function: Callable[[], Results]) -> None:
        self.function = function
        self.results: Results | None = None

    def __call__(self) -> Results:
        now = self.function()
        if self.results is None:
            self.results = now
        for tensor, value in zip(self.results, now, strict=True):
            tensor.copy_(value)
        return self.results


class Reruns:
    """In the place of `CudaGraphs`."""

    def __init__(self, device: torch.device) -> None:
        self.generators: set[torch.Generator] = set()
        """Those that a graph draws from."""

    def capture(self, function: Callable[[], Results], generators: Sequence[torch.Generator] = ()) -> Rerun:
        self.generators |= {*generators}
        return Rerun(function)

    def wait(self) -> None:
        """Nothing runs beside the host."""


@pytest.fixture
def without_cuda(monkeypatch: pytest.MonkeyPatch) -> None:
    """Our rasterizer and Adam in Triton's interpreter, and graphs that are called again."""
    use_our_rasterizer(monkeypatch)
    for module in (optimizers, poses, row_adam):
        monkeypatch.setattr(module, "use_triton", lambda place: True)
    monkeypatch.setattr(cuda_graphs, "CudaGraphs", Reruns)
    monkeypatch.setattr(adam, "_BLOCK", 2**16)  # The interpreter runs one program after the other.


@pytest.fixture
def short(colmap: ColmapDataParserConfig, tmp_path: Path) -> SadgsTrainerConfig:
    """A run with an AbsGS step, a reset, a structure step, and steps after all of them."""
    schedule = {"absgs_every": 3, "structure_every": 6, "reset_every": 4, "refine_stop_iter": 6, "eta_every": 3}
    # The interpreter runs one program for up to 1,024 Gaussians.
    config = configure(tmp_path, colmap, ITERATIONS, **schedule, max_gaussians=1000)
    config.machine.device_type = "cpu"
    config.pipeline.views_per_iteration = 1
    config.cuda_graphs = True
    return config


def run(config: SadgsTrainerConfig, graphed: bool) -> tuple[SadgsTrainer, list[Any]]:
    """Train to the end; also return the loss, PSNR, views and rates of each step, as they are after the whole run."""
    config = copy.deepcopy(config)
    config.cuda_graphs = graphed
    trainer = set_up(config)
    trace = []
    iterate = trainer.train_iteration
    record = trainer.pipeline.log.record

    def noted(step: int) -> Any:
        result = iterate(step)
        rates = [scheduler.get_last_lr() for scheduler in trainer.optimizers.schedulers.values()]
        trace.append((result[0].detach(), result[2]["psnr"], result[2]["gaussian_count"], rates))
        return result

    def begun(step: int, views: list[int], loss: Tensor) -> None:
        trace.append((step, views))
        record(step, views, loss)

    trainer.train_iteration = noted  # type: ignore[method-assign]
    trainer.pipeline.log.record = begun  # type: ignore[method-assign]
    trainer.train()
    return trainer, trace


def live(trainer: SadgsTrainer) -> dict[str, Tensor]:
    """Parameters, moments, counts of updates, statistics, the mean of the parameters, and the log of gradients."""
    model = trainer.pipeline.model
    values: dict[str, Any] = {**model.trained_params, **model.strategy_state}
    values |= {f"mean of {name}": mean for name, mean in model.average.means.items()}
    for name, optimizer in trainer.optimizers.optimizers.items():
        for state in optimizer.state.values():
            values |= {f"{name}.{key}": value for key, value in state.items()}
    values["log"] = trainer.pipeline.log._gradients
    return {name: value.detach() for name, value in values.items() if isinstance(value, Tensor)}


def tensors(trainer: SadgsTrainer) -> dict[str, Tensor]:
    """Copies of `live`."""
    return {name: value.clone() for name, value in live(trainer).items()}


def assert_equal(one: dict[str, Tensor], other: dict[str, Tensor], what: str = "") -> None:
    assert one.keys() == other.keys()
    wrong = [name for name in one if not torch.equal(one[name].nan_to_num(), other[name].nan_to_num())]
    assert not wrong, f"{what}: {wrong}"


def choose_colors(config: SadgsTrainerConfig, colors: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let a run train with learned colour matrices, with gains however small they are, or with none of them."""
    config.pipeline.model.color_model = "none"
    if colors == "affine":
        config.pipeline.model.color_model = "affine"
    if colors == "gains":
        config.pipeline.model.exposure = "auto"
        monkeypatch.setattr(exposure_start, "LEAST_DEVIATION", 0.0)
        monkeypatch.setattr(exposure_start, "LEAST_REDUCTION", -1.0)


@on_cpu
@pytest.mark.parametrize(
    ("color_model", "poses_are", "views", "dropout"),
    [
        ("none", "fixed", 2, 0.0),
        ("none", "refined", 1, 0.1),
        pytest.param("affine", "fixed", 1, 0.0, marks=pytest.mark.slow),
        pytest.param("gains", "refined", 2, 0.0, marks=pytest.mark.slow),
    ],
)
def test_a_run_of_graphs_equals_one_of_launches_bit_for_bit(
    color_model: str, poses_are: Any, views: int, dropout: float,
    without_cuda: None, short: SadgsTrainerConfig, monkeypatch: pytest.MonkeyPatch,
):  # fmt: skip
    def draw_otherwise(*_: Any) -> None:
        raise AssertionError("Triton's kernels draw")

    for backend in (backend_gsplat, backend_torch):
        monkeypatch.setattr(backend, "project", draw_otherwise)
    choose_colors(short, color_model, monkeypatch)
    short.pipeline.model.poses = poses_are
    short.pipeline.views_per_iteration = views
    short.pipeline.model.dropout = dropout
    launched, expected = run(short, False)
    replayed, found = run(short, True)
    assert launched.graphed is None
    assert replayed.graphed is not None
    assert not replayed.graphed.failure
    assert replayed.graphed.replayed >= 3
    assert len(replayed.graphed._recorder.generators) == (dropout > 0)  # type: ignore[union-attr]
    assert expected == found
    assert_equal(tensors(launched), tensors(replayed))
    assert (replayed.pipeline.model.exposure is not None) == (color_model == "gains")
    assert len({count for *_, count, _ in expected[1::2]}) > 2
    if poses_are == "refined":
        found_poses = replayed.pipeline.model.poses
        assert found_poses is not None
        assert (found_poses.table.detach() != 0).all()


# --- one step ---


def turn(trainer: SadgsTrainer, step: int) -> None:
    """One turn of nerfstudio's training loop."""
    trainer.step = step
    trainer.pipeline.train()
    for callback in trainer.callbacks:
        callback.run_callback_at_location(step, location=TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
    trainer.train_iteration(step)
    for callback in trainer.callbacks:
        callback.run_callback_at_location(step, location=TrainingCallbackLocation.AFTER_TRAIN_ITERATION)


class OneStep:
    """A run in which one step is trained over and over from the same state, as graphs or launch by launch."""

    def __init__(self, config: SadgsTrainerConfig) -> None:
        config.max_num_iterations = 300
        strategy = config.pipeline.model.strategy
        strategy.structure_every = 0
        strategy.absgs_every = 100
        strategy.reset_every = 0
        strategy.refine_stop_iter = 150
        self.trainer = set_up(config)
        self.pipeline, self.model, self.graphed = (
            self.trainer.pipeline,
            self.trainer.pipeline.model,
            self.trainer.graphed,
        )
        assert self.graphed is not None
        self.view = 1
        for self.step in range(10, 14):
            self.train()
            self.view = 0
        self.start = tensors(self.trainer)
        self.rates = [optimizer.param_groups[0]["lr"] for optimizer in self.trainer.optimizers.optimizers.values()]

    def train(self) -> float:
        """Train the step on the view, with all that nerfstudio does before and after, and return its loss."""
        self.pipeline.views.sampler.requeue([self.view])
        train_step = self.trainer.train_iteration
        losses = []
        self.trainer.train_iteration = lambda step: losses.append(train_step(step)[0])  # type: ignore[method-assign]
        turn(self.trainer, self.step)
        self.trainer.train_iteration = train_step  # type: ignore[method-assign]
        return float(losses[0].detach())

    @torch.no_grad()
    def restore(self) -> None:
        """Put the state back in which the step begins, in the place of what the last one left there."""
        self.pipeline.log.read()
        for name, value in live(self.trainer).items():
            value.copy_(self.start[name])
        for optimizer, rate in zip(self.trainer.optimizers.optimizers.values(), self.rates, strict=True):
            optimizer.param_groups[0]["lr"] = rate

    def trained(self, graphed: bool, change: Callable[[], None] = lambda: None) -> dict[str, Tensor]:
        """What the step makes of that state and a change of it."""
        self.restore()
        with torch.no_grad():
            change()
        self.trainer.graphed = self.graphed if graphed else None
        loss = self.train()
        self.pipeline._repeat_overflowed(wait=True)
        found = tensors(self.trainer) | {"loss": torch.tensor(loss)}
        found["wrong"] = torch.tensor([len(what) for _, _, what in self.pipeline.log.read()])
        return found


@pytest.fixture
def one_step(without_cuda: None, short: SadgsTrainerConfig) -> OneStep:
    return OneStep(short)


@on_cpu
def test_a_graph_reads_what_changes_and_what_it_cannot_read_makes_another(
    one_step: OneStep, monkeypatch: pytest.MonkeyPatch
):
    model = one_step.model
    graphed = one_step.graphed
    adams = one_step.trainer.optimizers.optimizers
    image = one_step.pipeline.datamanager.cached_train[0]
    negative = 255 - image["image"]
    floats = image["image"] / 500
    mask = torch.ones((*image["image"].shape[:2], 1), dtype=torch.bool)
    mask[: len(mask) // 2] = False

    def state(name: str) -> dict[str, Tensor]:
        return next(iter(adams[name].state.values()))

    def change_adam(patch: pytest.MonkeyPatch) -> None:
        patch.setitem(adams["means"].param_groups[0], "lr", 0.1)
        state("scales")["step"].add_(1000)
        state("quats")["exp_avg"].add_(0.1)

    read: dict[str, Callable[[pytest.MonkeyPatch], Any]] = {
        "a rate, an update's number and a moment": change_adam,
        "a parameter": lambda patch: model.gauss_params["means"].add_(0.1),
        "what is not finite": lambda patch: model.gauss_params["features_dc"][::2].fill_(torch.nan),
        "AbsGS's sums": lambda patch: model.strategy_state["grad2d"].add_(1.0),
        "a camera": lambda patch: patch.setattr(one_step, "view", 1),
        "an image": lambda patch: patch.setitem(image, "image", negative),
    }
    keys: dict[str, Callable[[pytest.MonkeyPatch], Any]] = {
        "the penalty on opacities": lambda patch: patch.setattr(model.config, "opacity_reg", 1.0),
        "the degree of harmonics": lambda patch: patch.setattr(model.config, "sh_degree", 1),
        "AbsGS": lambda patch: patch.setattr(model.strategy, "needs_absgrad", lambda step: False),
        "lists that are too short": lambda patch: patch.setattr(model.tile_forecast, "capacity", lambda *_: 7),
        "an image of floats": lambda patch: patch.setitem(image, "image", floats),
        "a mask": lambda patch: patch.setitem(image, "mask", mask),
    }
    # The graph of masked steps is there when this one comes.
    masked: dict[str, Callable[[pytest.MonkeyPatch], Any]] = {
        "another mask": lambda patch: patch.setitem(image, "mask", ~mask),
    }
    assert graphed is not None
    assert model.tile_forecast is not None
    overflowed = model.tile_forecast.overflowed
    lost = []

    def noted(*, wait: bool = False) -> list[int]:
        found = overflowed(wait=wait)
        lost.extend(found)
        return found

    monkeypatch.setattr(model.tile_forecast, "overflowed", noted)
    before = one_step.trained(graphed=True)
    assert graphed.replayed > 0
    for name, change in (read | keys | masked).items():
        with monkeypatch.context() as patch:
            replayed = graphed.replayed
            apply = partial(change, patch)
            expected = one_step.trained(False, apply)
            if name in keys:
                rounds = [one_step.trained(True, apply) for _ in range(2)]  # The first is launched and captured.
            else:
                rounds = [one_step.trained(True, apply)]
            assert graphed.replayed == replayed + 1, name
        assert any(not torch.equal(expected[key].nan_to_num(), before[key]) for key in before), name
        for found in rounds:
            assert_equal(expected, found, name)
    assert before["wrong"].numel() == 0
    assert len(lost) == 3
    assert_equal(before, one_step.trained(graphed=True))


@on_cpu
def test_where_capturing_fails_the_steps_are_launched_one_by_one_and_one_sentence_says_so(
    without_cuda: None, short: SadgsTrainerConfig, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    def fail(self: Reruns, function: Callable[[], Results], generators: Sequence[torch.Generator]) -> Rerun:
        raise RuntimeError("CUDA error: operation not permitted when stream is capturing\nCompile with [more].")

    monkeypatch.setattr(Reruns, "capture", fail)
    one_step = OneStep(short)
    assert one_step.graphed is not None
    assert one_step.graphed.replayed == 0
    assert_equal(one_step.trained(False), one_step.trained(True))
    printed = " ".join(capsys.readouterr().out.split())
    assert printed.count("could not be captured as a CUDA graph (CUDA error: operation not permitted when") == 1
    assert not one_step.model.tile_forecast.round_to_powers  # type: ignore[union-attr]


@on_cpu
def test_steps_of_many_gaussians_or_of_transparent_views_are_launched_one_by_one(
    one_step: OneStep, monkeypatch: pytest.MonkeyPatch
):
    graphed = one_step.graphed
    image = one_step.pipeline.datamanager.cached_train[0]
    assert graphed is not None
    opaque = torch.full((*image["image"].shape[:2], 1), 255, dtype=torch.uint8)
    transparent = torch.cat([image["image"], opaque], dim=-1)
    for change in (
        lambda patch: patch.setattr(cuda_graphs, "MOST_GAUSSIANS", one_step.model.num_points - 1),
        lambda patch: patch.setitem(image, "image", transparent),
        lambda patch: patch.setattr(cuda_graphs, "MOST_GRAPHS", 0),
        lambda patch: patch.setattr(cuda_graphs, "has_room", lambda device: False),
    ):
        with monkeypatch.context() as patch:
            graphed._drop()
            replayed = graphed.replayed
            for _ in range(3):
                one_step.trained(True, partial(change, patch))
            assert graphed.replayed == replayed


# --- what is graphed ---


@pytest.mark.parametrize(
    "change",
    [
        lambda config: setattr(config, "cuda_graphs", False),
        lambda config: setattr(config.pipeline.model, "backend", "torch"),
    ],
    ids=[
        "switched off",
        "another backend",
    ],
)
@on_cpu
def test_what_graphs_cannot_do_is_launched_one_by_one(
    without_cuda: None, short: SadgsTrainerConfig, change: Callable[[SadgsTrainerConfig], None]
):
    change(short)
    assert set_up(short).graphed is None


def test_there_are_no_graphs_on_a_cpu(short: SadgsTrainerConfig):
    assert set_up(short).graphed is None


# --- on a GPU ---


@pytest.mark.skipif(not torch.cuda.is_available(), reason="graphs are CUDA's")
@pytest.mark.parametrize(("views", "color_model"), [(1, "none"), (2, "none"), (2, "affine"), (2, "gains")])
def test_a_gpu_trains_alike_with_graphs(
    colmap: ColmapDataParserConfig, tmp_path: Path, views: int, color_model: Any, monkeypatch: pytest.MonkeyPatch
):
    """Atomic additions come in any order, so that two runs differ by rounding, and grow apart once they densify."""
    schedule = {"absgs_every": 60, "structure_every": 120, "reset_every": 0, "refine_stop_iter": 180, "eta_every": 10}
    config = configure(tmp_path, colmap, 300, **schedule, refine_start_iter=60)
    config.pipeline.views_per_iteration = views
    choose_colors(config, color_model, monkeypatch)
    _, expected = run(config, False)
    replayed, found = run(config, True)
    if not kernels.use_triton(replayed.pipeline.model.device):
        pytest.skip("Triton does not run here")
    assert replayed.graphed is not None
    assert replayed.graphed.failure == ""
    assert replayed.graphed.replayed > 150, f"of 300 steps {replayed.graphed.replayed} were replayed"
    assert expected[:100:2] == found[:100:2], "the same views come in the same order"
    losses = []
    for trace in (expected, found):
        of_steps = [loss for loss, *_ in trace[1::2]]
        losses.append(torch.stack(of_steps).cpu())
    actual = losses[1][:50]
    assert_within_share(actual, losses[0][:50], 1e-3)
    for step, tolerance in ((119, 0.02), (299, 0.1)):  # At 120 one more Gaussian that is split has dozens of children.
        actual = found[1::2][step][2]
        assert actual == pytest.approx(expected[1::2][step][2], rel=tolerance)
