"""The training step's optimizers in one launch, against nerfstudio's way of one after the other."""

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
from nerfstudio.engine.optimizers import AdamOptimizerConfig, Optimizers
from torch import Tensor
from torch.amp.grad_scaler import GradScaler

from sadgs_ns import kernels
from sadgs_ns.plugin.nonfinite import NonFiniteLog
from sadgs_ns.plugin.optimizers import (
    FusedAdam,
    FusedAdamOptimizerConfig,
    RunLengthDecaySchedulerConfig,
    SadgsOptimizers,
)

adam = pytest.importorskip("sadgs_ns.kernels.adam", reason="Triton is not installed")

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
OFF = GradScaler(DEVICE.type, enabled=False)
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
    """A few Gaussians, poses and colours that follow made-up gradients."""

    def __init__(self, cls: type[Optimizers], **optimizers: Any) -> None:
        shapes = {name: (50, *width) for name, width in GAUSSIANS.items()}
        shapes |= {"camera_opt": (4, 6), "color_matrices": (4, 12, 2)}
        torch.manual_seed(0)
        self.params = {name: torch.nn.Parameter(torch.randn(shape).to(DEVICE)) for name, shape in shapes.items()}
        configs = {
            name: config(FusedAdamOptimizerConfig(lr=0.01 * (k + 1), eps=1e-15)) for k, name in enumerate(GAUSSIANS)
        }
        configs["camera_opt"] = config(AdamOptimizerConfig(lr=0.02))
        configs["color_matrices"] = config(FusedAdamOptimizerConfig(lr=0.03, eps=1e-8), None)
        configs |= optimizers
        self.optimizers = cls(configs, {name: [parameter] for name, parameter in self.params.items()})
        self.log = NonFiniteLog(DEVICE)
        for optimizer in self.optimizers.optimizers.values():
            if isinstance(optimizer, FusedAdam):
                optimizer.log = self.log

    def step(self, step: int, *, scaler: GradScaler = OFF, without: tuple[str, ...] = ()) -> None:
        """nerfstudio's `train_iteration`, without the model."""
        self.optimizers.zero_grad_some(list(self.params))
        assert all(parameter.grad is None for parameter in self.params.values())
        loss = sum(((step + 1) * p.sin()).sum() for name, p in self.params.items() if name not in without)
        scaler.scale(loss).backward()  # type: ignore[union-attr]
        self.log.begin_step(step, [0], loss)  # type: ignore[arg-type]
        self.optimizers.optimizer_scaler_step_some(scaler, list(self.params))  # type: ignore[arg-type]
        scaler.update()
        self.optimizers.scheduler_step_all(step)

    def tensors(self) -> Iterator[tuple[str, Tensor]]:
        """Parameters, the optimizers' state, learning rates."""
        for name, parameter in self.params.items():
            yield name, parameter.detach()
            optimizer = self.optimizers.optimizers[name]
            yield f"{name}.lr", torch.tensor(optimizer.param_groups[0]["lr"])
            for key, value in optimizer.state.get(parameter, {}).items():
                yield f"{name}.{key}", value


def assert_same(one: Training, other: Training) -> None:
    """They agree to the bit; compiled, a product and a sum may round once in one kernel and twice in another."""
    expected = dict(one.tensors())
    for name, value in other.tensors():
        if value.is_cuda:
            torch.testing.assert_close({name: value}, {name: expected.pop(name)}, atol=1e-7, rtol=2e-6)
        else:
            assert torch.equal(value, expected.pop(name)), name
    assert not expected


@pytest.fixture(autouse=True)
def scalars(monkeypatch: pytest.MonkeyPatch) -> None:
    """nerfstudio's loggers are not set up here."""
    monkeypatch.setattr("nerfstudio.utils.writer.put_scalar", lambda **_: None)


def test_one_launch_equals_nerfstudios_way(launches):
    one, other = Training(Optimizers), Training(SadgsOptimizers)
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always")
        for training in (one, other):
            for step in range(STEPS):
                training.step(step)
                if step == 2:  # other lengths, and parameters that are other objects
                    mask = torch.arange(50, device=DEVICE) % 3 == 0
                    gaussians = {name: training.params[name] for name in GAUSSIANS}
                    remove(gaussians, training.optimizers.optimizers, {}, mask)
                    training.params |= gaussians
                    assert len(training.params["means"]) == 33
    assert not [str(warning.message) for warning in warned]
    assert_same(one, other)
    assert launches == [1] * 7 * STEPS + [6, 1] * STEPS  # the grids have another length


def test_what_agrees_in_length_and_settings_is_updated_together(launches):
    larger = FusedAdamOptimizerConfig(lr=0.03, eps=1e-8)
    training = Training(SadgsOptimizers, camera_opt=config(larger), means=config(larger))
    training.step(0)
    assert sorted(launches) == [1, 2, 5]
    training.optimizers.optimizers["quats"].log = NonFiniteLog(DEVICE)  # type: ignore[attr-defined]
    launches.clear()
    training.step(1)
    assert sorted(launches) == [1, 1, 2, 4]


def test_parameters_without_a_gradient_stay_and_get_no_state(launches):
    one, other = Training(Optimizers), Training(SadgsOptimizers)
    for training in (one, other):
        training.step(0)
        before = training.params["features_rest"].detach().clone()
        training.step(1, without=("features_rest",))
        assert torch.equal(training.params["features_rest"], before)
        training.step(2)
    assert_same(one, other)
    assert launches[-6:] == [6, 1, 5, 1, 6, 1]
    never = Training(SadgsOptimizers)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        never.step(0, without=("quats",))
    assert not never.optimizers.optimizers["quats"].state
    never.step(1)
    assert float(never.optimizers.optimizers["quats"].state[never.params["quats"]]["step"]) == 1


def test_gradients_that_are_not_finite_are_named_and_left_out():
    one, other = Training(Optimizers), Training(SadgsOptimizers)
    for training in (one, other):
        training.step(0)
        for step, wrong in ((1, torch.nan), (2, 1e30)):
            handle = training.params["scales"].register_hook(
                lambda gradient, wrong=wrong: gradient.index_fill(0, torch.tensor([7], device=DEVICE), wrong)
            )
            training.step(step)
            handle.remove()
        training.step(3)
        assert [step for step, _, _ in training.log.read()] == [1, 2]
        assert all(value.isfinite().all() for _, value in training.tensors())
    assert_same(one, other)


@pytest.mark.parametrize(
    ("options", "scaled", "expected"),
    [
        ({"max_norm": 0.1}, False, [5, 1, 1]),
        ({"weight_decay": 0.1}, False, [5, 1]),  # torch's
        ({}, True, [1] * 7),
    ],
    ids=["max_norm", "weight_decay", "scaled"],
)
def test_what_the_launch_cannot_do_goes_nerfstudios_way(options, scaled, expected, launches):
    trainings = []
    for cls in (Optimizers, SadgsOptimizers):
        launches.clear()
        trainings.append(Training(cls, means=config(FusedAdamOptimizerConfig(lr=0.1, **options))))
        scaler = GradScaler(DEVICE.type, init_scale=1024.0, enabled=scaled)
        for step in range(3):
            trainings[-1].step(step, scaler=scaler)
    assert_same(*trainings)
    assert launches == expected * 3


def test_gradients_are_also_clipped_when_densification_has_replaced_their_parameter():
    training = Training(SadgsOptimizers, means=config(FusedAdamOptimizerConfig(lr=0.1, max_norm=0.1)))
    group = training.optimizers.optimizers["means"].param_groups[0]
    replaced = torch.nn.Parameter(group["params"][0].detach().repeat(2, 1))
    first = weakref.ref(group["params"][0])
    group["params"] = [replaced]
    training.params.clear()  # as densification exchanges them
    training.optimizers.zero_grad_some(["means"])
    gc.collect()
    assert first() is None, "the Gaussians of the start stay in memory"
    replaced.grad = torch.ones_like(replaced)
    training.optimizers.optimizer_scaler_step_some(OFF, ["means"])  # type: ignore[arg-type]
    assert float(replaced.grad.norm()) == pytest.approx(0.1, rel=1e-3)


@pytest.mark.parametrize("source", [Optimizers, SadgsOptimizers, "torch"])
@pytest.mark.parametrize("target", [Optimizers, SadgsOptimizers, "torch"])
def test_a_checkpoint_goes_on_in_the_other(source, target):
    plain = {name: config(AdamOptimizerConfig(lr=0.01 * (k + 1), eps=1e-15)) for k, name in enumerate(GAUSSIANS)}

    def start(way: Any) -> Training:
        return Training(Optimizers, **plain) if way == "torch" else Training(way)

    first, without_stop = start(source), start(target)
    for step in range(3):
        first.step(step)
    states = copy.deepcopy({name: o.state_dict() for name, o in first.optimizers.optimizers.items()})
    schedules = {name: s.state_dict() for name, s in first.optimizers.schedulers.items()}
    resumed = start(target)
    for name, parameter in resumed.params.items():
        parameter.data.copy_(first.params[name].data)
    resumed.optimizers.load_optimizers(states)
    resumed.optimizers.load_schedulers(schedules)
    for step in range(3, STEPS):
        resumed.step(step)
    for step in range(STEPS):
        without_stop.step(step)
    expected = dict(without_stop.tensors())
    for name, value in resumed.tensors():
        tolerance = 0.0 if source == target else 1e-5
        torch.testing.assert_close(value, expected.pop(name), atol=tolerance, rtol=tolerance)
    assert not expected


def test_only_the_named_parameters_lose_their_gradients_and_are_updated():
    training = Training(SadgsOptimizers)
    training.step(0)
    before = {name: parameter.detach().clone() for name, parameter in training.params.items()}
    training.optimizers.zero_grad_some(["means", "camera_opt"])
    assert {name for name, parameter in training.params.items() if parameter.grad is None} == {"means", "camera_opt"}
    training.optimizers.optimizer_scaler_step_some(OFF, ["means", "quats", "camera_opt"])  # type: ignore[arg-type]
    assert {name for name, p in training.params.items() if not torch.equal(p, before[name])} == {"quats"}
