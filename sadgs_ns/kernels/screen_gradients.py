"""`method.screen_gradients.accumulate_gradients` in one kernel."""

from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

from sadgs_ns.kernels import cdiv
from sadgs_ns.kernels.shared import drawn

_LANES = 256  # Gaussians that one program handles


@triton.jit
def _norm(gradient, at, seen, scale_x, scale_y):
    """Length of a gradient [LANES], 0 where it is NaN."""
    x = scale_x * tl.load(gradient + at, seen, 0.0)
    y = scale_y * tl.load(gradient + at + 1, seen, 0.0)
    length = tl.sqrt(x * x + y * y)
    return tl.where(length == length, length, 0.0)


# Lengths are not specialised: Triton would compile another kernel when densification makes one that 16 divides.
@triton.jit(do_not_specialize=["n", "num_views", "view", "row", "absolute_view", "absolute_row"])
def _accumulate_gradients(
    radii, gradient, absolute, grad2d, absgrad2d, grad_count, n, num_views, view, row, absolute_view, absolute_row,
    scale_x, scale_y, PER_GAUSSIAN: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """Add one backward pass; rows of the gradients lie `row` numbers apart, and views `view` numbers."""
    g = tl.program_id(0).to(tl.int64) * LANES + tl.arange(0, LANES)
    total = tl.zeros([LANES], tl.float32)
    absolute_total = total
    count = total
    for i in range(num_views):
        seen = drawn(radii, i * tl.cast(n, tl.int64) + g, g < n, PER_GAUSSIAN)
        total += _norm(gradient, i * tl.cast(view, tl.int64) + g * row, seen, scale_x, scale_y)
        absolute_at = i * tl.cast(absolute_view, tl.int64) + g * absolute_row
        absolute_total += _norm(absolute, absolute_at, seen, scale_x, scale_y)
        count += seen
    changed = count > 0
    tl.store(grad2d + g, tl.load(grad2d + g, changed, 0.0) + total, changed)
    tl.store(absgrad2d + g, tl.load(absgrad2d + g, changed, 0.0) + absolute_total, changed)
    tl.store(grad_count + g, tl.load(grad_count + g, changed, 0.0) + count, changed)


def accumulate_gradients(
    sums: tuple[Tensor, Tensor, Tensor], radii: Tensor, gradient: Tensor, absolute: Tensor, scales: tuple[float, float]
) -> None:
    """Do what `method.screen_gradients.accumulate_gradients` does; a gradient longer than 1e19 is infinite.

    `sums` are grad2d, absgrad2d and grad_count, contiguous float32. The gradient of the centres and its absolute sum
    over the pixels, float32 [C, N, 2], may be parts of the rows of larger tensors; `scales` multiply their x and y.
    """
    num_views, n = radii.shape[:2]
    # The kernel reads parts of rows where they lie, but expects x and y side by side: other layouts are copied.
    gradient, absolute = (value if value.stride(2) == 1 else value.contiguous() for value in (gradient, absolute))
    _accumulate_gradients[cdiv(n, _LANES),](
        radii.contiguous(), gradient, absolute, *sums, n, num_views, gradient.stride(0), gradient.stride(1),
        absolute.stride(0), absolute.stride(1), *scales, radii.dim() - 1, _LANES,
    )  # fmt: skip
