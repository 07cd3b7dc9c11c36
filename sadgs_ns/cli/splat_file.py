"""A file of Gaussians as viewers of splats draw it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import torch
from numpy.typing import NDArray

from sadgs_ns.formats import ply
from sadgs_ns.render.rasterization import rasterize
from sadgs_ns.render.types import BackendName, Cameras, Gaussians, RenderOptions


@dataclass(frozen=True)
class Splat:
    """The Gaussians of a file, activated, and the degree of their harmonics."""

    gaussians: Gaussians
    degree: int


def read_splat(file: Path, device: torch.device) -> Splat:
    """Read a PLY in the layout of the original 3D Gaussian splatting code; raise InputError if it cannot be read."""
    stored = ply.read(file)

    def on_device(values: NDArray) -> torch.Tensor:
        return torch.from_numpy(values).to(device)

    gaussians = Gaussians(
        means=on_device(stored.means),
        quats=on_device(stored.quats),
        scales=on_device(stored.scales).exp(),
        opacities=on_device(stored.opacities).sigmoid(),
        colors=(on_device(stored.features_dc), on_device(stored.features_rest)),
    )
    return Splat(gaussians, stored.degree)


def draw(splat: Splat, cameras: Cameras, backend: BackendName = "auto") -> tuple[torch.Tensor, torch.Tensor]:
    """Draw a splat from `NEAR_PLANE` on and without a limit off the axis, since viewers know neither of a run's.

    Args:
        splat: The Gaussians.
        cameras: C of them in the file's frame, on the Gaussians' device.
        backend: The backend that draws.

    Returns:
        Colours without background, which may be above 1, as a photo that is darker than the splat's exposure shows
        them [C, height, width, 3], and accumulated opacity [C, height, width, 1].
    """
    options = RenderOptions(sh_degree=splat.degree, backend=backend)
    colors, alphas, _ = rasterize(splat.gaussians, cameras, options)
    return colors, alphas
