"""`render.activations.activate` in one launch forward and one backward, where torch takes five and six."""

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from sadgs_ns.kernels import cdiv

_LANES = 1024  # Gaussians that one program handles


@triton.jit(do_not_specialize=["n"])
def _activate(log_scales, logits, scales, opacities, sums, n, penalty, LANES: tl.constexpr):
    """Write exp of the scales and sigmoid of the logits, and sum the latter times the penalty in parts."""
    program = tl.program_id(0).to(tl.int64)
    lane = tl.arange(0, LANES)
    size = tl.cast(n, tl.int64)
    for k in tl.static_range(3):
        i = (3 * program + k) * LANES + lane
        tl.store(scales + i, tl.exp(tl.load(log_scales + i, i < 3 * size, 0.0)), i < 3 * size)
    g = program * LANES + lane
    opacity = 1 / (1 + tl.exp(-tl.load(logits + g, g < size, 0.0)))
    tl.store(opacities + g, opacity, g < size)
    tl.store(sums + program, penalty * tl.sum(tl.where(g < size, opacity, 0.0)))


@triton.jit(do_not_specialize=["n", "row"], do_not_specialize_on_alignment=["v_scales", "v_opacities", "v_penalty"])
def _activate_backward(
    scales, opacities, v_scales, v_opacities, v_penalty, v_log_scales, v_logits, n, row, penalty,
    PENALTY: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """Write the gradients by the parameters; those by the opacities lie `row` numbers apart."""
    program = tl.program_id(0).to(tl.int64)
    lane = tl.arange(0, LANES)
    size = tl.cast(n, tl.int64)
    for k in tl.static_range(3):
        i = (3 * program + k) * LANES + lane
        exists = i < 3 * size
        tl.store(v_log_scales + i, tl.load(v_scales + i, exists, 0.0) * tl.load(scales + i, exists, 0.0), exists)
    g = program * LANES + lane
    opacity = tl.load(opacities + g, g < size, 0.0)
    v = tl.load(v_opacities + g * row, g < size, 0.0)
    if PENALTY:
        v += penalty * tl.load(v_penalty)
    tl.store(v_logits + g, v * (1 - opacity) * opacity, g < size)


class _Activate(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, log_scales: Tensor, logits: Tensor, weight: float) -> tuple[Tensor, Tensor, Tensor]:
        n = len(logits)
        scales = torch.empty_like(log_scales)
        opacities = logits.new_empty(n)
        sums = logits.new_empty(cdiv(n, _LANES))
        _activate[len(sums),](log_scales, logits, scales, opacities, sums, n, weight, _LANES)
        ctx.save_for_backward(scales, opacities)
        ctx.weight = weight
        ctx.set_materialize_grads(False)
        return scales, opacities, sums

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(
        ctx: Any, v_scales: Tensor | None, v_opacities: Tensor | None, v_sums: Tensor | None
    ) -> tuple[Tensor, Tensor, None]:
        scales, opacities = ctx.saved_tensors
        n = len(opacities)
        v_scales = torch.zeros_like(scales) if v_scales is None else v_scales.contiguous()
        v_opacities = torch.zeros_like(opacities) if v_opacities is None else v_opacities
        v_log_scales = torch.empty_like(scales)
        v_logits = opacities.new_empty((n, 1))
        # The partial sums all have the gradient of their sum, so the kernel reads the first one's.
        _activate_backward[cdiv(n, _LANES),](
            scales, opacities, v_scales, v_opacities, opacities if v_sums is None else v_sums, v_log_scales, v_logits,
            n, v_opacities.stride(0), ctx.weight, v_sums is not None, _LANES,
        )  # fmt: skip
        return v_log_scales, v_logits, None


def activate(log_scales: Tensor, logits: Tensor, penalty: float) -> tuple[Tensor, Tensor, Tensor | None]:
    """Do what `render.activations.activate` does, for N > 0 in float32."""
    scales, opacities, sums = _Activate.apply(log_scales.contiguous(), logits.contiguous(), penalty / len(logits))  # type: ignore[misc]
    return scales, opacities, sums if penalty > 0 else None
