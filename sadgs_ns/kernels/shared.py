"""Functions that several kernels call, or their launches."""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

TINY = tl.constexpr(1.1754943508222875e-38)  # The smallest normal float32, whose logarithm is finite


@triton.jit
def drawn(radii, at, exists, PER_GAUSSIAN: tl.constexpr):
    """Return whether the Gaussian at index `at` in C · N was drawn, by one radius (gsplat 1.4) or two (gsplat 1.5)."""
    radius = tl.load(radii + PER_GAUSSIAN * at, exists, 0)
    if PER_GAUSSIAN == 2:
        radius = tl.minimum(radius, tl.load(radii + 2 * at + 1, exists, 0))
    return exists & (radius > 0)


@triton.jit
def load3(values, at, exists, step=1):
    """Load three numbers that lie `step` apart, 0 where they do not exist."""
    first = tl.load(values + at, exists, 0.0)
    return first, tl.load(values + at + step, exists, 0.0), tl.load(values + at + 2 * step, exists, 0.0)


@triton.jit
def store3(values, at, x, y, z, exists, step=1):
    """Store three numbers `step` apart."""
    tl.store(values + at, x, exists)
    tl.store(values + at + step, y, exists)
    tl.store(values + at + 2 * step, z, exists)


if isinstance(store3, triton.JITFunction):

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
def load_viewmat(viewmats, view):
    """Return the upper three rows of a view's matrix. Each has three entries of the rotation, then the shift."""
    at = viewmats + 16 * view
    return (
        tl.load(at), tl.load(at + 1), tl.load(at + 2), tl.load(at + 3),
        tl.load(at + 4), tl.load(at + 5), tl.load(at + 6), tl.load(at + 7),
        tl.load(at + 8), tl.load(at + 9), tl.load(at + 10), tl.load(at + 11),
    )  # fmt: skip


@triton.jit
def load_intrinsics(Ks, view):
    """Return fx, fy, cx and cy of a view, in px."""
    at = Ks + 9 * view
    return tl.load(at), tl.load(at + 4), tl.load(at + 2), tl.load(at + 5)


@triton.jit
def rotation(w, x, y, z):
    """Return the nine entries, row by row, of the rotation that a unit quaternion stands for."""
    return (
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    )  # fmt: skip


@triton.jit
def unit_quaternion(quats, at, exists):
    """Load the quaternion at index `at` in N, and return it with a length of 1, and one over its length."""
    w = tl.load(quats + 4 * at, exists, 1.0)
    x, y, z = load3(quats, 4 * at + 1, exists)
    inverse_norm = 1 / tl.sqrt(w * w + x * x + y * y + z * z)
    return w * inverse_norm, x * inverse_norm, y * inverse_norm, z * inverse_norm, inverse_norm


@triton.jit
def clamped(ratio, focal, centre, size):
    """Clamp a slope x / z or y / z, for the Jacobian, to those at most 0.3 half images beyond the image's border."""
    margin = 0.15 * size / focal
    return tl.minimum(tl.maximum(ratio, -(centre / focal + margin)), (size - centre) / focal + margin)


@triton.jit
def projection_rows(slope_x, slope_y, jx, jy, w00, w01, w02, w10, w11, w12, w20, w21, w22):
    """Return the entries of J W, row by row: W is a camera's rotation, and J [2, 3] the Jacobian of the projection.

    `jx` and `jy` are the focal lengths over the depth. The slopes are x / z and y / z of the point at which J is taken.
    """
    return (
        jx * (w00 - slope_x * w20), jx * (w01 - slope_x * w21), jx * (w02 - slope_x * w22),
        jy * (w10 - slope_y * w20), jy * (w11 - slope_y * w21), jy * (w12 - slope_y * w22),
    )  # fmt: skip


def equally_spaced_rows(gradient: Tensor | None, like: Tensor) -> tuple[Tensor, int]:
    """Return a gradient [C, N, D] whose rows are equally far apart, and how many numbers; zeros where there is none.

    Compositing's gradients, which are parts of rows, are read where they lie.
    """
    if gradient is None:
        gradient = torch.zeros_like(like)
    row = gradient.stride(1)
    if gradient.stride() != (gradient.shape[1] * row, row, 1):
        gradient = gradient.contiguous()
        row = gradient.shape[2]
    return gradient, row
