"""Colours of Gaussians from spherical harmonics, instead of gsplat's `spherical_harmonics`.

gsplat takes all coefficients in one tensor, once per view, while the parameters are two tensors, which the views share.
Here nothing is concatenated or expanded, and the gradients arrive summed over the views; those by the cameras are sums
over blocks of Gaussians, which torch adds up.

Three threads have a Gaussian's three channels, a fourth does nothing: so threads beside each other read numbers beside
each other. A program goes through the views with the coefficients and the sums of their gradients in registers.
"""

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from sadgs_ns.kernels import cdiv
from sadgs_ns.kernels.shared import drawn, equally_spaced_rows, load3, store3

MAX_DEGREE = 3  # Highest degree that the kernels know
_LANES = 32  # Gaussians of one program, where each has four threads


@triton.jit
def _minus_centre(viewmat, column):
    """A coordinate of Rᵀ t, which is minus the camera's centre."""
    x = tl.load(viewmat + column) * tl.load(viewmat + 3)
    y = tl.load(viewmat + 4 + column) * tl.load(viewmat + 7)
    return x + y + tl.load(viewmat + 8 + column) * tl.load(viewmat + 11)


@triton.jit
def _direction(means, viewmats, view, g, exists):
    """Unit vector from the camera to each Gaussian, and the inverse of their distance."""
    viewmat = viewmats + 16 * view
    x, y, z = load3(means, 3 * g, exists)
    x = x + _minus_centre(viewmat, 0)
    y = y + _minus_centre(viewmat, 1)
    z = z + _minus_centre(viewmat, 2)
    inverse = 1 / tl.maximum(tl.sqrt(x * x + y * y + z * z), 1e-30)
    return x * inverse, y * inverse, z * inverse, inverse


@triton.jit
def _basis(x, y, z):
    """Harmonics 1 … 15 of a unit vector, as 3DGS orders and signs them."""
    planar = x * x - y * y
    mixed = 2 * x * y
    ring = -2.285228997322329 * z * z + 0.4570457994644658
    return (
        -0.48860251190292 * y, 0.48860251190292 * z, -0.48860251190292 * x,
        0.5462742152960395 * mixed, -1.092548430592079 * y * z, 0.9461746957575601 * z * z - 0.3153915652525201,
        -1.092548430592079 * x * z, 0.5462742152960395 * planar,
        -0.5900435899266435 * (x * mixed + y * planar), 1.445305721320277 * z * mixed, ring * y,
        z * (1.865881662950577 * z * z - 1.119528997770346), ring * x, 1.445305721320277 * z * planar,
        -0.5900435899266435 * (x * planar - y * mixed),
    )  # fmt: skip


@triton.jit
def _slopes(x, y, z):
    """Derivatives of the polynomials in `_basis` by x, by y and by z."""
    zero = x * 0
    planar = x * x - y * y
    mixed = 2 * x * y
    ring = -2.285228997322329 * z * z + 0.4570457994644658
    by_x = (
        zero, zero, zero - 0.48860251190292,
        1.092548430592079 * y, zero, zero, -1.092548430592079 * z, 1.092548430592079 * x,
        -1.7701307697799304 * mixed, 2.890611442640554 * y * z, zero, zero, ring, 2.890611442640554 * x * z,
        -1.7701307697799304 * planar,
    )  # fmt: skip
    by_y = (
        zero - 0.48860251190292, zero, zero,
        1.092548430592079 * x, -1.092548430592079 * z, zero, zero, -1.092548430592079 * y,
        -1.7701307697799304 * planar, 2.890611442640554 * x * z, ring, zero, zero, -2.890611442640554 * y * z,
        1.7701307697799304 * mixed,
    )  # fmt: skip
    by_z = (
        zero, zero + 0.48860251190292, zero,
        zero, -1.092548430592079 * y, 1.8923493915151202 * z, -1.092548430592079 * x, zero,
        zero, 1.445305721320277 * mixed, -4.570457994644658 * z * y, 5.597644988851731 * z * z - 1.119528997770346,
        -4.570457994644658 * z * x, 1.445305721320277 * planar, zero,
    )  # fmt: skip
    return by_x, by_y, by_z


@triton.jit
def _threads(program, LANES: tl.constexpr):
    """Return the index of each thread's Gaussian, and its channel. [4 · LANES] each

    With blocks [LANES, 4] Triton would lay loads out in several ways, and move what they load from thread to thread.
    """
    thread = tl.arange(0, 4 * LANES)
    return program * LANES + thread // 4, thread % 4


@triton.jit
def _over_channels(values):
    """Sum over the threads of each Gaussian, and return the sum in each of them."""
    by_channel = tl.reshape(values, [values.shape[0] // 4, 4])
    sums = tl.sum(by_channel, 1)[:, None] + tl.zeros_like(by_channel)
    return tl.reshape(sums, [values.shape[0]])


@triton.jit
def _coefficients(rest, radii, at, mine, g, n, num_views, used, PER_GAUSSIAN: tl.constexpr):
    """Load the coefficients 1 … 15 of the Gaussians that a view drew, from index `at` on; 0 stands for others."""
    visible = mine & (num_views < 0)
    for view in range(num_views):
        visible = visible | drawn(radii, view * n + g, mine, PER_GAUSSIAN)
    values = ()
    for k in tl.static_range(15):
        value = tl.load(rest + at + 3 * k, visible & (k < used), 0.0).to(tl.float32)
        values = values + (value,)  # noqa: RUF005 (Triton knows no starred expressions)
    return values


@triton.jit(do_not_specialize=["n", "num_views", "used", "stride"])
def _forward(
    means, viewmats, first, rest, radii, colors, n, num_views, used, stride,
    PER_GAUSSIAN: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """Colours of LANES Gaussians in all views; rows of `rest` lie `stride` numbers apart."""
    g, channel = _threads(tl.program_id(0), LANES)
    mine = (g < n) & (channel < 3)
    at_rest = g.to(tl.int64) * stride + channel  # in 32 bits, 45 g would overflow from 47.7 million Gaussians
    coefficients = _coefficients(rest, radii, at_rest, mine, g, n, num_views, used, PER_GAUSSIAN)
    middle = 0.2820947917738781 * tl.load(first + 3 * g + channel, mine, 0.0) + 0.5
    for view in range(num_views):
        at = view * n + g
        exists = drawn(radii, at, mine, PER_GAUSSIAN)
        x, y, z, _ = _direction(means, viewmats, view, g, exists)
        basis = _basis(x, y, z)
        color = middle
        for k in tl.static_range(15):
            color = color + basis[k] * coefficients[k]
        # A broken coefficient must show in the image, where it is found; a maximum that drops NaN would paint it black.
        color = tl.maximum(color, 0.0, tl.PropagateNan.ALL)
        tl.store(colors + 3 * at + channel, tl.where(exists, color, 0.5), mine)


# The colours' gradients may be parts of rows that begin at no multiple of 16 bytes: Triton would compile a new kernel.
@triton.jit(do_not_specialize=["n", "num_views", "used", "stride", "row"], do_not_specialize_on_alignment=["v_colors"])
def _backward(
    means, viewmats, rest, radii, colors, v_colors, v_means, v_first, v_rest, v_origins,
    n, num_views, used, stride, row,
    POSES: tl.constexpr, PER_GAUSSIAN: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """Write the gradients, summed over the views; rows of `v_colors` lie `row` numbers apart.

    With POSES, also write the gradients by each view's Rᵀ t, which is minus the camera's centre, summed over this
    program's Gaussians. [C, programs, 3]
    """
    g, channel = _threads(tl.program_id(0), LANES)
    mine = (g < n) & (channel < 3)
    at_rest = g.to(tl.int64) * stride + channel  # in 64 bits as forward
    coefficients = _coefficients(rest, radii, at_rest, mine, g, n, num_views, used, PER_GAUSSIAN)
    zero = tl.zeros([4 * LANES], tl.float32)
    v_sum = zero
    v_x = zero
    v_y = zero
    v_z = zero
    sums = (zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero, zero)
    for view in range(num_views):
        at = view * n + g
        seen = drawn(radii, at, mine, PER_GAUSSIAN)
        v = tl.load(v_colors + at.to(tl.int64) * row + channel, seen, 0.0)
        # A colour that was clamped to 0 passes no gradient on.
        v = tl.where(tl.load(colors + 3 * at + channel, seen, 0.0) > 0, v, 0.0)
        x, y, z, inverse = _direction(means, viewmats, view, g, seen)
        basis = _basis(x, y, z)
        slope_x, slope_y, slope_z = _slopes(x, y, z)
        v_sum += v
        dx = zero
        dy = zero
        dz = zero
        added = ()
        for k in tl.static_range(15):
            added = added + (sums[k] + basis[k] * v,)  # noqa: RUF005
            shade = v * coefficients[k]
            dx += slope_x[k] * shade
            dy += slope_y[k] * shade
            dz += slope_z[k] * shade
        sums = added
        # What follows is linear, so that the channels are added after the views.
        along = dx * x + dy * y + dz * z
        by_x = (dx - along * x) * inverse
        by_y = (dy - along * y) * inverse
        by_z = (dz - along * z) * inverse
        v_x += by_x
        v_y += by_y
        v_z += by_z
        if POSES:
            part = v_origins + 3 * (tl.cast(view, tl.int64) * tl.num_programs(0) + tl.program_id(0))
            store3(part, 0, tl.sum(by_x), tl.sum(by_y), tl.sum(by_z), True)
    tl.store(v_first + 3 * g + channel, 0.2820947917738781 * v_sum, mine)
    for k in tl.static_range(15):
        tl.store(v_rest + at_rest + 3 * k, tl.where(k < used, sums[k], 0.0), mine & (3 * k < stride))
    v_mean = tl.where(channel == 0, _over_channels(v_x), _over_channels(v_y))
    v_mean = tl.where(channel == 2, _over_channels(v_z), v_mean)
    tl.store(v_means + 3 * g + channel, v_mean, mine)


class _Colors(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, means: Tensor, first: Tensor, rest: Tensor, viewmats: Tensor, radii: Tensor, used: int
    ) -> Tensor:
        num_views, n = radii.shape[:2]
        colors = means.new_empty((num_views, n, 3))
        _forward[cdiv(n, _LANES),](
            means, viewmats, first, rest, radii, colors,
            n, num_views, used, rest.shape[1] * 3, radii.dim() - 1, _LANES,
        )  # fmt: skip
        ctx.save_for_backward(means, rest, viewmats, radii, colors)
        ctx.used = used
        return colors

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, v_colors: Tensor) -> tuple[Tensor | None, ...]:
        means, rest, viewmats, radii, colors = ctx.saved_tensors
        num_views, n = radii.shape[:2]
        v_means = torch.empty_like(means)
        v_first = torch.empty_like(means)
        if rest.shape[1] < (MAX_DEGREE + 1) ** 2:
            v_rest = torch.empty_like(rest)
        else:  # The kernel does not write beyond MAX_DEGREE, where no colour depends on the coefficients.
            v_rest = torch.zeros_like(rest)
        v_colors, row = equally_spaced_rows(v_colors, colors)
        programs = cdiv(n, _LANES)
        moves_cameras = ctx.needs_input_grad[3]
        v_origins = means  # Without POSES the kernel ignores this argument, so any tensor will do.
        if moves_cameras:
            v_origins = means.new_empty((num_views, programs, 3))
        _backward[programs,](
            means, viewmats, rest, radii, colors, v_colors, v_means, v_first, v_rest, v_origins,
            n, num_views, ctx.used, rest.shape[1] * 3, row, moves_cameras, radii.dim() - 1, _LANES,
        )  # fmt: skip
        v_viewmats = None
        if moves_cameras:
            v_viewmats = _by_matrices(viewmats, v_origins.sum(dim=1))
        return v_means, v_first, v_rest, v_viewmats, None, None


def _by_matrices(viewmats: Tensor, v_origins: Tensor) -> Tensor:
    """Return gradients by matrices (R | t) [C, 4, 4], given those by Rᵀ t, which is minus the centre [C, 3]."""
    by_rotation = viewmats[:, :3, 3:] * v_origins[:, None]  # [C, 3, 3]
    by_translation = (viewmats[:, :3, :3] * v_origins[:, None]).sum(dim=2, keepdim=True)  # [C, 3, 1]
    return torch.nn.functional.pad(torch.cat([by_rotation, by_translation], dim=2), (0, 0, 0, 1))


def colors_from_harmonics(
    degree: int, means: Tensor, first: Tensor, rest: Tensor, viewmats: Tensor, radii: Tensor
) -> Tensor:
    """Colours that 3DGS gives Gaussians seen from cameras: max(Σ_k Y_k(direction) · coefficient_k + 0.5, 0). [C, N, 3]

    `first` and `rest` are the pair of `render.types.Gaussians.colors`, float32, with coefficients at least up to
    `degree` ≤ MAX_DEGREE. Where a radius is not positive, the colour means nothing.
    """
    tensors = (value.contiguous() for value in (means, first, rest, viewmats, radii))
    return _Colors.apply(*tensors, (degree + 1) ** 2 - 1)  # type: ignore[return-value]
