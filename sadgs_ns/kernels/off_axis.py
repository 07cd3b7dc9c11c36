"""`render.off_axis.cull_off_axis` in one kernel."""

# pyright: reportArgumentType=false, reportCallIssue=false, reportGeneralTypeIssues=false, reportIndexIssue=false
# (Triton's launch syntax, kernel[grid](...), is not in its types.)

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

_LANES = 256
"""Gaussians that one program handles."""


@triton.jit(do_not_specialize=["n"])
def _cull(
    radii, means2d, culled, n, half_width, half_height, reach_x, reach_y,
    PER_GAUSSIAN: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """Copy the radii of Gaussians whose centre is within reach of the image's centre, and write 0 for the others."""
    g = tl.program_id(0).to(tl.int64) * LANES + tl.arange(0, LANES)
    exists = g < n
    x, y = tl.load(means2d + 2 * g, exists, 0.0), tl.load(means2d + 2 * g + 1, exists, 0.0)
    near = (tl.abs(x - half_width) < reach_x) & (tl.abs(y - half_height) < reach_y)
    for i in tl.static_range(PER_GAUSSIAN):
        at = PER_GAUSSIAN * g + i
        tl.store(culled + at, tl.where(near, tl.load(radii + at, exists, 0), 0), exists)


def cull_off_axis(radii: Tensor, means2d: Tensor, width: int, height: int, max_off_axis: float) -> Tensor:
    """Do what `render.off_axis.cull_off_axis` does, for a `max_off_axis` above 0.

    Args:
        radii: px, int32 [C, N] of gsplat 1.4 or [C, N, 2] of 1.5.
        means2d: Projected centres in px, float32. [C, N, 2]
        width: px.
        height: px.
        max_off_axis: Largest distance from the image's centre, in halves of its width and height along x and y.

    Returns:
        Radii of the same shape, 0 where the centre is further, or not finite.
    """
    culled = torch.empty_like(radii, memory_format=torch.contiguous_format)
    n = means2d.shape[0] * means2d.shape[1]
    _cull[triton.cdiv(n, _LANES),](
        radii.contiguous(), means2d.detach().contiguous(), culled, n, width / 2, height / 2,
        max_off_axis * width / 2, max_off_axis * height / 2, radii.dim() - 1, _LANES,
    )  # fmt: skip
    return culled
