"""Renders depth and colours of Gaussians from the training views, and fuses them into the mesh of `sadgs-export`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.progress import track
from torch import Tensor

from sadgs_ns.data.coordinates import Similarity
from sadgs_ns.data.run_cameras import RunCameras
from sadgs_ns.errors import InputError
from sadgs_ns.files import atomic_path
from sadgs_ns.formats import mesh
from sadgs_ns.formats.gaussians import DEGREE_0
from sadgs_ns.formats.mesh import DepthView, Fusion
from sadgs_ns.render.rasterization import rasterize, viewmats_from_camera_to_world
from sadgs_ns.render.types import DEFAULTS, Cameras, Gaussians, RenderOptions

MIN_ALPHA = 0.5  # Pixels with less accumulated opacity show no surface
_SAMPLED = 16  # Most views from which the size of voxels is derived


def write_mesh(
    path: Path, params: Mapping[str, Tensor], cameras: RunCameras, similarity: Similarity | None = None,
    voxel_size: float | None = None, drawing: RenderOptions = DEFAULTS,
) -> int:  # fmt: skip
    """Fuse what the training views see into a mesh, write it as `atomic_path` does, and return its number of triangles.

    Raise InputError if no view shows a surface, memory is short or open3d is missing, and WriteError if writing fails.

    Args:
        params: As `of_parameters` takes them.
        cameras: The training views, in the parameters' frame.
        similarity: From the parameters' frame to the file's; None leaves the mesh as it is.
        voxel_size: Edge of a voxel in the parameters' frame; None derives it from the median depth.
    """
    number = len(cameras.sizes)
    if not number:
        raise InputError("The capture has no training views to fuse the depth of: give another with --data.")
    device = torch.device("cpu")
    if torch.cuda.is_available():
        device = torch.device("cuda")
    sound = torch.stack([value.flatten(1).isfinite().all(dim=1) for value in params.values()]).all(dim=0)  # [N]
    params = {name: value[sound].to(device) for name, value in params.items()}
    if voxel_size is None:
        step = -(-number // _SAMPLED)
        voxel_size = derive_voxel_size(list(render_depths(params, cameras, range(0, number, step), drawing)))
    fusion = Fusion(voxel_size)
    console = Console(stderr=True)
    views = render_depths(params, cameras, range(number), drawing)
    for view in track(views, "Fusing depth", number, console=console, disable=not console.is_terminal):
        fusion.add(view)
    found = fusion.mesh()
    if not len(found.triangles):
        problem = f"No surface came out of {number} training views with voxels of {voxel_size:.3g}"
        raise InputError(f"{problem}: take fewer Gaussians away, or leave --voxel-size out.")
    if similarity is not None:
        found = mesh.moved(found, similarity)
    with atomic_path(path) as partial, partial.open("wb") as file:
        mesh.write(file, found)
    return len(found.triangles)


def derive_voxel_size(views: Sequence[DepthView]) -> float:
    """Return an edge of 2 px at the median depth, or what memory allows; raise InputError without surface or open3d."""
    pixels = [np.median(view.depth[view.depth > 0]) / view.focal for view in views if (view.depth > 0).any()]
    if not pixels:
        raise InputError("The training views see no surface that is half opaque: train longer, or take less away.")
    size = mesh.PIXELS_PER_VOXEL * float(np.median(pixels))
    while not Fusion(size).has_room_for(views):
        size *= 2**0.5
    return size


@torch.no_grad()
def render_depths(
    params: Mapping[str, Tensor], cameras: RunCameras, indices: Sequence[int], drawing: RenderOptions = DEFAULTS
) -> Iterator[DepthView]:
    """Render colours and expected depth in some of the views; the parameters are finite, on the device that renders."""
    device = params["means"].device
    viewmats = viewmats_from_camera_to_world(cameras.camera_to_worlds)
    Ks = cameras.Ks
    scales = params["scales"].exp()
    opacities = params["opacities"].flatten().sigmoid()
    first = params["features_dc"]
    rest = params["features_rest"]
    degree = round((1 + rest.shape[1]) ** 0.5) - 1
    colors = (first, rest)
    if degree == 0:
        colors = (0.5 + DEGREE_0 * first).clamp_min(0.0)
    gaussians = Gaussians(params["means"], params["quats"], scales, opacities, colors)
    options = replace(drawing, sh_degree=degree or None, expected_depth=True)
    for index in indices:
        width, height = cameras.sizes[index]
        camera = Cameras(viewmats[index : index + 1].to(device), Ks[index : index + 1].to(device), width, height)
        render, alpha, _ = rasterize(gaussians, camera, options)
        seen = alpha >= MIN_ALPHA  # [1, H, W, 1]
        own = (render[..., :3] / alpha.clamp_min(MIN_ALPHA)).clamp(0, 1)  # The background, black, is taken away.
        depth = torch.where(seen, render[..., 3:], 0.0)
        K = np.asarray(Ks[index], np.float64)
        viewmat = np.asarray(viewmats[index], np.float64)
        yield DepthView(depth[0, ..., 0].cpu().numpy(), own[0].cpu().numpy(), K, viewmat)
