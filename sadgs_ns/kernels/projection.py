"""The projection, differentiable by a backward pass in one launch; `projection_forward` is the forward pass.

gsplat's takes eight: it fills gradients with zeros, copies those that compositing gives it as parts of rows, and adds
with atomic operations. Here each Gaussian's gradients are summed over the views in registers, and what else depends on
the centres is added on the way. Gradients by the cameras are sums over blocks of Gaussians, which torch adds up: they
come out the same each time. The formulas are those of gsplat 1.4.0 and 1.5.3.
"""

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.autograd.function import once_differentiable

from sadgs_ns.gsplat_compat import NEAR_PLANE
from sadgs_ns.kernels import cdiv
from sadgs_ns.kernels.projection_forward import project_forward
from sadgs_ns.kernels.shared import (
    clamped,
    drawn,
    equally_spaced_rows,
    load3,
    load_intrinsics,
    load_viewmat,
    projection_rows,
    rotation,
    store3,
    unit_quaternion,
)

_LANES = 128  # Gaussians that one program handles


@triton.jit
def _symmetric_times(xx, xy, xz, yy, yz, zz, x, y, z):
    return xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z


@triton.jit
def _by_row(ratio, slope, inverse, scale, by_first, by_last):
    """Differentiate the entries `scale` = focal / z and −scale · slope of the Jacobian; `slope` is the clamped x / z.

    Returns:
        The parts of the gradients of x and z that come from those of the entries, `by_first` and `by_last`.
    """
    by_x = tl.where(ratio == slope, -scale * inverse * by_last, 0.0)
    return by_x, scale * inverse * (slope * by_last - by_first) - slope * by_x


@triton.jit
def _store_row(part, seen, by, mean_x, mean_y, mean_z, first, second, third):
    """Sum the gradients by one row of a view's matrix, given `by` that of the centre and the rest of the rotation's."""
    tl.store(part, tl.sum(tl.where(seen, by * mean_x + first, 0.0)))
    tl.store(part + 1, tl.sum(tl.where(seen, by * mean_y + second, 0.0)))
    tl.store(part + 2, tl.sum(tl.where(seen, by * mean_z + third, 0.0)))
    tl.store(part + 3, tl.sum(tl.where(seen, by, 0.0)))


# One view's intrinsics may be part of a tensor of several views, and gradients part of rows. They begin at no multiple
# of 16 bytes, for which Triton would compile another kernel.
@triton.jit(
    do_not_specialize=["n", "num_views", "width", "height", "row2d", "row_conic"],
    do_not_specialize_on_alignment=["Ks", "v_means2d", "v_conics"],
)
def _project_backward(
    means, quats, scales, viewmats, Ks, radii, conics,
    v_means2d, v_conics, v_depths, v_passed, v_means, v_quats, v_scales, v_poses,
    n, num_views, width, height, row2d, row_conic,
    DEPTHS: tl.constexpr, PASSED: tl.constexpr, POSES: tl.constexpr, PER_GAUSSIAN: tl.constexpr, LANES: tl.constexpr,
):  # fmt: skip
    """Write the gradients by centres, quaternions and standard deviations, summed over the views.

    Those by the projected centres and by the conics lie `row2d` and `row_conic` numbers apart. With POSES, also write
    those by the upper three rows of each view's matrix, summed over the Gaussians of this program. [C, programs, 12]
    """
    g = tl.program_id(0).to(tl.int64) * LANES + tl.arange(0, LANES)
    exists = g < n
    mean_x, mean_y, mean_z = load3(means, 3 * g, exists)
    qw, qx, qy, qz, inverse_norm = unit_quaternion(quats, g, exists)
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation(qw, qx, qy, qz)
    sx, sy, sz = load3(scales, 3 * g, exists)
    m00, m01, m02 = r00 * sx, r01 * sy, r02 * sz  # M = R S, and Σ = M Mᵀ
    m10, m11, m12 = r10 * sx, r11 * sy, r12 * sz
    m20, m21, m22 = r20 * sx, r21 * sy, r22 * sz
    xx = m00 * m00 + m01 * m01 + m02 * m02
    xy = m00 * m10 + m01 * m11 + m02 * m12
    xz = m00 * m20 + m01 * m21 + m02 * m22
    yy = m10 * m10 + m11 * m11 + m12 * m12
    yz = m10 * m20 + m11 * m21 + m12 * m22
    zz = m20 * m20 + m21 * m21 + m22 * m22
    v_x = tl.zeros([LANES], tl.float32)
    v_y = v_x
    v_z = v_x
    v_xx = v_x
    v_xy = v_x
    v_xz = v_x
    v_yy = v_x
    v_yz = v_x
    v_zz = v_x
    count = v_x
    for i in range(num_views):
        at = i * tl.cast(n, tl.int64) + g
        seen = drawn(radii, at, exists, PER_GAUSSIAN)
        w00, w01, w02, t0, w10, w11, w12, t1, w20, w21, w22, t2 = load_viewmat(viewmats, i)
        fx, fy, cx, cy = load_intrinsics(Ks, i)
        x = w00 * mean_x + w01 * mean_y + w02 * mean_z + t0
        y = w10 * mean_x + w11 * mean_y + w12 * mean_z + t1
        z = tl.where(seen, w20 * mean_x + w21 * mean_y + w22 * mean_z + t2, 1.0)
        inverse = 1 / z

        # The gradient H of Σ2D, of whose blurred inverse the conic has three entries.
        a, b, c = load3(conics, 3 * at, seen)
        h_a, h_b, h_c = load3(v_conics, at * row_conic, seen)
        h_b = 0.5 * h_b
        top = a * h_a + b * h_b
        right = a * h_b + b * h_c
        left = b * h_a + c * h_b
        bottom = b * h_b + c * h_c
        h00, h01, h11 = -(top * a + right * b), -(top * b + right * c), -(left * b + bottom * c)

        # Σ2D = T Σ Tᵀ with T = J W, where W is the camera's rotation and J the Jacobian [2, 3] of the projection.
        slope_x = clamped(x * inverse, fx, cx, width)
        slope_y = clamped(y * inverse, fy, cy, height)
        jx = fx * inverse
        jy = fy * inverse
        t00, t01, t02, t10, t11, t12 = projection_rows(
            slope_x, slope_y, jx, jy, w00, w01, w02, w10, w11, w12, w20, w21, w22
        )
        k00, k01, k02 = h00 * t00 + h01 * t10, h00 * t01 + h01 * t11, h00 * t02 + h01 * t12  # H T
        k10, k11, k12 = h01 * t00 + h11 * t10, h01 * t01 + h11 * t11, h01 * t02 + h11 * t12
        v_xx += tl.where(seen, t00 * k00 + t10 * k10, 0.0)
        v_xy += tl.where(seen, t00 * k01 + t10 * k11, 0.0)
        v_xz += tl.where(seen, t00 * k02 + t10 * k12, 0.0)
        v_yy += tl.where(seen, t01 * k01 + t11 * k11, 0.0)
        v_yz += tl.where(seen, t01 * k02 + t11 * k12, 0.0)
        v_zz += tl.where(seen, t02 * k02 + t12 * k12, 0.0)

        # The gradient 2 H T Σ Wᵀ of J, of which four entries depend on the centre.
        u00, u01, u02 = _symmetric_times(xx, xy, xz, yy, yz, zz, k00, k01, k02)
        u10, u11, u12 = _symmetric_times(xx, xy, xz, yy, yz, zz, k10, k11, k12)
        by_x, by_z_of_x = _by_row(
            x * inverse, slope_x, inverse, jx,
            2 * (u00 * w00 + u01 * w01 + u02 * w02), 2 * (u00 * w20 + u01 * w21 + u02 * w22),
        )  # fmt: skip
        by_y, by_z_of_y = _by_row(
            y * inverse, slope_y, inverse, jy,
            2 * (u10 * w10 + u11 * w11 + u12 * w12), 2 * (u10 * w20 + u11 * w21 + u12 * w22),
        )  # fmt: skip
        at_row = at * row2d
        v_u = jx * tl.load(v_means2d + at_row, seen, 0.0)
        v_v = jy * tl.load(v_means2d + at_row + 1, seen, 0.0)
        by_x = by_x + v_u
        by_y = by_y + v_v
        by_z = by_z_of_x + by_z_of_y - (x * v_u + y * v_v) * inverse
        if DEPTHS:
            by_z += tl.load(v_depths + at, seen, 0.0)
        v_x += tl.where(seen, w00 * by_x + w10 * by_y + w20 * by_z, 0.0)
        v_y += tl.where(seen, w01 * by_x + w11 * by_y + w21 * by_z, 0.0)
        v_z += tl.where(seen, w02 * by_x + w12 * by_y + w22 * by_z, 0.0)
        count += seen
        if POSES:
            # The rotation turns the centre, and W of T = J W has the gradient Jᵀ 2 H T Σ.
            row_x = 2 * jx
            row_y = 2 * jy
            back_x = row_x * slope_x
            back_y = row_y * slope_y
            part = v_poses + 12 * (i * tl.cast(tl.num_programs(0), tl.int64) + tl.program_id(0))
            _store_row(part, seen, by_x, mean_x, mean_y, mean_z, row_x * u00, row_x * u01, row_x * u02)
            _store_row(part + 4, seen, by_y, mean_x, mean_y, mean_z, row_y * u10, row_y * u11, row_y * u12)
            last_0 = -back_x * u00 - back_y * u10
            last_1 = -back_x * u01 - back_y * u11
            _store_row(part + 8, seen, by_z, mean_x, mean_y, mean_z, last_0, last_1, -back_x * u02 - back_y * u12)

    if PASSED:
        x, y, z = load3(v_passed, 3 * g, exists)
        v_x = v_x + x
        v_y = v_y + y
        v_z = v_z + z
    store3(v_means, 3 * g, v_x, v_y, v_z, exists)
    seen = count > 0  # What no view drew has gradients of 0, whatever its numbers are.
    # v_M = 2 v_Σ M, of which R's gradient is v_M S.
    n00, n10, n20 = _symmetric_times(v_xx, v_xy, v_xz, v_yy, v_yz, v_zz, m00, m10, m20)
    n01, n11, n21 = _symmetric_times(v_xx, v_xy, v_xz, v_yy, v_yz, v_zz, m01, m11, m21)
    n02, n12, n22 = _symmetric_times(v_xx, v_xy, v_xz, v_yy, v_yz, v_zz, m02, m12, m22)
    v_sx = tl.where(seen, 2 * (r00 * n00 + r10 * n10 + r20 * n20), 0.0)
    v_sy = tl.where(seen, 2 * (r01 * n01 + r11 * n11 + r21 * n21), 0.0)
    v_sz = tl.where(seen, 2 * (r02 * n02 + r12 * n12 + r22 * n22), 0.0)
    store3(v_scales, 3 * g, v_sx, v_sy, v_sz, exists)
    # Both factors 2: of v_M and of the rotation's derivatives.
    sx = 4 * sx
    sy = 4 * sy
    sz = 4 * sz
    n00 = n00 * sx
    n10 = n10 * sx
    n20 = n20 * sx
    n01 = n01 * sy
    n11 = n11 * sy
    n21 = n21 * sy
    n02, n12, n22 = n02 * sz, n12 * sz, n22 * sz
    v_qw = qx * (n21 - n12) + qy * (n02 - n20) + qz * (n10 - n01)
    v_qx = qy * (n10 + n01) + qz * (n20 + n02) + qw * (n21 - n12) - 2 * qx * (n11 + n22)
    v_qy = qx * (n10 + n01) + qz * (n21 + n12) + qw * (n02 - n20) - 2 * qy * (n00 + n22)
    v_qz = qx * (n20 + n02) + qy * (n21 + n12) + qw * (n10 - n01) - 2 * qz * (n00 + n11)
    along = v_qw * qw + v_qx * qx + v_qy * qy + v_qz * qz
    tl.store(v_quats + 4 * g, tl.where(seen, (v_qw - along * qw) * inverse_norm, 0.0), exists)
    v_qx = tl.where(seen, (v_qx - along * qx) * inverse_norm, 0.0)
    v_qy = tl.where(seen, (v_qy - along * qy) * inverse_norm, 0.0)
    v_qz = tl.where(seen, (v_qz - along * qz) * inverse_norm, 0.0)
    store3(v_quats, 4 * g + 1, v_qx, v_qy, v_qz, exists)


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, viewmats: Tensor, Ks: Tensor,
        width: int, height: int, near_plane: float,
    ) -> tuple[Tensor | None, ...]:  # fmt: skip
        radii, means2d, depths, conics = project_forward(
            means, quats, scales, opacities, viewmats, Ks, width, height, near_plane
        )
        ctx.mark_non_differentiable(radii)
        ctx.set_materialize_grads(False)  # torch would fill gradients with zeros where nothing depends on an output
        ctx.save_for_backward(means, quats, scales, viewmats, Ks, radii, means2d, conics)
        ctx.size = width, height
        return radii, means2d, depths, conics, means

    @staticmethod
    @once_differentiable
    def backward(  # type: ignore[override]
        ctx: Any, _: None, v_means2d: Tensor | None, v_depths: Tensor | None, v_conics: Tensor | None,
        v_passed: Tensor | None,
    ) -> tuple[Tensor | None, ...]:  # fmt: skip
        means, quats, scales, viewmats, Ks, radii, means2d, conics = ctx.saved_tensors
        v_means = torch.empty_like(means)
        v_quats = torch.empty_like(quats)
        v_scales = torch.empty_like(scales)
        v_means2d, row2d = equally_spaced_rows(v_means2d, means2d)
        v_conics, row_conic = equally_spaced_rows(v_conics, conics)
        # The kernel reads no tensor that stands in for one that is None.
        depths, passed = (conics if value is None else value.contiguous() for value in (v_depths, v_passed))
        n = len(means)
        programs = cdiv(n, _LANES)
        moves_cameras = ctx.needs_input_grad[4]
        sums = conics
        if moves_cameras:
            sums = means.new_empty((len(viewmats), programs, 3, 4))
        _project_backward[programs,](
            means, quats, scales, viewmats, Ks, radii, conics,
            v_means2d, v_conics, depths, passed, v_means, v_quats, v_scales, sums,
            n, len(viewmats), *ctx.size, row2d, row_conic,
            v_depths is not None, v_passed is not None, moves_cameras, radii.dim() - 1, _LANES,
        )  # fmt: skip
        v_viewmats = None
        if moves_cameras:
            v_viewmats = torch.nn.functional.pad(sums.sum(dim=1), (0, 0, 0, 1))
        return v_means, v_quats, v_scales, None, v_viewmats, *[None] * 4


def project(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, viewmats: Tensor, Ks: Tensor,
    width: int, height: int, near_plane: float = NEAR_PLANE,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """Do what `gsplat_compat.project` does, with a backward pass of one kernel.

    Opacities and `Ks` get no gradient.

    Returns:
        The four results of `gsplat_compat.project`, and `means`. The radii may be set to 0 in place until the backward
        pass. Whatever else depends on the centres is to be computed from the returned `means`: the backward kernel then
        adds its gradient to that of the projection.
    """
    tensors = (value.contiguous() for value in (means, quats, scales, opacities, viewmats, Ks))
    return _Project.apply(*tensors, width, height, near_plane)  # type: ignore[return-value]
