"""The kernel of Adam against torch's Adam."""

from __future__ import annotations

import math
from collections.abc import Sequence

import pytest
import torch
from torch import Tensor

from sadgs_ns import kernels
from sadgs_ns.training.step.optimizers import AdamUpdate, FusedAdam

adam = pytest.importorskip("sadgs_ns.kernels.adam", reason="Triton is not installed")

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
ADAM = {"betas": (0.9, 0.999), "eps": 1e-15}
OURS = {**ADAM, "max_gradient": 1e18}
WIDTHS = [(3,), (15, 3), (), (4,), (1,)]  # a row of each parameter
LRS = (0.1, 0.01, 0.3, 0.003, 0.02)


def with_moments(start: list[Tensor]) -> tuple[tuple[Tensor, ...], ...]:
    """Copies of parameters, and their first and second moments of zeros."""
    zeros = [tuple(torch.zeros_like(p, device=DEVICE) for p in start) for _ in range(2)]
    return tuple(p.to(DEVICE).clone() for p in start), *zeros


def factors(steps: Sequence[int], lrs: Sequence[float]) -> Tensor:
    """Of the updates with these numbers."""
    columns = [adam.rate_and_scale(step, lr, ADAM["betas"]) for step, lr in zip(steps, lrs, strict=True)]
    return torch.tensor(columns, device=DEVICE).T.contiguous()


@pytest.mark.parametrize("rows", [0, 1, 37, 1024], ids="{} Gaussians".format)
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-5), (torch.float32, 2e-5)], ids=str)
def test_adam_in_one_launch_equals_torchs_and_one_launch_for_each_parameter(rows, dtype, tolerance):
    generator = torch.Generator().manual_seed(0)
    start = [torch.randn((rows, *width), generator=generator) for width in WIDTHS]
    expected = [torch.nn.Parameter(p.to(dtype, copy=True)) for p in start]
    groups = [{"params": [p], "lr": lr} for p, lr in zip(expected, LRS, strict=True)]
    optimizer = torch.optim.Adam(groups, **ADAM)
    together = with_moments(start)
    separate = with_moments(start)
    noted = torch.zeros(1, device=DEVICE)
    for step in range(1, 4):
        gradients = tuple(torch.randn(p.shape, generator=generator) for p in start)
        for parameter, gradient in zip(expected, gradients, strict=True):
            parameter.grad = gradient.to(dtype)
        optimizer.step()
        gradients = tuple(gradient.to(DEVICE) for gradient in gradients)
        adam.adam_step(together[0], gradients, *together[1:], factors([step] * 5, LRS), noted, **OURS)
        for gradient, lr, (p, m, v) in zip(gradients, LRS, zip(*separate, strict=True), strict=True):
            adam.adam_step((p,), (gradient,), (m,), (v,), factors([step], [lr]), noted, **OURS)
    assert float(noted) == 0
    for one, other in zip(together, separate, strict=True):
        if torch.device("cpu") == DEVICE:
            assert all(map(torch.equal, one, other))
        else:  # compiled, a product and a sum may round once in one kernel and twice in another
            torch.testing.assert_close(one, other, atol=1e-7, rtol=2e-6)
    for actual, parameter in zip(together[0], expected, strict=True):
        torch.testing.assert_close(actual.to("cpu", dtype), parameter.detach(), atol=tolerance, rtol=tolerance)


@pytest.mark.parametrize("flags", [[], [0], [1], [0, 1], [1, 1]])
def test_an_update_of_a_step_that_overflowed_changes_nothing(flags):
    parameters = with_moments([torch.ones((37, *width)) for width in WIDTHS])
    gradients = tuple(torch.full_like(p, math.nan) for p in parameters[0])
    noted = torch.zeros(1, device=DEVICE)
    overflowed = tuple(torch.tensor([flag], device=DEVICE) for flag in flags)
    adam.adam_step(parameters[0], gradients, *parameters[1:], factors([1] * 5, LRS), noted, overflowed, **OURS)
    drawn = not flags or 0 in flags
    assert bool(noted.isnan()) == drawn, "nothing is noted, either"
    gradients = tuple(torch.ones_like(p) for p in parameters[0])
    adam.adam_step(parameters[0], gradients, *parameters[1:], factors([1] * 5, LRS), noted, overflowed, **OURS)
    for values, start in zip(parameters, (1, 0, 0), strict=True):
        for value in values:
            assert bool((value == start).all()) != drawn


def test_adam_counts_each_parameters_own_updates():
    start = [torch.linspace(-1, 1, 50), torch.linspace(1, 2, 50)]
    expected = [torch.nn.Parameter(p.double()) for p in start]
    optimizers = [torch.optim.Adam([p], lr=0.1, eps=1e-15) for p in expected]
    actual = with_moments(start)
    noted = torch.zeros(1, device=DEVICE)
    for step in range(1, 5):
        for k in (0, 1) if step > 2 else (0,):  # the other one's gradients come late
            expected[k].grad = torch.full_like(expected[k], step)
            optimizers[k].step()
        gradients = tuple(torch.full_like(p, step) for p in actual[0])
        if step > 2:
            both = factors([step, step - 2], [0.1, 0.1])
            adam.adam_step(actual[0], gradients, *actual[1:], both, noted, **OURS)
        else:
            first = [values[:1] for values in (actual[0], gradients, *actual[1:])]
            adam.adam_step(*first, factors([step], [0.1]), noted, **OURS)
    for p, q in zip(actual[0], expected, strict=True):
        torch.testing.assert_close(p.double().cpu(), q.detach(), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("wrong", [math.nan, math.inf, -1e30])
@pytest.mark.parametrize("k", range(len(WIDTHS)))
def test_a_gradient_that_is_not_finite_is_noted_and_left_out_of_its_parameter_alone(k, wrong):
    start = [torch.ones((37, *width)) for width in WIDTHS]
    results = []
    for value in (0.0, wrong):
        parameters = with_moments(start)
        noted = torch.zeros(1, device=DEVICE)
        gradients = tuple(torch.full_like(p, 0.5) for p in parameters[0])
        gradients[k].flatten()[-1:] = value  # within the block that is not full
        adam.adam_step(parameters[0], gradients, *parameters[1:], factors([1] * 5, LRS), noted, **OURS)
        assert bool(noted.isnan()) == (value != 0.0)
        results.append([tensor for tensors in parameters for tensor in tensors])
    assert all(map(torch.equal, *results))


def test_an_update_keeps_torchs_state_while_it_runs_the_kernel(monkeypatch):
    states = []
    for triton in (False, True):
        monkeypatch.setattr(kernels, "available", lambda device, triton=triton: triton)
        start = torch.linspace(-1, 1, 50, device=DEVICE)
        adam_of = {"a": FusedAdam([torch.nn.Parameter(start.clone())], lr=0.01)}
        noted = torch.zeros(1, device=DEVICE)
        for _ in range(3):
            update = AdamUpdate(adam_of)
            update.launch({"a": update.parameters["a"].detach().clone()}, update.factors().to(DEVICE), noted)
        restored = FusedAdam([torch.nn.Parameter(update.parameters["a"].detach().clone())], lr=0.01)
        restored.load_state_dict(adam_of["a"].state_dict())
        again = AdamUpdate({"a": restored})
        again.launch({"a": torch.ones(50, device=DEVICE)}, again.factors().to(DEVICE), noted)
        states.append((update.parameters["a"], again.parameters["a"], adam_of["a"].state_dict()["state"]))
    (*slow, slow_state), (*fast, fast_state) = states
    torch.testing.assert_close(fast, slow, atol=1e-6, rtol=1e-6)
    assert slow_state.keys() == fast_state.keys() == {0}
    assert slow_state[0].keys() == fast_state[0].keys()
