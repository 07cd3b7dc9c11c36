"""`method.statistics.observed_eta` in one kernel: project the axes, and sample S̄ in the footprint."""

from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

from sadgs_ns.kernels import cdiv
from sadgs_ns.kernels.shared import drawn, load3, load_intrinsics, rotation, store3

_LANES = 128  # Gaussians that one program handles
_EPSILON32 = tl.constexpr(1.1920928955078125e-07)  # The distance from 1 to the next float32
_TINY64 = tl.constexpr(2.2250738585072014e-308)  # The smallest normal float64


@triton.jit
def _hypot(a, b):
    """√(a² + b²) without overflow."""
    a = tl.abs(a)
    b = tl.abs(b)
    large = tl.maximum(tl.maximum(a, b), 1e-37)
    small = tl.minimum(a, b) / large
    return large * tl.sqrt(1 + small * small)


@triton.jit
def _matrix_row(matrix, row, x, y, z):
    """One row of a 3×3 matrix, whose rows lie 4 numbers apart, times a vector."""
    at = matrix + 4 * row
    return tl.load(at) * x + tl.load(at + 1) * y + tl.load(at + 2) * z


@triton.jit
def _screen_axis(viewmat, x, y, z, scale, jacobian):
    """J W times one axis of the Gaussian: x and y in px."""
    jxx, jxz, jyy, jyz = jacobian
    to_right = _matrix_row(viewmat, 0, x, y, z)
    down = _matrix_row(viewmat, 1, x, y, z)
    forward = _matrix_row(viewmat, 2, x, y, z)
    return (jxx * to_right + jxz * forward) * scale, (jyy * down + jyz * forward) * scale


@triton.jit
def _eta(axis, tensor, EPSILON: tl.constexpr):
    """η of one axis, as in `method.eta.eta`."""
    u, v = axis
    xx, xy, yy = tensor
    largest = 0.5 * (xx + yy) + _hypot(0.5 * (xx - yy), xy)
    return _hypot(u, v) * (tl.sqrt(tl.maximum(largest, 0.0)) + EPSILON)


@triton.jit
def _frequency(byte, HIGHEST: tl.constexpr, OCTAVES: tl.constexpr):
    """Frequency in 1/px that a byte stands for, as in `method.quantization.dequantize`."""
    return tl.where(byte > 0, HIGHEST * tl.exp2(OCTAVES * ((byte - 1) / 254 - 1)), 0.0)


# One view's intrinsics and S̄ may begin at no multiple of 16 bytes: Triton would compile another kernel for that.
@triton.jit(
    do_not_specialize=["n", "num_views", "width", "height"], do_not_specialize_on_alignment=["structure_tensors", "Ks"]
)
def _observe(
    means, quats, scales, radii, means2d, conics, jitter, structure_tensors, viewmats, Ks,
    eta, n, num_views, width, height, BLUR: tl.constexpr, MARGIN: tl.constexpr, EPSILON: tl.constexpr,
    HIGHEST: tl.constexpr, OCTAVES: tl.constexpr, INVALID: tl.constexpr, PER_GAUSSIAN: tl.constexpr,
    LANES: tl.constexpr,
):  # fmt: skip
    """Write η of the three axes of LANES Gaussians in each view; NaN where it is not observed. [C, N, 3]"""
    g = tl.program_id(0).to(tl.int64) * LANES + tl.arange(0, LANES)
    candidate = g < n
    x, y, z = load3(means, 3 * g, candidate)
    scale0, scale1, scale2 = load3(scales, 3 * g, candidate)
    scale0, scale1, scale2 = tl.exp(scale0), tl.exp(scale1), tl.exp(scale2)
    qw = tl.load(quats + 4 * g, candidate, 1.0)
    qx, qy, qz = load3(quats, 4 * g + 1, candidate)
    norm = 1 / tl.maximum(tl.sqrt(qw * qw + qx * qx + qy * qy + qz * qz), 1e-12)
    qw = qw * norm
    qx = qx * norm
    qy = qy * norm
    qz = qz * norm
    for view in range(num_views):
        at = view * tl.cast(n, tl.int64) + g
        seen = drawn(radii, at, candidate, PER_GAUSSIAN)
        # The sample comes from the Cholesky factor of Σ2D, in float64: a long thin Gaussian's determinant cancels.
        a = tl.load(conics + 3 * at, seen, 1.0).to(tl.float64)
        b = tl.load(conics + 3 * at + 1, seen, 0.0).to(tl.float64)
        c = tl.load(conics + 3 * at + 2, seen, 1.0).to(tl.float64)
        determinant = a * c - b * b
        # Triton's maximum drops NaN on a GPU, so comparisons find what is not finite: here, in S̄ and in η.
        seen = seen & (tl.abs(determinant) < float("inf"))
        least = a * _EPSILON32 * c  # A float32 conic tells its determinant from 0 only above this.
        inverse = 1 / tl.maximum(tl.maximum(determinant, least), _TINY64)
        variance_x = tl.maximum(c * inverse - BLUR, 0.0)
        deviation_y = tl.sqrt(tl.maximum(a * inverse - BLUR, 0.0))
        factor_xx = tl.sqrt(variance_x)
        factor_xy = tl.where(variance_x > 0, -b * inverse / tl.where(variance_x > 0, factor_xx, 1.0), 0.0)
        factor_xy = tl.maximum(tl.minimum(factor_xy, deviation_y), -deviation_y)
        factor_yy = tl.sqrt(tl.maximum(deviation_y * deviation_y - factor_xy * factor_xy, 0.0))
        radius = 2 * tl.sqrt(tl.load(jitter + 2 * at, seen, 0.0))
        angle = 6.283185307179586 * tl.load(jitter + 2 * at + 1, seen, 0.0)
        u = radius * tl.cos(angle)
        v = radius * tl.sin(angle)
        point_x = tl.load(means2d + 2 * at, seen, -1.0) + (factor_xx * u).to(tl.float32)
        point_y = tl.load(means2d + 2 * at + 1, seen, -1.0) + (factor_xy * u + factor_yy * v).to(tl.float32)
        observed = seen & (point_x >= 0) & (point_x < width) & (point_y >= 0) & (point_y < height)
        column = tl.where(observed, point_x, 0.0).to(tl.int32)
        row = tl.where(observed, point_y, 0.0).to(tl.int32)
        pixel = structure_tensors + 3 * ((view * height + row).to(tl.int64) * width + column)
        s_xx = tl.load(pixel, observed, 0).to(tl.float32)
        s_xy = tl.load(pixel + 1, observed, 0).to(tl.float32)
        s_yy = tl.load(pixel + 2, observed, 0).to(tl.float32)
        if structure_tensors.dtype.element_ty == tl.uint8:
            observed = observed & (s_xy != INVALID)
            frequency_x = _frequency(s_xx, HIGHEST, OCTAVES)
            frequency_y = _frequency(s_yy, HIGHEST, OCTAVES)
            s_xy = frequency_x * frequency_y * (s_xy - 127) / 127
            s_xx = frequency_x * frequency_x
            s_yy = frequency_y * frequency_y
        observed = observed & (tl.abs(s_xx) + tl.abs(s_xy) + tl.abs(s_yy) < float("inf"))
        # The Jacobian of gsplat's forward pass, with its clamp near the frustum's border.
        viewmat = viewmats + 16 * view
        depth = _matrix_row(viewmat, 2, x, y, z) + tl.load(viewmat + 11)
        depth = tl.where(seen, depth, 1.0)
        fx, fy, cx, cy = load_intrinsics(Ks, view)
        tangent_x = (_matrix_row(viewmat, 0, x, y, z) + tl.load(viewmat + 3)) / depth
        tangent_y = (_matrix_row(viewmat, 1, x, y, z) + tl.load(viewmat + 7)) / depth
        margin_x = MARGIN * 0.5 * width / fx
        margin_y = MARGIN * 0.5 * height / fy
        tangent_x = tl.maximum(tl.minimum(tangent_x, (width - cx) / fx + margin_x), -cx / fx - margin_x)
        tangent_y = tl.maximum(tl.minimum(tangent_y, (height - cy) / fy + margin_y), -cy / fy - margin_y)
        jxx = fx / depth
        jyy = fy / depth
        jacobian = jxx, -jxx * tangent_x, jyy, -jyy * tangent_y
        r00, r01, r02, r10, r11, r12, r20, r21, r22 = rotation(qw, qx, qy, qz)
        tensor = s_xx, s_xy, s_yy
        eta0 = _eta(_screen_axis(viewmat, r00, r10, r20, scale0, jacobian), tensor, EPSILON)
        eta1 = _eta(_screen_axis(viewmat, r01, r11, r21, scale1, jacobian), tensor, EPSILON)
        eta2 = _eta(_screen_axis(viewmat, r02, r12, r22, scale2, jacobian), tensor, EPSILON)
        observed = observed & (eta0 < float("inf")) & (eta1 < float("inf")) & (eta2 < float("inf"))
        eta0 = tl.where(observed, eta0, float("nan"))
        eta1 = tl.where(observed, eta1, float("nan"))
        store3(eta, 3 * at, eta0, eta1, tl.where(observed, eta2, float("nan")), candidate)


def observed_eta(
    params: tuple[Tensor, Tensor, Tensor], radii: Tensor, means2d: Tensor, conics: Tensor, jitter: Tensor,
    structure_tensors: Tensor, viewmats: Tensor, Ks: Tensor,
    *, constants: tuple[float, float, float], quantization: tuple[float, float, int],
) -> Tensor:  # fmt: skip
    """Do what `method.statistics.observed_eta` does, given the tensors of `info`. [C, N, 3]

    Args:
        params: means, quats and log scales, float32.
        constants: gsplat's blur in px², its margin of the frustum, and ε of the wavelength in 1/px.
        quantization: HIGHEST_FREQUENCY, OCTAVES and INVALID of `method.quantization`.
    """
    inputs = (*params, radii, means2d, conics, jitter, structure_tensors, viewmats, Ks)
    num_views, n = radii.shape[:2]
    height, width = structure_tensors.shape[1:3]
    eta = means2d.new_empty((num_views, n, 3))
    _observe[cdiv(n, _LANES),](
        *(value.contiguous() for value in inputs), eta, n, num_views, width, height,
        *constants, *quantization, radii.dim() - 1, _LANES,
    )  # fmt: skip
    return eta
