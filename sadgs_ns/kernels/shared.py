"""`render.rasterization.visible` for use inside other kernels: which Gaussians the rasterizer drew."""

from __future__ import annotations

import triton
import triton.language as tl


@triton.jit
def drawn(radii, at, exists, PER_GAUSSIAN: tl.constexpr):
    """Return whether the Gaussian at index `at` in C · N was drawn, by one radius (gsplat 1.4) or two (gsplat 1.5)."""
    radius = tl.load(radii + PER_GAUSSIAN * at, exists, 0)
    if PER_GAUSSIAN == 2:
        radius = tl.minimum(radius, tl.load(radii + 2 * at + 1, exists, 0))
    return exists & (radius > 0)
