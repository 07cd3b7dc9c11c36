"""Gaussians, cameras and options of rendering. Shapes and units stand here, and at no function that passes these on.

C is a number of views of one size, N one of Gaussians.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import torch
from torch import Tensor

from sadgs_ns.gsplat_compat import NEAR_PLANE

BackendName = Literal["auto", "triton", "gsplat", "torch"]


class Gaussians(NamedTuple):
    """Gaussians in the world, activated."""

    means: Tensor
    """Centres. [N, 3]"""
    quats: Tensor
    """wxyz, of any length. [N, 4]"""
    scales: Tensor
    """Standard deviations along the axes, in world units, > 0. [N, 3]"""
    opacities: Tensor
    """In [0, 1]. [N]"""
    colors: Tensor | tuple[Tensor, Tensor]
    """With `RenderOptions.sh_degree`, coefficients of spherical harmonics: [(C,) N, K, 3], or the pair of those of
    degree 0 [N, 3] and of the others [N, K − 1, 3]. Otherwise D features of any kind [(C,) N, D]."""

    def joined_colors(self) -> Tensor:
        """Return the colours as one tensor, coefficients of all degrees [N, K, 3] if they are a pair."""
        if isinstance(self.colors, tuple):
            return torch.cat([self.colors[0][:, None], self.colors[1]], dim=1)
        return self.colors


class Cameras(NamedTuple):
    """Pinhole cameras with images of width × height px."""

    viewmats: Tensor
    """World to camera, rigid, OpenCV axes (x right, y down, z forward). [C, 4, 4]"""
    Ks: Tensor
    """Intrinsics in px. [C, 3, 3]"""
    width: int
    height: int


@dataclass(frozen=True)
class RenderOptions:
    """How Gaussians are drawn."""

    sh_degree: int | None = None
    """Degree of the harmonics to evaluate, (sh_degree + 1)² ≤ K; None takes colours as they are."""
    near_plane: float = NEAR_PLANE
    """Gaussians whose centre is nearer along the viewing axis are not drawn, in world units."""
    max_off_axis: float = 0.0
    """Gaussians centred more half images from the image's centre in x or y are not drawn (off_axis.py); 0 draws all."""
    expected_depth: bool = False
    """Whether the expected depth is rendered as one more channel."""
    absgrad: bool = False
    """Whether `backward` sets `absgrad` of the projected centres, the sum of their absolute gradients. [C, N, 2]
    The Triton backend does so for three channels, without expected depth."""
    tile_capacity: int | None = None
    """Number of pairs of a Gaussian and a tile, in all views, for which the Triton backend makes room; None waits for
    the exact number. If there are more, nothing is drawn, no gradient flows and all radii are 0."""
    backend: BackendName = "auto"
    """The backend that draws (`rasterization.choose_backend`)."""


DEFAULTS = RenderOptions()
"""All Gaussians from NEAR_PLANE on, in colours that do not depend on the direction."""


class Projected(NamedTuple):
    """Gaussians as cameras of width × height px see them; they are drawn in a view where their radii are positive."""

    radii: Tensor
    """px, int32 [C, N] of gsplat 1.4 or [C, N, 2] of 1.5. Where one is not positive, other tensors mean nothing."""
    means2d: Tensor
    """Centres in px. [C, N, 2]"""
    depths: Tensor
    """Along the viewing axis, in world units. [C, N]"""
    conics: Tensor
    """(a, b, c) of the inverse of the blurred Σ2D, in 1/px². [C, N, 3]"""
    opacities: Tensor
    """In [0, 1]. [C, N]"""
    colors: Tensor
    """[C, N, D]"""
    width: int
    height: int
    tiles: Any = None
    """Tile lists that the Triton backend has begun (`kernels.tiles.PendingTiles`)."""

    def info(self) -> dict[str, Any]:
        """Return the part of gsplat's `info` that strategies read; read `radii` through `rasterization.visible`."""
        names = ("radii", "means2d", "depths", "conics", "opacities", "width", "height")
        return {name: getattr(self, name) for name in names} | {"n_cameras": len(self.means2d)}
