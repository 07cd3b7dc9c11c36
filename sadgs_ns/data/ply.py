"""SfM points of a PLY file, without open3d, which needs a system library and most of a second to import."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sadgs_ns.errors import InputError, reason

GREY = 127
"""Of points without colours."""


def read_points(path: Path) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Positions and colours of the vertices.

    Args:
        path: A PLY file, text or binary; colours as numbers of 0 … 255, or floating-point ones of 0 … 1.

    Returns:
        Positions [P, 3] in the file's frame and colours [P, 3] in 0 … 255.

    Raises:
        InputError: If it is not a PLY file of points.
    """
    from plyfile import PlyData

    try:
        vertices = PlyData.read(str(path))["vertex"].data
        positions = np.stack([vertices[axis] for axis in "xyz"], axis=-1).astype(np.float32)
    except Exception as error:  # plyfile's parser is strict, but what a damaged header leads it to is open
        raise InputError(f"{path} is not a PLY file of points ({reason(error)}): restore it.") from error
    if not {"red", "green", "blue"} <= set(vertices.dtype.names):
        return positions, np.full(positions.shape, GREY, np.uint8)
    colors = np.stack([vertices[channel] for channel in ("red", "green", "blue")], axis=-1)
    if colors.dtype.kind == "f":
        colors = np.rint(255 * colors.clip(0, 1))
    return positions, colors.clip(0, 255).astype(np.uint8)
