"""Kernels of refined poses against the torch functions that they stand in for, in float64."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from helpers.closeness import assert_within
from helpers.generators import seeded
from sadgs_ns.geometry import poses as in_torch
from sadgs_ns.kernels import triton_switched
from sadgs_ns.training.step import row_adam
from sadgs_ns.training.step.nonfinite import MAX_GRADIENT

kernels = pytest.importorskip("sadgs_ns.kernels.poses", reason="Triton is not installed")

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
BETAS = (0.9, 0.999)
LOG_BETAS = (math.log(0.9), math.log(0.999))
EPS = 1e-15


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=seeded(seed), dtype=torch.float64)


def cameras(number: int) -> Tensor:
    viewmats = torch.eye(4, dtype=torch.float64).repeat(number, 1, 1)
    viewmats[:, :3, :3] = in_torch.rotations(random(number, 3))
    viewmats[:, :3, 3] = random(number, 3, seed=1)
    return viewmats


@pytest.mark.parametrize("size", [0.0, 1e-20, 1e-6, 1e-2, 0.3, 1.5])
@pytest.mark.parametrize("number", [1, 3, 40])
def test_corrected_matrices_and_gradients_equal_float64(number: int, size: float):
    table = size * random(50, 6, seed=2) / 2
    ids = torch.randperm(50, generator=seeded(3))[:number]
    initial = cameras(number)
    upstream = random(number, 4, 4, seed=4)
    upstream[:, 3] = 0

    exact = table.float().double().requires_grad_()
    expected = in_torch.corrected(initial.float().double(), exact[ids])
    (expected * upstream).sum().backward()
    fast = table.float().to(DEVICE).requires_grad_()
    found = kernels.corrected(initial.float().to(DEVICE), fast, ids.to(DEVICE))
    (found * upstream.float().to(DEVICE)).sum().backward()
    actual = found.double().cpu()
    assert_within(actual, expected, 2e-6)
    assert fast.grad is not None
    assert exact.grad is not None
    actual = fast.grad.double().cpu()
    assert_close(actual, exact.grad, rtol=1e-5, atol=2e-5)
    others = torch.ones(50, dtype=torch.bool)
    others[ids] = False
    assert not fast.grad[others.to(DEVICE)].any()


def test_a_view_that_is_drawn_twice_adds_both_gradients():
    table = torch.zeros(4, 6, device=DEVICE, requires_grad=True)
    initial = cameras(2).float().to(DEVICE)
    kernels.corrected(initial, table, torch.tensor([2, 2], device=DEVICE)).sum().backward()
    assert table.grad is not None
    actual = table.grad[2, 3:].cpu()
    expected = torch.full((3,), 2.0)
    assert_close(actual, expected)


@pytest.mark.parametrize("rows", [1, 7, 300])
def test_rows_move_as_in_torch(rows: int):
    units = 1 + random(rows, 6, seed=5).abs()
    exact: Any = random(rows, 6)
    fast = exact.float().to(DEVICE)
    states = row_adam.empty_moments(exact), row_adam.empty_moments(fast)
    flags = torch.zeros(1, dtype=torch.float64), torch.zeros(1, device=DEVICE)
    for step in range(6):
        gradient = random(rows, 6, seed=10 + step)
        if step == 3:
            gradient[0, 1] = torch.nan
            gradient[0, 2] = 2 * MAX_GRADIENT
        moved = torch.arange(rows) % 3 != step % 3
        with triton_switched(False):
            row_adam.move_rows(exact, gradient, states[0], row_adam.RowUpdate(moved, units), 0.1, BETAS, EPS, flags[0])
        rate = torch.tensor([0.5, 0.1], device=DEVICE)[1]
        kernels.move_rows(
            fast, gradient.float().to(DEVICE), states[1], moved.to(DEVICE), units.float().to(DEVICE), rate,
            BETAS, LOG_BETAS, EPS, flags[1], MAX_GRADIENT,
        )  # fmt: skip
        actual = fast.double().cpu()
        assert_close(actual, exact, rtol=2e-5, atol=2e-5)
        assert torch.equal(states[1]["step"].double().cpu(), states[0]["step"])
        assert bool(flags[0].isnan()) == bool(flags[1].isnan()) == (step >= 3)
    for name, moment in states[0].items():
        actual = states[1][name].double().cpu()
        assert_close(actual, moment, rtol=1e-5, atol=1e-7)
