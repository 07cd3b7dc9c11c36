"""Gaussians as cameras see them, which is all that compositing takes."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor


class Projected(NamedTuple):
    """N Gaussians in each of C cameras; where the radii are zero, the other rows have no meaning."""

    radii: Tensor
    """px, int32 [C, N] of gsplat 1.4 or [C, N, 2] of 1.5; not positive where a Gaussian is not drawn."""
    means2d: Tensor
    """Centres in px. [C, N, 2]"""
    depths: Tensor
    """Along the viewing axis, in world units. [C, N]"""
    conics: Tensor
    """(a, b, c) of the inverse of the blurred Σ2D, in 1/px². [C, N, 3]"""
    opacities: Tensor
    """In [0, 1], compensated for the blur where that was asked for. [C, N]"""
    colors: Tensor
    """[C, N, D]"""
