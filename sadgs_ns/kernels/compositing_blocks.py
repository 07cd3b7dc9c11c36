"""What the two passes of compositing share: the size of a tile, and how a warp holds Gaussians and pixels.

A block is [Gaussians, pixels]. With one warp a thread holds all Gaussians of its two pixels.
"""

# pyright: reportArgumentType=false, reportCallIssue=false, reportIndexIssue=false, reportGeneralTypeIssues=false
# (Triton's functions are not in its types.)

from __future__ import annotations

import triton
import triton.language as tl

TILE_SIZE = 8
"""px. Each lane of the one warp that a tile gets has two pixels."""


@triton.jit
def row(values, ROW: tl.constexpr):
    """Return one row of a block. Adding −0.0 changes nothing, so that the compiler removes the sum."""
    rows = tl.arange(0, values.shape[0])[:, None]
    return tl.sum(tl.where(rows == ROW, values, -0.0), axis=0)


if isinstance(row, triton.JITFunction):

    @triton.jit
    def reciprocal(value):
        """Return 1 / value in one instruction; Triton's division spends four more on denormals."""
        return tl.inline_asm_elementwise(
            "rcp.approx.ftz.f32 $0, $1;", "=r,r", [value], tl.float32, is_pure=True, pack=1
        )  # fmt: skip
else:  # Triton's interpreter, which knows no PTX

    @triton.jit
    def reciprocal(value):
        return 1 / value


@triton.jit
def split4(values):
    """Return the columns of a block [N, 4]."""
    even, odd = tl.split(tl.reshape(values, [values.shape[0], 2, 2]))
    c0, c2 = tl.split(even)
    c1, c3 = tl.split(odd)
    return c0, c1, c2, c3


@triton.jit
def load_gaussians(means2d, conics, colors, opacities, g):
    """Load centre and opacity, conic, and colour of the Gaussians with indices g [N, 1] into three blocks [N, 4].

    Triton spreads a block over the threads if it has at least as many values; of a smaller one every thread would load
    everything.
    """
    k = tl.arange(0, 4)[None, :]
    centres = tl.load(tl.where(k < 2, means2d + 2 * g + k, opacities + g))
    k = tl.minimum(k, 2)
    rgb = tl.load(colors + 3 * g + k)
    # A colour that is not finite makes the pixels that see it NaN. Elsewhere its weight is 0, but 0 · NaN would reach
    # the gradients of the Gaussians in front of it: here it counts as 0.
    return centres, tl.load(conics + 3 * g + k), tl.where(tl.abs(rgb) < float("inf"), rgb, 0.0)
