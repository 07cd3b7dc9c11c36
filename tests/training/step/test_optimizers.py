"""The training step's optimizers in one launch, against one launch for each parameter and against torch's Adam."""

from __future__ import annotations

import copy
import gc
import warnings
import weakref
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from gsplat.strategy.ops import remove
from torch import Tensor
from torch.testing import assert_close

from sadgs_ns import kernels
from sadgs_ns.training.step.nonfinite import NonFiniteLog
from sadgs_ns.training.step.optimizers import (
    AdamUpdate,
    FusedAdamOptimizerConfig,
    RunLengthDecaySchedulerConfig,
    SadgsOptimizers,
)

adam = pytest.importorskip("sadgs_ns.kernels.adam", reason="Triton is not installed")

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
GAUSSIANS = {
    "means": (3,), "scales": (3,), "quats": (4,), "features_dc": (3,), "features_rest": (15, 3), "opacities": (1,)
}  # fmt: skip
STEPS = 6


@pytest.fixture(autouse=True)
def triton(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernels, "available", lambda device: True)


@pytest.fixture
def launches(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many parameters each launch updated."""
    counts: list[int] = []
    step = adam.adam_step

    def counted(parameters: tuple[Tensor, ...], *args: Any, **kwargs: Any) -> None:
        counts.append(len(parameters))
        step(parameters, *args, **kwargs)

    monkeypatch.setattr(adam, "adam_step", counted)
    return counts


def config(optimizer: Any, final_factor: float | None = 0.1) -> dict[str, Any]:
    schedule = RunLengthDecaySchedulerConfig(final_factor=final_factor, max_steps=STEPS) if final_factor else None
    return {"optimizer": optimizer, "scheduler": schedule}


class Training:
    """A few Gaussians, poses and colours that follow made-up gradients; `way` is "together", "apart" or "torch"."""

    def __init__(self, way: str, **optimizers: Any) -> None:
        shapes = {name: (50, *width) for name, width in GAUSSIANS.items()}
        shapes |= {"camera_opt": (4, 6), "color_matrices": (4, 12, 2)}
        torch.manual_seed(0)
        self.way = way
        self.params = {name: torch.nn.Parameter(torch.randn(shape).to(DEVICE)) for name, shape in shapes.items()}
        configs = {
            name: config(FusedAdamOptimizerConfig(lr=0.01 * (k + 1), eps=1e-15)) for k, name in enumerate(GAUSSIANS)
        }
        configs["camera_opt"] = config(FusedAdamOptimizerConfig(lr=0.02))
        configs["color_matrices"] = config(FusedAdamOptimizerConfig(lr=0.03, eps=1e-8), None)
        with kernels.triton_switched(way != "torch"):
            self.optimizers = SadgsOptimizers(
                configs | optimizers, {name: [parameter] for name, parameter in self.params.items()}
            )
        self.log = NonFiniteLog(DEVICE)

    def step(self, step: int, wrong: float | None = None) -> None:
        """Follow gradients, one of which may be wrong."""
        gradients = {name: (step + 1) * p.detach().cos() for name, p in self.params.items()}
        if wrong is not None:
            gradients["scales"][7] = wrong
        adams: Any = self.optimizers.optimizers
        with kernels.triton_switched(self.way != "torch"):
            updates = [self.optimizers.update()]
            if self.way == "apart":
                updates = [AdamUpdate({name: optimizer}) for name, optimizer in adams.items()]
            for update in updates:
                update.launch(gradients, update.factors().to(DEVICE), self.log.nonfinite_flag)
        self.log.record(step, [0], torch.zeros((), device=DEVICE))
        self.optimizers.scheduler_step_all(step)

    def tensors(self) -> Iterator[tuple[str, Tensor]]:
        """Parameters, the optimizers' state, learning rates."""
        for name, parameter in self.params.items():
            yield name, parameter.detach()
            optimizer = self.optimizers.optimizers[name]
            yield f"{name}.lr", torch.tensor(optimizer.param_groups[0]["lr"])
            for key, value in optimizer.state.get(parameter, {}).items():
                yield f"{name}.{key}", value


def assert_same(one: Training, other: Training, tolerance: float = 0.0) -> None:
    """They agree to the bit; compiled, a product and a sum may round once in one kernel and twice in another."""
    expected = dict(one.tensors())
    for name, value in other.tensors():
        known = expected.pop(name)
        if value.is_cuda or tolerance:
            value = value.to(DEVICE)
            known = known.to(DEVICE)
            assert_close({name: value}, {name: known}, atol=max(tolerance, 1e-7), rtol=tolerance or 2e-6)
        else:
            assert torch.equal(value, known), name
    assert not expected


@pytest.fixture(autouse=True)
def scalars(monkeypatch: pytest.MonkeyPatch) -> None:
    """nerfstudio's loggers are not set up here."""
    monkeypatch.setattr("nerfstudio.utils.writer.put_scalar", lambda **_: None)


def test_one_launch_equals_one_for_each_parameter_and_torch(launches):
    trainings = {way: Training(way) for way in ("apart", "together", "torch")}
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        for training in trainings.values():
            for step in range(STEPS):
                training.step(step)
                if step == 2:  # other lengths, and parameters that are other objects
                    mask = torch.arange(50, device=DEVICE) % 3 == 0
                    gaussians = {name: training.params[name] for name in GAUSSIANS}
                    remove(gaussians, training.optimizers.optimizers, {}, mask)
                    training.params |= gaussians
                    assert len(training.params["means"]) == 33
    assert not [str(warning.message) for warning in warned]
    assert_same(trainings["apart"], trainings["together"])
    assert_same(trainings["torch"], trainings["together"], 1e-5)
    assert launches == [1] * 8 * STEPS + [6, 1, 1] * STEPS  # The poses and the colours have settings of their own.


def test_what_agrees_in_length_and_settings_is_updated_together(launches):
    larger = FusedAdamOptimizerConfig(lr=0.03, eps=1e-8)
    training = Training("together", camera_opt=config(larger), means=config(larger))
    training.step(0)
    assert sorted(launches) == [1, 2, 5]


def test_parameters_without_numbers_are_left_out(launches):
    training = Training("together")
    optimizer = training.optimizers.optimizers["features_rest"]
    optimizer.param_groups[0]["params"] = [torch.nn.Parameter(torch.zeros((50, 0, 3), device=DEVICE))]
    training.step(0)
    assert launches == [5, 1, 1]
    assert not optimizer.state


def test_gradients_that_are_not_finite_are_named_and_left_out():
    trainings = [Training(way) for way in ("apart", "together", "torch")]
    for training in trainings:
        for step, wrong in enumerate((None, torch.nan, 1e30, None)):
            training.step(step, wrong)
        actual = [step for step, _, _ in training.log.read()]
        assert actual == [1, 2]
        for _, value in training.tensors():
            assert value.isfinite().all()
    apart, together, by_torch = trainings
    assert_same(apart, together)
    assert_same(by_torch, together, 1e-5)


def test_the_gaussians_of_the_start_do_not_stay_in_memory():
    training = Training("together")
    group = training.optimizers.optimizers["means"].param_groups[0]
    first = weakref.ref(group["params"][0])
    group["params"] = [torch.nn.Parameter(group["params"][0].detach().repeat(2, 1))]
    training.params.clear()  # as densification exchanges them
    gc.collect()
    assert first() is None


@pytest.mark.parametrize("source", ["together", "torch"])
@pytest.mark.parametrize("target", ["together", "torch"])
def test_a_checkpoint_goes_on_in_the_other(source, target):
    first = Training(source)
    without_stop = Training(target)
    for step in range(3):
        first.step(step)
    states = copy.deepcopy({name: o.state_dict() for name, o in first.optimizers.optimizers.items()})
    resumed = Training(target)
    for name, parameter in resumed.params.items():
        parameter.data.copy_(first.params[name].data)
    resumed.optimizers.load_optimizers(states)
    resumed.optimizers.go_on_after(3, {})
    for step in range(3, STEPS):
        resumed.step(step)
    for step in range(STEPS):
        without_stop.step(step)
    assert_same(without_stop, resumed, 0.0 if source == target else 1e-5)
