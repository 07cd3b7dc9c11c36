"""Where gsplat 1.4.0 and 1.5.3 differ, so that a new gsplat changes this file; all that is used of it is public.

Their sources were read, and nothing is claimed of gsplat 1.6, which is not released. tests/test_gsplat_compat.py fails
where a gsplat has other signatures or shapes. Importing this loads no CUDA kernels: gsplat does when the first runs.
"""

from __future__ import annotations

import inspect
from typing import Any

import gsplat
import torch
from torch import Tensor

RADII_PER_AXIS = "opacities" in inspect.signature(gsplat.fully_fused_projection).parameters
"""Whether the installed gsplat is 1.5 or newer. Its projection takes opacities and makes radii int32 [C, N, 2]: the
extents along x and y at which alpha falls below 1/255, at most 3.33 standard deviations. gsplat 1.4 makes radii int32
[C, N]: three standard deviations along the longer axis. Both are in px, and zero where a Gaussian is not drawn. The
rest of the package reads both layouts, and our own projections write the one that is named here; `project` must convert
a third one of a new gsplat."""
NEAR_PLANE = 0.01  # Depth in world units from which gsplat 1.4 and 1.5, and most viewers of files, draw Gaussians
FAR_PLANE = 1e10  # Depth in world units up to which gsplat draws Gaussians
SCREEN_BLUR = 0.3  # What gsplat adds to the diagonal of Σ2D before it inverts it, its `eps2d`, in px²


def has_radius_per_axis(radii: Tensor, means2d: Tensor) -> bool:
    """Tell whether `Projected` Gaussians have a radius along x and one along y (gsplat 1.5) or one radius (1.4)."""
    return radii.dim() == means2d.dim()


def drawn(radii: Tensor, means2d: Tensor) -> Tensor:
    """Tell which `Projected` Gaussians gsplat drew: all their radii are positive. bool [C, N]"""
    positive = radii > 0
    return positive.all(dim=-1) if has_radius_per_axis(radii, means2d) else positive


def project(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, viewmats: Tensor, Ks: Tensor,
    width: int, height: int, near_plane: float = NEAR_PLANE,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:  # fmt: skip
    """Project Gaussians into pinhole cameras (render/types.py) differentiably, as `gsplat.rasterization` does.

    Return radii, means2d, depths and conics as `render.types.Projected` has them. What is not drawn has radius zero,
    and its other values are not written. The opacities bound the radii of gsplat 1.5.
    """
    bound: dict[str, Any] = {"opacities": opacities} if RADII_PER_AXIS else {}
    return gsplat.fully_fused_projection(  # type: ignore[return-value]
        means, None, quats, scales, viewmats, Ks, width, height, near_plane=near_plane, **bound
    )[:4]


def try_kernels() -> None:
    """Run one of gsplat's CUDA kernels, for which gsplat loads or compiles them all.

    Raise RuntimeError if they are for another GPU or there is no toolkit to compile them, and what compiling raises.
    """
    direction = torch.ones((1, 3), device="cuda")
    try:
        # gsplat 1.4 does not ask whether its kernel was launched; torch does at the sum.
        gsplat.spherical_harmonics(0, direction, direction[None]).sum().item()
    except AttributeError as error:  # gsplat looks the kernel up in None.
        raise RuntimeError("neither prebuilt nor compiled") from error
