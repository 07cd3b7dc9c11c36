"""The one door to rasterization: one of three backends projects and composites Gaussians."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any

import torch
from torch import Tensor

from sadgs_ns import gsplat_compat
from sadgs_ns.errors import InputError
from sadgs_ns.kernels import use_triton
from sadgs_ns.render.types import DEFAULTS, BackendName, Cameras, Gaussians, Projected, RenderOptions


def rasterize(
    gaussians: Gaussians, cameras: Cameras, options: RenderOptions = DEFAULTS, *, color_maps: Tensor | None = None
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Project and composite Gaussians, on their device; see `project` and `composite`."""
    return composite(project(gaussians, cameras, options, color_maps=color_maps), options)


def project(
    gaussians: Gaussians,
    cameras: Cameras,
    options: RenderOptions = DEFAULTS,
    *,
    color_maps: Tensor | None = None,
    begin_tiles: bool = True,
) -> Projected:
    """Project Gaussians into cameras and compute their colours, differentiably.

    Args:
        gaussians: In float32, or for the torch backend in float64, too.
        cameras: On the same device. With the Triton backend `Ks` gets no gradient.
        options: The same as for `composite`.
        color_maps: Factors a and offsets b of each view, which change its Gaussians' colours c into a c + b, such as
            the gains of a photo. With α that of a pixel, its colour C becomes a C + b α. They have no gradient.
            None changes nothing. [C, 2, 3]
        begin_tiles: Whether `composite` will get this result unchanged. The Triton backend then begins its tile lists
            here, so that the host waits for their length while the device computes colours.

    Raises:
        InputError: If `options.backend` does not draw on this device, or there are more Gaussians or pixels than the
            Triton kernels can address (kernels/limits.py).
    """
    backend = _backend(options.backend, gaussians.means.device)
    projected = backend.project(gaussians, cameras, options, begin_tiles)
    if color_maps is not None:
        # Gaussians are mostly fewer than pixels, and their offsets give the pixels' alphas no gradient.
        factors, offsets = color_maps.detach()[:, :, None].unbind(dim=1)  # [C, 1, 3] each
        projected = projected._replace(colors=torch.addcmul(offsets, projected.colors, factors))
    return projected


def composite(projected: Projected, options: RenderOptions = DEFAULTS) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Composite Gaussians front to back, differentiably.

    Args:
        projected: What `project` returned, or rows of it that cameras of this size draw.
        options: The same as for `project`.

    Returns:
        Colours [C, height, width, D], with the expected depth in the last of them where it was asked for; alphas
        [C, height, width, 1] in [0, 1]; and `projected.info()` with `flatten_ids`, the tile lists, and from the Triton
        backend `pair_counts` (kernels/tiles.py), the numbers of pairs of a Gaussian and a tile.

    Raises:
        InputError: If there are more Gaussians, pixels or tile pairs than the Triton kernels can address.
    """
    drawn = projected
    if options.expected_depth:
        depths = projected.depths[..., None]  # [C, N, 1]
        colors = torch.cat([projected.colors, depths], dim=-1)
        drawn = projected._replace(colors=colors)
    backend = _backend(options.backend, projected.means2d.device)
    renders, alphas, lists = backend.composite(drawn, options)
    if options.expected_depth:
        colors = renders[..., :-1]
        expected_depths = renders[..., -1:] / alphas.clamp_min(1e-10)
        renders = torch.cat([colors, expected_depths], dim=-1)
    return renders, alphas, projected.info() | lists


_REMEDY = "set the option model.backend to auto, of a finished run in its config.yml"


def choose_backend(wanted: BackendName, device: torch.device, single_process: bool = True) -> str:
    """Return which backend draws on a device: "triton", "gsplat" or "torch".

    "auto" is Triton where its kernels run, gsplat on CUDA without them, and torch elsewhere. They draw the same, but
    that gsplat 1.4 cuts Gaussians off at borders of larger tiles. Only Triton's steps become CUDA graphs, and gsplat
    draws only for a `single_process`, which holds all Gaussians. Raise InputError if the backend that is wanted does
    not draw here.
    """
    chosen: str = wanted
    if wanted == "auto":
        if use_triton(device):
            chosen = "triton"
        elif device.type == "cuda":
            chosen = "gsplat"
        else:
            chosen = "torch"
    if wanted == "triton" and not use_triton(device):
        raise InputError(f"The backend triton does not run on {device} here (see sadgs-doctor): {_REMEDY}.")
    if chosen == "gsplat" and device.type != "cuda":
        raise InputError(f"The backend gsplat needs a CUDA device, and this is {device}: {_REMEDY}.")
    if chosen == "gsplat" and not single_process:
        problem = "The backend gsplat works on one device only, and this run takes several"
        raise InputError(f"{problem}: take one, or let Triton draw (sadgs-doctor says whether it works).")
    return chosen


def _backend(wanted: BackendName, device: torch.device) -> Any:
    """Import the module of a backend. Triton need not be installed, and gsplat's loads nothing before it draws."""
    name = choose_backend(wanted, device)
    return import_module(f"sadgs_ns.render.backend_{name}")


def visible(info: Mapping[str, Any]) -> Tensor:
    """Tell which Gaussians were drawn, from the `info` of `rasterize` or of gsplat 1.4 or 1.5. bool [C, N]"""
    return gsplat_compat.drawn(info["radii"], info["means2d"])


def viewmats_from_camera_to_world(
    camera_to_worlds: Tensor,  # [C, 3, 4]
) -> Tensor:
    """Make `Cameras.viewmats` [C, 4, 4] of orthonormal poses in OpenGL's axes (x right, y up, z backward)."""
    flip = camera_to_worlds.new_tensor([1.0, -1.0, -1.0])
    rotations = (camera_to_worlds[:, :, :3] * flip).mT  # [C, 3, 3], the inverse of an orthonormal matrix
    translations = -rotations @ camera_to_worlds[:, :, 3:]  # [C, 3, 1]
    bottom = camera_to_worlds.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(len(camera_to_worlds), 1, 4)
    top = torch.cat([rotations, translations], dim=-1)  # [C, 3, 4]
    return torch.cat([top, bottom], dim=-2)
