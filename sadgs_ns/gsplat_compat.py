"""Everything of gsplat that this package uses beside its public, stable names, so that a new gsplat changes this file.

Every docstring says which gsplat versions it holds for: 1.4.0, 1.5.0 and 1.5.3 were read, and 1.5.1 and 1.5.2 lie
between two that agree. gsplat 1.6, which is not released, needs torch 2.7, makes exact tile lists of its own and
reorganizes how `rasterization` calls its parts; its sources were not read. Where they differ,
tests/test_gsplat_compat.py fails and names the function of this file.

Importing this module loads none of gsplat's CUDA kernels: gsplat loads or compiles them when the first of them runs.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from types import FunctionType
from typing import Any

import gsplat
from gsplat.cuda import _torch_impl
from gsplat.strategy import ops
from torch import Tensor

# Radii: how far a Gaussian reaches on the screen, and whether it was drawn.

RADII_PER_AXIS = "opacities" in inspect.signature(gsplat.fully_fused_projection).parameters
"""Whether the installed gsplat is 1.5 or newer. Its projection takes opacities and makes radii int32 [C, N, 2]: the
extents along x and y at which alpha falls below 1/255, at most 3.33 standard deviations. gsplat 1.4 makes radii int32
[C, N]: three standard deviations along the longer axis. Both are in px, and zero where a Gaussian is not drawn. The
rest of the package, its Triton kernels too, reads both layouts; if a new gsplat has a third, `project` and
`with_changed_radii` must convert it to one of these."""


def has_radius_per_axis(
    radii: Tensor,  # [C, N] or [C, N, 2]; packed: [nnz] or [nnz, 2]
    means2d: Tensor,  # [C, N, 2]; packed: [nnz, 2]
) -> bool:
    """Tell whether Gaussians have a radius along x and one along y (gsplat 1.5) or one radius (gsplat 1.4).

    The ranks are compared since packed radii of 1.5 [nnz, 2] look like unpacked ones of 1.4 [C, N].
    """
    return radii.dim() == means2d.dim()


def drawn(
    radii: Tensor,  # [C, N] or [C, N, 2]; packed: [nnz] or [nnz, 2]
    means2d: Tensor,  # [C, N, 2]; packed: [nnz, 2]
) -> Tensor:
    """Tell which Gaussians gsplat drew: all their radii are positive. bool [C, N]; packed: [nnz]"""
    positive = radii > 0
    return positive.all(dim=-1) if has_radius_per_axis(radii, means2d) else positive


# The parts of `gsplat.rasterization`: CUDA kernels.

NEAR_PLANE = 0.01
"""Depth in world units from which gsplat 1.4 and 1.5, and most viewers of exported files, draw Gaussians."""
FAR_PLANE = 1e10
"""Depth in world units up to which gsplat draws Gaussians."""
SCREEN_BLUR = 0.3
"""What gsplat adds to the diagonal of Σ2D before it inverts it, its `eps2d`, in px²."""


def project(
    means: Tensor,  # [N, 3] in world space
    quats: Tensor,  # [N, 4] wxyz, of any length
    scales: Tensor,  # [N, 3] standard deviations in world units, > 0
    opacities: Tensor,  # [N] in [0, 1]
    viewmats: Tensor,  # [C, 4, 4] world to camera, OpenCV axes
    Ks: Tensor,  # [C, 3, 3] px
    width: int,
    height: int,
    calc_compensations: bool,
    near_plane: float = NEAR_PLANE,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor | None]:
    """Project Gaussians into pinhole cameras with a blur of 0.3 px², differentiably, as `gsplat.rasterization` does.

    This is gsplat's `fully_fused_projection`, in 1.4 and 1.5. A new gsplat may pass it more arguments than this does.
    The opacities bound the radii of gsplat 1.5, and the compensations say how much the blur must lower them.

    Returns:
        radii, int32 px in the layout that RADII_PER_AXIS tells; means2d in px [C, N, 2]; depths in world units [C, N];
        conics in 1/px² [C, N, 3]; and compensations in [0, 1] [C, N], or None where they were not asked for. What is
        not drawn has radius zero, and its other values are not written.
    """
    bound: dict[str, Any] = {"opacities": opacities} if RADII_PER_AXIS else {}
    return gsplat.fully_fused_projection(  # type: ignore[return-value]
        means, None, quats, scales, viewmats, Ks, width, height,
        near_plane=near_plane, calc_compensations=calc_compensations, **bound,
    )  # fmt: skip


def spherical_harmonics(
    degree: int,
    dirs: Tensor,  # [C, N, 3] from the cameras, of any length
    coeffs: Tensor,  # [C, N, K ≥ (degree + 1)², 3]
    masks: Tensor,  # bool [C, N], False where the result is not needed
) -> Tensor:
    """Evaluate spherical harmonics of degree 0 to 4, differentiably, without a colour's 0.5. [C, N, 3]

    This is gsplat's function of that name, whose signature is the same in 1.4 and 1.5.
    """
    return gsplat.spherical_harmonics(degree, dirs, coeffs, masks=masks)


def rasterize_to_pixels(
    means2d: Tensor,  # [C, N, 2] px
    conics: Tensor,  # [C, N, 3] 1/px²
    colors: Tensor,  # [C, N, D], D in 1 … 513
    opacities: Tensor,  # [C, N] in [0, 1]
    width: int,
    height: int,
    tile_size: int,
    isect_offsets: Tensor,  # int32 [C, tile rows, tile columns], where each tile's list starts
    flatten_ids: Tensor,  # int32 [number of pairs], indices in C · N
    absgrad: bool,
) -> tuple[Tensor, Tensor]:
    """Composite Gaussians front to back. With `absgrad`, `backward` sets the attribute `absgrad` of `means2d`.

    This is gsplat's function of that name, whose signature is the same in 1.4 and 1.5.

    Returns:
        Colours [C, height, width, D] and alphas [C, height, width, 1].
    """
    return gsplat.rasterize_to_pixels(
        means2d, conics, colors, opacities, width, height, tile_size, isect_offsets, flatten_ids, absgrad=absgrad
    )


def cuda_extension() -> Any | None:
    """Load gsplat's CUDA kernels, `_C` of its module `cuda._backend` in 1.4 and 1.5; raises what compiling raises.

    Returns:
        The compiled module, or None where it neither came with the wheel nor can be compiled for lack of a toolkit.
    """
    from gsplat.cuda import _backend

    return _backend._C


# `gsplat.rasterization` itself.


def with_changed_radii(
    rasterization: Callable[..., Any], change: Callable[[Tensor, Tensor, int, int], Tensor]
) -> Callable[..., Any]:
    """Make gsplat's `rasterization`, called with packed=False, draw with other radii.

    In 1.4 and 1.5 it is a plain function, which finds `fully_fused_projection` among its module's names and passes it
    width and height as the seventh and eighth positional arguments. A gsplat that projects elsewhere, as 1.6 may, needs
    another way in. The module's own names stay as they are, since the viewer renders in another thread.

    Args:
        rasterization: `gsplat.rendering.rasterization`.
        change: Is called with radii as RADII_PER_AXIS tells, means2d in px [C, N, 2], width and height in px; returns
            radii of the same shape and type.
    """
    assert isinstance(rasterization, FunctionType)
    project_all = rasterization.__globals__["fully_fused_projection"]

    def project_and_change(*args: Any, **options: Any) -> tuple[Any, ...]:
        radii, means2d, *others = project_all(*args, **options)
        width, height = args[6:8]
        return change(radii, means2d, width, height), means2d, *others

    names = rasterization.__globals__ | {"fully_fused_projection": project_and_change}
    same = FunctionType(rasterization.__code__, names, rasterization.__name__, rasterization.__defaults__)
    same.__kwdefaults__ = rasterization.__kwdefaults__
    return same


# gsplat's private torch functions, from which the splatter is made. They run on any device, in float32 and float64.

torch_quat_scale_to_covar_preci = _torch_impl._quat_scale_to_covar_preci
"""`(quats, scales, compute_covar=True, compute_preci=True, triu=False)`: covariances R S² Rᵀ and their inverses
[N, 3, 3], each None where it was not asked for, from wxyz quaternions of any length [N, 4] and standard deviations
[N, 3]. In 1.4 and 1.5."""

torch_world_to_cam = _torch_impl._world_to_cam
"""`(means, covars, viewmats)`: centres [N, 3] and covariances [N, 3, 3] in the axes of cameras [C, 4, 4], as [C, N, 3]
and [C, N, 3, 3]. In 1.4 and 1.5; gsplat's function of this name without the underscore warns in 1.5 that it will go."""

torch_persp_proj = _torch_impl._persp_proj
"""`(means, covars, Ks, width, height)`: centres in px [C, N, 2] and covariances in px², without blur [C, N, 2, 2], from
camera space [C, N, 3] and [C, N, 3, 3]. The projection's Jacobian is taken at most 0.3 half images beyond the image's
border, as the CUDA kernels do. In 1.4 and 1.5."""

torch_spherical_harmonics = _torch_impl._spherical_harmonics
"""`(degree, dirs, coeffs)`: what `spherical_harmonics` computes, for shapes […, 3] and […, K, 3]. In 1.4 and 1.5, where
the first argument has another name in 1.5.3: pass it by its place."""


# gsplat's strategies.

update_param_with_optimizer = ops._update_param_with_optimizer
"""`(param_fn, optimizer_fn, params, optimizers, names=None)`: put `param_fn(name, parameter)` in the place of every
parameter that is named, or of all, and `optimizer_fn(key, moment)` in that of every moment of their optimizers; `step`
stays. While it changes the moments of a parameter, its optimizer has no state, by which plugin/trainer.py recognizes
that memory ran out meanwhile. gsplat's `duplicate`, `split` and `remove` are made of it. In 1.4 and 1.5; in 1.4 every
parameter needs an optimizer, in 1.5 one that needs no gradient may have none."""
