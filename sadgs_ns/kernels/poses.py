"""Refined poses: `geometry.poses.corrected` of rows and `training.step.row_adam.move_rows`, in a launch each.

In torch they take a hundred launches of a few numbers each, which a step of few Gaussians feels.
"""

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from sadgs_ns.kernels import cdiv
from sadgs_ns.kernels.shared import load3, store3

_TERMS = tl.constexpr(10)  # Of the series, which are exact to rounding up to half a turn
_LANES = 32  # Views that one program handles
_ROWS = 128  # Rows of a table that one program updates


@triton.jit
def _series(squared, FIRST: tl.constexpr, TERMS: tl.constexpr):
    """Return 1 − s / (f (f + 1)) (1 − s / ((f + 2)(f + 3)) (1 − …)) of s, and its derivative by s; f is FIRST."""
    value = squared * 0 + 1.0
    slope = squared * 0
    for j in tl.static_range(TERMS):
        k = FIRST + 2 * (TERMS - 1 - j)
        factor = 1.0 / (k * (k + 1))
        slope = -factor * (value + squared * slope)
        value = 1.0 - factor * squared * value
    return value, slope


@triton.jit
def _rotation(x, y, z):
    """Return the nine entries of the rotation of a rotation vector, row by row."""
    squared = x * x + y * y + z * z
    sine, _ = _series(squared, 2, _TERMS)  # sin θ / θ
    versine, _ = _series(squared, 3, _TERMS)
    versine = 0.5 * versine  # (1 − cos θ) / θ²
    return (
        1 - versine * (y * y + z * z), versine * x * y - sine * z, versine * x * z + sine * y,
        versine * x * y + sine * z, 1 - versine * (x * x + z * z), versine * y * z - sine * x,
        versine * x * z - sine * y, versine * y * z + sine * x, 1 - versine * (x * x + y * y),
    )  # fmt: skip


@triton.jit(do_not_specialize=["n"])
def _correct_poses(initial, table, view_ids, viewmats, n, LANES: tl.constexpr):
    """Write the matrices of n views after their corrections."""
    view = tl.program_id(0) * LANES + tl.arange(0, LANES)
    exists = view < n
    row = 6 * tl.load(view_ids + view, exists, 0)
    x, y, z = load3(table, row, exists)
    shift_0, shift_1, shift_2 = load3(table, row + 3, exists)
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = _rotation(x, y, z)
    at = 16 * view
    for j in tl.static_range(4):
        first, second, third = load3(initial, at + j, exists, 4)
        top = r00 * first + r01 * second + r02 * third
        middle = r10 * first + r11 * second + r12 * third
        bottom = r20 * first + r21 * second + r22 * third
        if j == 3:
            top = top + shift_0
            middle = middle + shift_1
            bottom = bottom + shift_2
        store3(viewmats, at + j, top, middle, bottom, exists, 4)
        tl.store(viewmats + at + 12 + j, tl.load(initial + at + 12 + j, exists), exists)


@triton.jit(do_not_specialize=["n"])
def _correct_poses_backward(initial, table, view_ids, v_viewmats, v_rows, n, LANES: tl.constexpr):
    """Write the gradients by the corrections of n views. [n, 6]"""
    view = tl.program_id(0) * LANES + tl.arange(0, LANES)
    exists = view < n
    x, y, z = load3(table, 6 * tl.load(view_ids + view, exists, 0), exists)
    at = 16 * view
    zero = tl.zeros([LANES], tl.float32)
    g00, g01, g02 = zero, zero, zero
    g10, g11, g12 = zero, zero, zero
    g20, g21, g22 = zero, zero, zero
    for j in tl.static_range(4):  # The gradient by the rotation: that of the matrix times the initial one, transposed.
        first, second, third = load3(initial, at + j, exists, 4)
        v_0, v_1, v_2 = load3(v_viewmats, at + j, exists, 4)
        g00, g01, g02 = g00 + v_0 * first, g01 + v_0 * second, g02 + v_0 * third
        g10, g11, g12 = g10 + v_1 * first, g11 + v_1 * second, g12 + v_1 * third
        g20, g21, g22 = g20 + v_2 * first, g21 + v_2 * second, g22 + v_2 * third
        if j == 3:
            store3(v_rows, 6 * view + 3, v_0, v_1, v_2, exists)
    squared = x * x + y * y + z * z
    sine, sine_slope = _series(squared, 2, _TERMS)
    versine, versine_slope = _series(squared, 3, _TERMS)
    versine = 0.5 * versine
    versine_slope = 0.5 * versine_slope
    axis_x = g21 - g12
    axis_y = g02 - g20
    axis_z = g10 - g01
    trace = g00 + g11 + g22
    along_x = 2 * g00 * x + (g01 + g10) * y + (g02 + g20) * z  # (G + Gᵀ) ω
    along_y = (g01 + g10) * x + 2 * g11 * y + (g12 + g21) * z
    along_z = (g02 + g20) * x + (g12 + g21) * y + 2 * g22 * z
    by_sine = axis_x * x + axis_y * y + axis_z * z
    by_versine = 0.5 * (along_x * x + along_y * y + along_z * z) - squared * trace
    common = 2 * (sine_slope * by_sine + versine_slope * by_versine - versine * trace)
    v_x = sine * axis_x + versine * along_x + common * x
    v_y = sine * axis_y + versine * along_y + common * y
    v_z = sine * axis_z + versine * along_z + common * z
    store3(v_rows, 6 * view, v_x, v_y, v_z, exists)


class _CorrectPoses(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, initial: Tensor, table: Tensor, view_ids: Tensor) -> Tensor:
        viewmats = torch.empty_like(initial)
        n = len(view_ids)
        _correct_poses[cdiv(n, _LANES),](initial, table, view_ids, viewmats, n, _LANES)
        ctx.save_for_backward(initial, table, view_ids)
        return viewmats

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, v_viewmats: Tensor) -> tuple[Tensor | None, ...]:
        initial, table, view_ids = ctx.saved_tensors
        n = len(view_ids)
        v_rows = table.new_empty((n, 6))
        v_viewmats = v_viewmats.contiguous()
        _correct_poses_backward[cdiv(n, _LANES),](initial, table, view_ids, v_viewmats, v_rows, n, _LANES)
        return None, torch.zeros_like(table).index_add_(0, view_ids, v_rows), None


def corrected(initial: Tensor, table: Tensor, view_ids: Tensor) -> Tensor:
    """Do what `geometry.poses.corrected` does for rows of a table [V, 6], float32, whose turns are less than half."""
    return _CorrectPoses.apply(initial.contiguous(), table.contiguous(), view_ids)  # type: ignore[return-value]


@triton.jit(do_not_specialize=["rows"])
def _move_rows(
    table, gradient, mean, square, count, moved, units, rate, nonfinite_flag, rows, beta1, beta2, log_beta1, log_beta2,
    eps, MAX: tl.constexpr, ROWS: tl.constexpr,
):  # fmt: skip
    """Update those of ROWS rows of six numbers that are moved; note a gradient that must be left out."""
    row = tl.program_id(0) * ROWS + tl.arange(0, ROWS)
    moves = tl.load(moved + row, row < rows, 0) != 0
    done = tl.load(count + row, moves, 0.0) + 1
    tl.store(count + row, done, moves)
    step = tl.load(rate)
    # 1 − β^t, which would cancel for the first updates: −expm1, by its series where it is small.
    mean_weight = _one_minus_exp(done * log_beta1)[:, None]
    square_weight = _one_minus_exp(done * log_beta2)[:, None]
    column = tl.arange(0, 8)[None, :]
    i = 6 * row[:, None] + column
    exists = (row < rows)[:, None] & (column < 6)
    changes = exists & moves[:, None]
    g = tl.load(gradient + i, exists, 0.0)
    usable = tl.abs(g) < MAX  # NaN compares as false
    tl.store(nonfinite_flag + i * 0, float("nan"), exists & ~usable)
    g = tl.where(usable, g, 0.0)
    m = tl.load(mean + i, changes, 0.0)
    m += (1 - beta1) * (g - m)
    v = tl.load(square + i, changes, 0.0)
    v += (1 - beta2) * (g * g - v)
    tl.store(mean + i, m, changes)
    tl.store(square + i, v, changes)
    change = step * tl.load(units + i, changes, 0.0) * (m / mean_weight) / (tl.sqrt(v / square_weight) + eps)
    tl.store(table + i, tl.load(table + i, changes, 0.0) - change, changes)


@triton.jit
def _one_minus_exp(x):
    """Return 1 − exp(x) of x ≤ 0 without cancellation."""
    series = -x * (1 + x / 2 * (1 + x / 3 * (1 + x / 4 * (1 + x / 5 * (1 + x / 6)))))
    return tl.where(x > -0.25, series, 1 - tl.exp(x))


def move_rows(
    table: Tensor, gradient: Tensor, state: dict[str, Tensor], moved: Tensor, units: Tensor, rate: Tensor,
    betas: tuple[float, float], log_betas: tuple[float, float], eps: float, nonfinite_flag: Tensor,
    max_gradient: float,
) -> None:  # fmt: skip
    """Do what `training.step.row_adam.move_rows` does for a table [V, 6]; `rate` is on the device. [1]"""
    rows = len(table)
    _move_rows[cdiv(rows, _ROWS),](
        table, gradient.contiguous(), state["exp_avg"], state["exp_avg_sq"], state["step"],
        moved.view(torch.uint8), units, rate, nonfinite_flag, rows, *betas, *log_betas, eps, max_gradient, _ROWS,
    )  # fmt: skip
