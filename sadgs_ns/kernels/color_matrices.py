"""`method.color_matrices.correct_colors` in one kernel forward and one backward.

Matrix products of three columns are slow, above all their derivative by the matrices, which is a sum over all pixels.
"""

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from sadgs_ns.kernels import cdiv
from sadgs_ns.kernels.limits import check_pixels
from sadgs_ns.kernels.shared import load3, store3

_LANES = 1024  # Pixels that one program handles


@triton.jit(do_not_specialize=["n"])
def _correct(render, alpha, matrices, corrected, n, LANES: tl.constexpr):
    """Write M c + α b of the n pixels of one view."""
    view = tl.program_id(1).to(tl.int64)
    i = tl.program_id(0) * LANES + tl.arange(0, LANES)
    exists = i < n
    pixel = view * n + i
    opacity = tl.load(alpha + pixel, exists, 0.0)
    r, g, b = load3(render, 3 * pixel, exists)
    for k in tl.static_range(3):
        row = matrices + 12 * view + 4 * k
        value = tl.load(row) * r + tl.load(row + 1) * g + tl.load(row + 2) * b + tl.load(row + 3) * opacity
        tl.store(corrected + 3 * pixel + k, value, exists)


@triton.jit(do_not_specialize=["n"])
def _correct_backward(
    render, alpha, matrices, v_corrected, v_render, v_alpha, sums, n, LEARNED: tl.constexpr, LANES: tl.constexpr
):
    """Write the gradients by colours and opacities of one view's pixels, and sum those by its matrix in parts.

    Without LEARNED, the matrix has no gradient, and neither render, alpha nor sums are read or written.
    """
    view = tl.program_id(1).to(tl.int64)
    i = tl.program_id(0) * LANES + tl.arange(0, LANES)
    exists = i < n
    pixel = view * n + i
    if LEARNED:
        opacity = tl.load(alpha + pixel, exists, 0.0)
        r, g, b = load3(render, 3 * pixel, exists)
    v_r = tl.zeros([LANES], tl.float32)
    v_g = v_r
    v_b = v_r
    v_opacity = v_r
    part = sums + 12 * (view * tl.num_programs(0) + tl.program_id(0))
    for k in tl.static_range(3):
        row = matrices + 12 * view + 4 * k
        v = tl.load(v_corrected + 3 * pixel + k, exists, 0.0)
        v_r += v * tl.load(row)
        v_g += v * tl.load(row + 1)
        v_b += v * tl.load(row + 2)
        v_opacity += v * tl.load(row + 3)
        if LEARNED:
            store3(part, 4 * k, tl.sum(v * r), tl.sum(v * g), tl.sum(v * b), True)
            tl.store(part + 4 * k + 3, tl.sum(v * opacity))
    store3(v_render, 3 * pixel, v_r, v_g, v_b, exists)
    tl.store(v_alpha + pixel, v_opacity, exists)


class _CorrectColors(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, render: Tensor, alpha: Tensor, matrices: Tensor) -> Tensor:
        views, height, width, _ = render.shape
        grid = (cdiv(height * width, _LANES), views)
        corrected = torch.empty_like(render)
        _correct[grid](render, alpha, matrices, corrected, height * width, _LANES)
        ctx.save_for_backward(render, alpha, matrices)
        return corrected

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, v_corrected: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        render, alpha, matrices = ctx.saved_tensors
        views, height, width, _ = render.shape
        grid = (cdiv(height * width, _LANES), views)
        v_render = torch.empty_like(render)
        v_alpha = torch.empty_like(alpha)
        is_learned = ctx.needs_input_grad[2]
        parts = 1
        if is_learned:
            parts = grid[0]
        sums = render.new_empty((views, parts, 3, 4))
        _correct_backward[grid](
            render, alpha, matrices, v_corrected.contiguous(), v_render, v_alpha, sums, height * width, is_learned,
            _LANES,
        )  # fmt: skip
        if not is_learned:
            return v_render, v_alpha, None
        return v_render, v_alpha, sums.sum(dim=1)


def correct_colors(render: Tensor, alpha: Tensor, matrices: Tensor) -> Tensor:
    """Do what `method.color_matrices.correct_colors` does, in float32."""
    check_pixels(*render.shape[:3])
    return _CorrectColors.apply(render.contiguous(), alpha.contiguous(), matrices.contiguous())  # type: ignore[return-value]
