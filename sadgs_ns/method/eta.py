"""η at the visible Gaussians: projected axes against the local wavelength (paper, section 3.3, eq. 1, 6, 7).

M is the number of observations of a training step: pairs of a camera and a Gaussian that it sees.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from gsplat.utils import normalized_quat_to_rotmat
from torch import Tensor

from sadgs_ns.gsplat_compat import SCREEN_BLUR
from sadgs_ns.method.quantization import dequantize
from sadgs_ns.render.ewa import FRUSTUM_MARGIN

WAVELENGTH_EPSILON = 1e-5
"""ε of Λ_min = 1 / (√λ_1 + ε) in 1/px: a textureless region has a wavelength of 10⁵ px, not infinity."""


def principal_eigenvalue(
    structure_tensor: Tensor,  # [..., 3]
) -> Tensor:
    """Larger eigenvalue λ_1 of symmetric 2×2 tensors (xx, xy, yy), in a closed form in which nothing cancels. [...]"""
    xx, xy, yy = structure_tensor.unbind(-1)
    mean = 0.5 * (xx + yy)
    deviator = 0.5 * (xx - yy)
    return mean + torch.hypot(deviator, xy)


def wavelength(
    structure_tensor: Tensor,  # [..., 3]
) -> Tensor:
    """Smallest local wavelength Λ_min = 1 / (√λ_1 + ε) in px of S̄ in 1/px², in (0, 1/ε] (paper, section 3.3). [...]"""
    frequency = principal_eigenvalue(structure_tensor).clamp_min(0).sqrt()  # 1/px
    return 1.0 / (frequency + WAVELENGTH_EPSILON)


def projected_axes(
    means: Tensor,  # [M, 3] world units, in front of the camera
    quats: Tensor,  # [M, 4] wxyz, of any length
    scales: Tensor,  # [M, 3] standard deviations in world units, > 0
    viewmats: Tensor,  # [M, 4, 4] world to camera, one for each observation
    Ks: Tensor,  # [M, 3, 3] px
    width: int,
    height: int,
) -> Tensor:
    """Screen-space vectors of the three principal axes in px, v_k = J W R S_k (paper, eq. 1). [M, 3, 2]

    J is the Jacobian that gsplat's forward pass uses for a pinhole camera, with its clamp near the frustum's border.
    """
    rotation = viewmats[:, :3, :3]  # W [M, 3, 3]
    centres = torch.einsum("mij,mj->mi", rotation, means) + viewmats[:, :3, 3]  # In camera space. [M, 3]
    jacobian = _clamped_jacobian(centres, Ks, width, height)  # J [M, 2, 3]
    rotmats = normalized_quat_to_rotmat(F.normalize(quats, dim=-1))  # R [M, 3, 3]
    axes = rotmats * scales[:, None, :]  # R S [M, 3, 3]
    projected = jacobian @ rotation @ axes  # J W R S [M, 2, 3]
    return projected.transpose(1, 2)


def _clamped_jacobian(centres: Tensor, Ks: Tensor, width: int, height: int) -> Tensor:
    """Jacobian of the pinhole projection at centres in camera space [M, 3], as gsplat computes it. [M, 2, 3]"""
    x, y, z = centres.unbind(-1)  # [M] each
    fx = Ks[:, 0, 0]
    fy = Ks[:, 1, 1]
    cx = Ks[:, 0, 2]
    cy = Ks[:, 1, 2]
    margin_x = FRUSTUM_MARGIN * 0.5 * width / fx
    margin_y = FRUSTUM_MARGIN * 0.5 * height / fy
    right = (width - cx) / fx + margin_x
    left = -cx / fx - margin_x
    bottom = (height - cy) / fy + margin_y
    top = -cy / fy - margin_y
    tangent_x = torch.maximum(torch.minimum(x / z, right), left)
    tangent_y = torch.maximum(torch.minimum(y / z, bottom), top)
    zero = torch.zeros_like(z)
    jxx = fx / z  # There is no z² in J, because it underflows long before z does.
    jyy = fy / z
    row_x = torch.stack([jxx, zero, -jxx * tangent_x], dim=-1)  # [M, 3]
    row_y = torch.stack([zero, jyy, -jyy * tangent_y], dim=-1)
    return torch.stack([row_x, row_y], dim=1)


def sample_footprint(
    means2d: Tensor,  # [M, 2] px
    conics: Tensor,  # [M, 3] (a, b, c) of the inverse of Σ2D + SCREEN_BLUR·I, in 1/px²
    jitter: Tensor,  # [M, 2] in [0, 1)
) -> Tensor:
    """Draw one point in each Gaussian's footprint, uniformly if the jitter is uniform (paper, section 3.3).

    The footprint is the 2σ ellipse of Σ2D: a uniform point in it has mean μ_2D and covariance Σ2D. gsplat's conic
    contains its screen-space blur, which is taken out again; variances that rounding makes negative are set to 0.

    Returns:
        Points in px, pixel centres at half-integers; NaN where the conic is NaN or infinite. [M, 2]
    """
    xx, xy, yy = _footprint_covariances(conics)
    # Cholesky factor of Σ2D, with xy limited to what a positive semidefinite matrix allows.
    factor_xx = xx.sqrt()
    limit = yy.sqrt()
    factor_xy = torch.where(xx > 0, xy / factor_xx, 0.0)
    factor_xy = torch.maximum(torch.minimum(factor_xy, limit), -limit)
    factor_yy = (yy - factor_xy**2).clamp_min(0).sqrt()
    # A uniform point in the disc of radius 2.
    radius = 2.0 * jitter[:, 0].sqrt()
    angle = 2.0 * torch.pi * jitter[:, 1]
    u = radius * angle.cos()
    v = radius * angle.sin()
    offsets = torch.stack([factor_xx * u, factor_xy * u + factor_yy * v], dim=-1)  # [M, 2]
    return means2d + offsets.to(means2d.dtype)


def _footprint_covariances(conics: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return xx, xy and yy of Σ2D in px², given `conics` as `sample_footprint` takes them. Each float64 [M]

    A float32 conic tells its determinant from 0 only above ε a c: footprints of thousands of px are cut to that.
    """
    a, b, c = conics.double().unbind(-1)  # The determinant of a long thin Gaussian cancels in float32.
    determinant = a * c - b * b  # Of float32 numbers it cannot overflow: it is finite where they are.
    least = torch.finfo(conics.dtype).eps * a * c
    known = torch.maximum(determinant, least)
    # The conic of a Gaussian too large for float32 is 0.
    known = known.clamp_min(torch.finfo(known.dtype).tiny)
    determinant = torch.where(determinant.isfinite(), known, torch.nan)
    xx = (c / determinant - SCREEN_BLUR).clamp_min(0)
    yy = (a / determinant - SCREEN_BLUR).clamp_min(0)
    xy = -b / determinant
    return xx, xy, yy


def sample_map(
    structure_tensors: Tensor,  # [C, H, W, 3]
    camera_ids: Tensor,  # int64 [M]
    points: Tensor,  # [M, 2]
) -> tuple[Tensor, Tensor]:
    """Read S̄ of images, of any floating dtype or quantized, at the pixel under each point.

    `camera_ids` are the points' images. Points are in px, pixel centres at half-integers.

    Returns:
        S̄ in 1/px², in float32 or wider [M, 3], and whether it is known, bool [M]: the point lies inside the image, on a
        pixel whose S̄ is not NaN, as that of masked pixels is. Where it is not known, 0 is returned.
    """
    height, width = structure_tensors.shape[1:3]
    x, y = points.unbind(-1)
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    column = torch.where(inside, x, 0).long()
    row = torch.where(inside, y, 0).long()
    values = structure_tensors[camera_ids, row, column]
    if values.dtype == torch.uint8:
        values = dequantize(values)
    else:
        values = values.to(torch.promote_types(values.dtype, torch.float32))
    known = inside & ~values.isnan().any(dim=1)
    return torch.where(known[:, None], values, 0.0), known


def eta(
    axes: Tensor,  # [M, 3, 2]
    structure_tensor: Tensor,  # [M, 3]
) -> Tensor:
    """η_k = ‖v_k‖ / Λ_min of each axis (paper, eq. 6), of results of `projected_axes` and `sample_map`. [M, 3]"""
    lengths = torch.hypot(axes[..., 0], axes[..., 1])  # px
    return lengths / wavelength(structure_tensor)[:, None]
