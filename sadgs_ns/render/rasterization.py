"""The one entrance to rasterization: gsplat or our Triton kernels on CUDA, the torch splatter elsewhere."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import torch
from torch import Tensor

from sadgs_ns import gsplat_compat
from sadgs_ns.gsplat_compat import NEAR_PLANE
from sadgs_ns.kernels import use_triton
from sadgs_ns.render import backend_torch
from sadgs_ns.render.off_axis import culling
from sadgs_ns.render.projected import Projected


def rasterize(
    means: Tensor,  # [N, 3] centres in world space
    quats: Tensor,  # [N, 4] wxyz, of any length
    scales: Tensor,  # [N, 3] standard deviations along the axes, in world units, > 0
    opacities: Tensor,  # [N] in [0, 1]
    colors: Tensor | tuple[Tensor, Tensor],  # [(C,) N, D], [(C,) N, K, 3] or [N, 3] and [N, K - 1, 3]
    viewmats: Tensor,  # [C, 4, 4] world to camera, rigid, OpenCV axes (x right, y down, z forward)
    Ks: Tensor,  # [C, 3, 3] px
    width: int,
    height: int,
    *,
    sh_degree: int | None = None,
    render_mode: Literal["RGB", "RGB+ED"] = "RGB",
    absgrad: bool = False,
    rasterize_mode: Literal["classic", "antialiased"] = "classic",
    max_off_axis: float = 0.0,
    near_plane: float = NEAR_PLANE,
    tile_capacity: int | None = None,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Render N Gaussians into C pinhole cameras on the device of `means`, unpacked.

    With our Triton kernels a tile lists only the Gaussians that reach it; what is drawn is the same as gsplat's.

    Args:
        colors: Features [(C,) N, D] or, with `sh_degree`, spherical harmonics coefficients: [(C,) N, K, 3], or the pair
            of those of degree 0 [N, 3] and of the others [N, K − 1, 3].
        sh_degree: Degree to evaluate, (sh_degree + 1)^2 <= K; None takes `colors` as they are.
        render_mode: "RGB" renders colours, "RGB+ED" appends the expected depth.
        absgrad: Whether `backward` sets `info["means2d"].absgrad`. [C, N, 2]
        rasterize_mode: "antialiased" compensates opacities for the screen-space blur.
        max_off_axis: Gaussians whose centre is projected further from the image's centre, in half images along x or y,
            are culled (off_axis.py); 0 culls none.
        near_plane: Gaussians whose centre is nearer along the viewing axis are culled, in world units.
        tile_capacity: Number of pairs of a Gaussian and a tile, in all views, for which the Triton kernels make room,
            so that the host does not wait for the exact number. If there are more, nothing is drawn, no gradient flows
            and all `radii` are 0. With None the host waits. gsplat and the splatter need no such number.

    Returns:
        Colours [C, height, width, X] with X = D or D + 1 by `render_mode`, alphas [C, height, width, 1] in [0, 1],
        and what strategies read of gsplat's `info`, in which `radii` depends on the gsplat version: read it through
        `visible`. From the Triton kernels it also holds `pair_counts` (kernels/tiles.py), the exact numbers of pairs.

    Raises:
        ValueError: From the splatter, if a mode is unknown or a shape does not match. gsplat raises AssertionError; our
            Triton kernels do not check shapes.
        InputError: If there are more Gaussians, pixels or tile pairs than the Triton kernels can address
            (kernels/limits.py).
    """
    options: dict[str, Any] = {"max_off_axis": max_off_axis}
    rasterization: Any = backend_torch.rasterization
    triton = use_triton(means.device)
    # gsplat compiles its CUDA kernels when they are first used. These imports stand here so that nothing touches them
    # without a GPU.
    if triton:
        from sadgs_ns.render.backend_triton import rasterization

        options["tile_capacity"] = tile_capacity
    elif means.is_cuda:
        import gsplat.rendering

        rasterization, options = culling(gsplat.rendering.rasterization, max_off_axis), {}
    if isinstance(colors, tuple) and not triton:
        colors = torch.cat([colors[0][:, None], colors[1]], dim=1)
    return rasterization(
        means,
        quats,
        scales,
        opacities,
        colors,
        viewmats,
        Ks,
        width,
        height,
        sh_degree=sh_degree,
        packed=False,
        render_mode=render_mode,
        absgrad=absgrad,
        rasterize_mode=rasterize_mode,
        near_plane=near_plane,
        **options,
    )


def project(
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    scales: Tensor,  # [N, 3]
    opacities: Tensor,  # [N]
    colors: Tensor | tuple[Tensor, Tensor],  # [(C,) N, D], [(C,) N, K, 3] or [N, 3] and [N, K - 1, 3]
    viewmats: Tensor,  # [C, 4, 4]
    Ks: Tensor,  # [C, 3, 3]
    width: int,
    height: int,
    *,
    sh_degree: int | None = None,
    rasterize_mode: Literal["classic", "antialiased"] = "classic",
    max_off_axis: float = 0.0,
    near_plane: float = NEAR_PLANE,
) -> Projected:
    """Do the first half of `rasterize`, whose arguments these are: project Gaussians and compute their colours.

    Without our Triton kernels, that is the splatter's, on CUDA, too. Raises InputError if there are more Gaussians than
    the Triton kernels can address (kernels/limits.py).
    """
    antialiased = rasterize_mode == "antialiased"
    if use_triton(means.device):
        from sadgs_ns.render.backend_triton import project

        return project(
            means, quats, scales, opacities, colors, viewmats, Ks, width, height, sh_degree,
            antialiased=antialiased, max_off_axis=max_off_axis, near_plane=near_plane,
        )  # fmt: skip
    if isinstance(colors, tuple):
        colors = torch.cat([colors[0][:, None], colors[1]], dim=1)
    return backend_torch.project(
        means, quats, scales, opacities, colors, viewmats, Ks, width, height, sh_degree,
        antialiased=antialiased, max_off_axis=max_off_axis, near_plane=near_plane,
    )  # fmt: skip


def composite(
    projected: Projected, width: int, height: int, *, absgrad: bool = False
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Do the second half of `rasterize`, whose arguments and results these are, for colours alone.

    Args:
        projected: What `project` returned, or rows of it that cameras of this size draw.
        width: Image width in pixels.
        height: Image height in pixels.
        absgrad: Whether `backward` sets `means2d.absgrad`. [C, N, 2]

    Raises:
        InputError: As `rasterize`.
    """
    if use_triton(projected.means2d.device):
        from sadgs_ns.render.backend_triton import composite

        return composite(projected, width, height, absgrad=absgrad)
    return backend_torch.composite(projected, width, height, absgrad=absgrad)


def visible(info: Mapping[str, Any]) -> Tensor:
    """Tell which Gaussians were drawn, from an `info` of gsplat 1.4 (one radius) or 1.5 (a radius for each axis).

    Args:
        info: Third value of `rasterize`; `radii` is int [C, N] or [C, N, 2], in pixels, zero where culled.

    Returns:
        bool [C, N]
    """
    return gsplat_compat.drawn(info["radii"], info["means2d"])


def viewmats_from_camera_to_world(
    camera_to_worlds: Tensor,  # [C, 3, 4]
) -> Tensor:
    """Make world-to-camera transforms for `rasterize` from camera poses as nerfstudio has them.

    Args:
        camera_to_worlds: Camera-to-world poses, OpenGL axes (x right, y up, z backward), orthonormal. [C, 3, 4]

    Returns:
        World-to-camera, OpenCV axes (x right, y down, z forward). [C, 4, 4]
    """
    flip = camera_to_worlds.new_tensor([1.0, -1.0, -1.0])
    rotations = (camera_to_worlds[:, :, :3] * flip).mT  # [C, 3, 3], the inverse of an orthonormal matrix
    translations = -rotations @ camera_to_worlds[:, :, 3:]  # [C, 3, 1]
    bottom = camera_to_worlds.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(len(camera_to_worlds), 1, 4)
    return torch.cat([torch.cat([rotations, translations], dim=-1), bottom], dim=-2)
