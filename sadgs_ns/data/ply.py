"""Reader of SfM points of a PLY file, without open3d, which needs a system library and most of a second to import."""

from __future__ import annotations

import io
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sadgs_ns.errors import InputError, reason

_CHANNELS = (("red", "green", "blue"), ("r", "g", "b"))  # Names that programs give to colours, in small letters
_PREFIXES = ("", "diffuse_", "scalar_", "vertex_", "color_")  # These may stand before them.
_COEFFICIENTS = [f"f_dc_{index}" for index in range(3)]  # Names that splats' files give to harmonics of degree 0
_C0 = 0.5 / math.sqrt(math.pi)  # The spherical harmonic of degree 0
GREY = 127  # Colour of points without one, in 0 … 255


def read_points(path: Path) -> tuple[NDArray[np.float64], NDArray[np.uint8]]:
    """Return positions [P, 3] in the file's frame and colours in 0 … 255 [P, 3] of a PLY file, text or binary.

    Colours in the file may be of any type and reach to 1 (if they are floating-point numbers), 255 or 65,535, as the
    largest one shows. Those of a splat are its harmonics of degree 0. Points without colours are grey. Raise
    InputError if the file is broken or holds no points.
    """
    try:
        vertices = _read_vertices(path)
        positions = np.stack([vertices[axis] for axis in "xyz"], axis=-1).astype(np.float64)
    except InputError:
        raise
    except OSError as error:
        raise InputError(f"{path} cannot be read ({reason(error)}): restore it.") from error
    except Exception as error:  # A damaged header may lead plyfile's parser to anything.
        raise InputError(f"{path} is not a PLY file of points ({reason(error)}): restore it.") from error
    channels = _find_channels(vertices.dtype)
    if channels is None and set(_COEFFICIENTS) <= set(vertices.dtype.names or ()):
        coefficients = np.stack([vertices[name] for name in _COEFFICIENTS], axis=-1).astype(np.float64)  # [P, 3]
        values = 255 * (0.5 + _C0 * np.nan_to_num(coefficients))
        return positions, np.rint(values.clip(0, 255)).astype(np.uint8)
    if channels is None:
        return positions, np.full(positions.shape, GREY, np.uint8)
    colors = np.stack([vertices[channel] for channel in channels], axis=-1).astype(np.float64)  # [P, 3]
    largest = colors[np.isfinite(colors)].max(initial=0.0)
    if largest <= 1 and vertices.dtype[channels[0]].kind == "f":
        colors *= 255
    elif largest > 255:
        colors *= 255 / 65535
    return positions, np.rint(np.nan_to_num(colors)).clip(0, 255).astype(np.uint8)


def _find_channels(dtype: np.dtype[Any]) -> list[str] | None:
    """Return the names of red, green and blue among the numbers of a vertex, or None if they are not there."""
    numbers = {name.lower(): name for name in dtype.names or () if dtype[name].kind in "fiu"}
    for prefix in _PREFIXES:
        for channels in _CHANNELS:
            names = [prefix + channel for channel in channels]
            if all(name in numbers for name in names):
                return [numbers[name] for name in names]
    return None


def _read_vertices(path: Path) -> NDArray[Any]:
    """Return the vertices as a structured array [P]; numpy reads text, where plyfile takes 30 µs a point."""
    from plyfile import PlyData

    with path.open("rb") as file:
        found = re.match(rb".*?end_header\s*?\n", file.read(1 << 16), re.DOTALL)
        header = b""
        if found:
            header = found[0]
        # plyfile reads the data after a header at once, so it is given a header that promises none.
        empty_header = re.sub(rb"(?m)^(element\s+\S+)\s+\d+", rb"\1 0", header)
        empty = PlyData.read(io.BytesIO(empty_header))
        if "vertex" not in empty:
            raise ValueError("it has no vertices")
        count = int(re.findall(rb"(?m)^element\s+vertex\s+(\d+)", header)[0])
        dtype = np.dtype(empty["vertex"].dtype())
        if count == 0:
            return np.empty(0, dtype)
        vertices_come_first = empty.elements[0].name == "vertex"
        has_lists = dtype.hasobject
        if empty.text and vertices_come_first and not has_lists:
            file.seek(len(header))
            lines = sum(1 for _ in file)
            if lines < count:
                raise InputError(f"{path} is cut off: its header promises {count} points: restore it.")
            file.seek(len(header))
            return np.loadtxt(file, dtype, comments=None, max_rows=count, ndmin=1)
    return PlyData.read(str(path))["vertex"].data
