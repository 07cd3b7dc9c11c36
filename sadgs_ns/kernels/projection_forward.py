"""gsplat's forward projection in one launch, so that nothing on the way of our kernels needs gsplat's CUDA code.

The formulas and what is culled are those of gsplat 1.4.0 and 1.5.3; `render.backend_torch` has them in torch. Two sums
differ, which cancel in float32: the determinant of Σ2D and the larger eigenvalue that bounds gsplat 1.4's radius.

Σ2D is P Pᵀ with P = J W R S: the Jacobian [2, 3] of the projection, the camera's rotation, the Gaussian's rotation and
its standard deviations. gsplat computes a c − b², whose terms are nearly equal for a long, thin Gaussian: of one of
1,600 px at 45° it loses a tenth and more. By the formula of Cauchy and Binet the determinant is the sum of the squares
of the three minors [2, 2] of P. Each is a product: R's columns are orthonormal, so that two of them have the third as
their cross product, and the minor of the columns i and j is s_i s_j (n · r_k), where n is the cross product of the rows
of J W. Blur e on the diagonal adds e (a + c) + e². Nothing is subtracted.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from sadgs_ns import gsplat_compat
from sadgs_ns.gsplat_compat import FAR_PLANE, NEAR_PLANE, SCREEN_BLUR
from sadgs_ns.kernels import cdiv
from sadgs_ns.kernels.shared import (
    clamped,
    load3,
    load_intrinsics,
    load_viewmat,
    projection_rows,
    rotation,
    store3,
    unit_quaternion,
)

_LANES = 128  # Gaussians that one program handles
_LARGEST = tl.constexpr(1e9)  # Radius in px that int32 holds
_FAINTEST = tl.constexpr(1 / 255)  # Opacity from which gsplat 1.5 draws
_EXTENT = tl.constexpr(3.33)  # Standard deviations that gsplat 1.5 draws at most


@triton.jit
def _cross(x0, y0, z0, x1, y1, z1):
    return y0 * z1 - z0 * y1, z0 * x1 - x0 * z1, x0 * y1 - y0 * x1


@triton.jit
def _dot(x0, y0, z0, x1, y1, z1):
    return x0 * x1 + y0 * y1 + z0 * z1


# One view's intrinsics may be part of a tensor of several views, which begins at no multiple of 16 bytes.
@triton.jit(
    do_not_specialize=["n", "num_views", "width", "height"],
    do_not_specialize_on_alignment=["Ks"],
)
def _project_forward(
    means, quats, scales, opacities, viewmats, Ks, radii, means2d, depths, conics,
    n, num_views, width, height, near_plane,
    FAR: tl.constexpr, BLUR: tl.constexpr, PER_GAUSSIAN: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """Project LANES Gaussians into each view; for one that is not drawn only its radius is written.

    A Gaussian is drawn only if every comparison holds. None holds for NaN, so all that is drawn is finite.
    """
    g = tl.program_id(0).to(tl.int64) * LANES + tl.arange(0, LANES)
    exists = g < n
    mean_x, mean_y, mean_z = load3(means, 3 * g, exists)
    qw, qx, qy, qz, _ = unit_quaternion(quats, g, exists)
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation(qw, qx, qy, qz)
    s0, s1, s2 = load3(scales, 3 * g, exists)
    extent = _EXTENT
    if PER_GAUSSIAN == 2:  # The distance in standard deviations at which alpha falls below 1/255
        opacity = tl.load(opacities + g, exists, 0.0)
        extent = tl.minimum(tl.sqrt(2 * tl.log(tl.maximum(opacity / _FAINTEST, 1.0))), _EXTENT)
        visible = exists & (opacity >= _FAINTEST)
    else:
        visible = exists

    for i in range(num_views):
        at = i * tl.cast(n, tl.int64) + g
        w00, w01, w02, t0, w10, w11, w12, t1, w20, w21, w22, t2 = load_viewmat(viewmats, i)
        fx, fy, cx, cy = load_intrinsics(Ks, i)
        depth = _dot(w20, w21, w22, mean_x, mean_y, mean_z) + t2
        drawn = visible & (depth >= near_plane) & (depth <= FAR)
        inverse = 1 / tl.where(drawn, depth, 1.0)
        ratio_x = (_dot(w00, w01, w02, mean_x, mean_y, mean_z) + t0) * inverse
        ratio_y = (_dot(w10, w11, w12, mean_x, mean_y, mean_z) + t1) * inverse
        u = fx * ratio_x + cx
        v = fy * ratio_y + cy

        # The rows of J W, and of P = J W R S.
        slope_x = clamped(ratio_x, fx, cx, width)
        slope_y = clamped(ratio_y, fy, cy, height)
        jx = fx * inverse
        jy = fy * inverse
        x0, x1, x2, y0, y1, y2 = projection_rows(slope_x, slope_y, jx, jy, w00, w01, w02, w10, w11, w12, w20, w21, w22)
        p00 = s0 * _dot(x0, x1, x2, r00, r10, r20)
        p10 = s0 * _dot(y0, y1, y2, r00, r10, r20)
        p01 = s1 * _dot(x0, x1, x2, r01, r11, r21)
        p11 = s1 * _dot(y0, y1, y2, r01, r11, r21)
        p02 = s2 * _dot(x0, x1, x2, r02, r12, r22)
        p12 = s2 * _dot(y0, y1, y2, r02, r12, r22)
        a = p00 * p00 + p01 * p01 + p02 * p02
        b = p00 * p10 + p01 * p11 + p02 * p12
        c = p10 * p10 + p11 * p11 + p12 * p12

        # The cross product of the rows of J W, by those of W, which a view's Gaussians share.
        c00, c01, c02 = _cross(w10, w11, w12, w20, w21, w22)
        c10, c11, c12 = _cross(w20, w21, w22, w00, w01, w02)
        c20, c21, c22 = _cross(w00, w01, w02, w10, w11, w12)
        area = jx * jy
        n0 = area * (slope_x * c00 + slope_y * c10 + c20)
        n1 = area * (slope_x * c01 + slope_y * c11 + c21)
        n2 = area * (slope_x * c02 + slope_y * c12 + c22)
        minor_0 = s1 * s2 * _dot(n0, n1, n2, r00, r10, r20)
        minor_1 = s2 * s0 * _dot(n0, n1, n2, r01, r11, r21)
        minor_2 = s0 * s1 * _dot(n0, n1, n2, r02, r12, r22)
        determinant = minor_0 * minor_0 + minor_1 * minor_1 + minor_2 * minor_2 + (BLUR * (a + c) + BLUR * BLUR)
        inverse_determinant = 1 / determinant
        a += BLUR
        c += BLUR

        if PER_GAUSSIAN == 2:
            radius_x = tl.ceil(extent * tl.sqrt(a))
            radius_y = tl.ceil(extent * tl.sqrt(c))
        else:
            half = 0.5 * (a - c)
            longest = 0.5 * (a + c) + tl.sqrt(tl.maximum(half * half + b * b, 0.01))
            radius_x = tl.ceil(3 * tl.sqrt(longest))
            radius_y = radius_x
        drawn = drawn & (determinant < float("inf"))
        drawn = drawn & (u + radius_x > 0) & (u - radius_x < width) & (v + radius_y > 0) & (v - radius_y < height)
        radius_x = tl.where(drawn, tl.minimum(radius_x, _LARGEST), 0.0).to(tl.int32)
        if PER_GAUSSIAN == 2:
            radius_y = tl.where(drawn, tl.minimum(radius_y, _LARGEST), 0.0).to(tl.int32)
            _store2(radii, at, radius_x, radius_y, exists)
        else:
            tl.store(radii + at, radius_x, exists)
        _store2(means2d, at, u, v, drawn)
        tl.store(depths + at, depth, drawn)
        store3(
            conics, 3 * at, c * inverse_determinant, -b * inverse_determinant, a * inverse_determinant, drawn
        )  # fmt: skip


@triton.jit
def _store2(rows, at, x, y, exists):
    """Store rows of two numbers, each with one instruction."""
    tl.store(rows + (2 * at)[:, None] + tl.arange(0, 2)[None, :], tl.join(x, y), exists[:, None])


@torch.no_grad()
def project_forward(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, viewmats: Tensor, Ks: Tensor,
    width: int, height: int, near_plane: float = NEAR_PLANE,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """Do what `gsplat_compat.project` does, without gradients; all tensors are contiguous float32.

    gsplat also draws some Gaussians with values that are not finite: those wider than some billions of px and, in the
    layout of gsplat 1.5, those with an opacity of NaN. Here, as in the torch backend, their radius is 0.

    Returns:
        radii, means2d, depths and conics as `render.types.Projected` has them, with radii as the installed gsplat has
        them. For a Gaussian that is not drawn only its radius is written.
    """
    shape = len(viewmats), len(means)
    if gsplat_compat.RADII_PER_AXIS:
        radii = means.new_empty((*shape, 2), dtype=torch.int32)
    else:
        radii = means.new_empty(shape, dtype=torch.int32)
    means2d = means.new_empty((*shape, 2))
    depths = means.new_empty(shape)
    conics = means.new_empty((*shape, 3))
    _project_forward[cdiv(len(means), _LANES),](
        means, quats, scales, opacities, viewmats, Ks, radii, means2d, depths, conics,
        len(means), len(viewmats), width, height, float(near_plane),  # Triton would take an integer for another type.
        FAR_PLANE, SCREEN_BLUR, radii.dim() - 1, _LANES,
    )  # fmt: skip
    return radii, means2d, depths, conics
