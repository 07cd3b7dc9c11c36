"""Gaussians before pinhole cameras in plain torch: EWA splatting and spherical harmonics, of any floating type.

These are the formulas of gsplat's kernels, operation by operation as in its own torch code of 1.4.0.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from gsplat.utils import normalized_quat_to_rotmat
from torch import Tensor

FRUSTUM_MARGIN = 0.3  # The projection's Jacobian is taken at most this many half images beyond the image's border


def covariances(quats: Tensor, scales: Tensor) -> Tensor:
    """Compute R S² Rᵀ of wxyz quaternions of any length [N, 4] and standard deviations [N, 3]. [N, 3, 3]"""
    axes = normalized_quat_to_rotmat(F.normalize(quats, p=2, dim=-1)) * scales[..., None, :]
    return torch.bmm(axes, axes.transpose(-1, -2))


def world_to_camera(means: Tensor, covars: Tensor, viewmats: Tensor) -> tuple[Tensor, Tensor]:
    """Turn centres [N, 3] and covariances [N, 3, 3] into the axes of cameras [C, 4, 4]. [C, N, 3], [C, N, 3, 3]"""
    rotations = viewmats[:, :3, :3]
    translations = viewmats[:, :3, 3]
    centres = torch.einsum("cij,nj->cni", rotations, means) + translations[:, None, :]
    return centres, torch.einsum("cij,njk,clk->cnil", rotations, covars, rotations)


def perspective(means: Tensor, covars: Tensor, Ks: Tensor, width: int, height: int) -> tuple[Tensor, Tensor]:
    """Project centres [C, N, 3] and covariances [C, N, 3, 3] in camera space with intrinsics in px [C, 3, 3].

    Returns:
        Centres in px [C, N, 2], and covariances in px², without blur [C, N, 2, 2].
    """
    x, y, z = means.unbind(dim=-1)
    z2 = z**2
    fx = Ks[:, 0, 0, None]  # [C, 1], like the next ones
    fy = Ks[:, 1, 1, None]
    cx = Ks[:, 0, 2, None]
    cy = Ks[:, 1, 2, None]
    margin_x = FRUSTUM_MARGIN * (0.5 * width / fx)
    margin_y = FRUSTUM_MARGIN * (0.5 * height / fy)
    left = -(cx / fx + margin_x)
    right = (width - cx) / fx + margin_x
    top = -(cy / fy + margin_y)
    bottom = (height - cy) / fy + margin_y
    # The Jacobian is taken at a place near the image; the centres stay where they are.
    clamped_x = z * torch.clamp(x / z, min=left, max=right)
    clamped_y = z * torch.clamp(y / z, min=top, max=bottom)
    zero = torch.zeros_like(z)
    jacobian = torch.stack([fx / z, zero, -fx * clamped_x / z2, zero, fy / z, -fy * clamped_y / z2], dim=-1)
    jacobian = jacobian.reshape(*z.shape, 2, 3)
    covars2d = torch.einsum("...ij,...jk,...kl->...il", jacobian, covars, jacobian.transpose(-1, -2))
    means2d = torch.einsum("cij,cnj->cni", Ks[:, :2, :3], means)
    return means2d / z[..., None], covars2d


def view_directions(
    means: Tensor,  # [N, 3]
    viewmats: Tensor,  # rigid [C, 4, 4]
) -> Tensor:
    """Return the vectors from cameras to positions. [C, N, 3]

    The cameras' positions are computed without the inverse of a matrix, for which the host would wait for the device.
    """
    positions = -(viewmats[:, :3, :3].mT @ viewmats[:, :3, 3:]).mT  # [C, 1, 3]
    return means - positions


def spherical_harmonics(degree: int, dirs: Tensor, coeffs: Tensor) -> Tensor:
    """Evaluate harmonics up to a degree ≤ 3, in 3DGS's order, without a colour's 0.5. […, 3]

    `dirs` are directions from the camera, of any length […, 3], and `coeffs` […, K, 3] with K ≥ (degree + 1)².
    """
    x, y, z = F.normalize(dirs, p=2, dim=-1).unbind(dim=-1)
    number = (degree + 1) ** 2
    bases = torch.zeros_like(coeffs[..., 0])  # Those of higher degrees stay 0.
    bases[..., :number] = torch.stack(_bases(x, y, z)[:number], dim=-1)
    return (bases[..., None] * coeffs).sum(dim=-2)


def _bases(x: Tensor, y: Tensor, z: Tensor) -> list[Tensor]:
    """Evaluate the basis of the harmonics at unit vectors; the order of operations decides how gradients round."""
    along_z = 0.48860251190292 * z
    along_x = -0.48860251190292 * x
    along_y = -0.48860251190292 * y
    z2 = z * z
    tilt = -1.092548430592079 * z
    cos2 = x * x - y * y
    sin2 = 2 * x * y
    b6 = 0.9461746957575601 * z2 - 0.3153915652525201
    b7 = tilt * x
    b5 = tilt * y
    b8 = 0.5462742152960395 * cos2
    b4 = 0.5462742152960395 * sin2
    ring = -2.285228997322329 * z2 + 0.4570457994644658
    tilt = 1.445305721320277 * z
    cos3 = x * cos2 - y * sin2
    sin3 = x * sin2 + y * cos2
    b12 = z * (1.865881662950577 * z2 - 1.119528997770346)
    b13 = ring * x
    b11 = ring * y
    b14 = tilt * cos2
    b10 = tilt * sin2
    b15 = -0.5900435899266435 * cos3
    b9 = -0.5900435899266435 * sin3
    b0 = torch.full_like(x, 0.2820947917738781)
    return [b0, along_y, along_z, along_x, b4, b5, b6, b7, b8, b9, b10, b11, b12, b13, b14, b15]
