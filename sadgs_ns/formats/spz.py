"""SPZ, Niantic's layout, version 3: fixed-point positions, bytes for the rest, and gzip over all; 16 to 65 bytes each.

Positions have 24 bits, as many of them behind the point as the furthest Gaussian leaves. Logarithms of scales are cut
to −10 … 5.94 and have steps of 1/16, opacities have 8 bits, colours steps of 1/38 in the harmonic of degree 0, cut at
±3.33, and quaternions 9 bits and a sign for each of the three smallest components. The higher harmonics are cut at ±1
and have steps of 1/32; Niantic's own, 1/16 in degree 1 and 1/8 above, would make most of a short run's zero.

Axes are those of the PLY, as a record of Adobe's at the end says. Without it some readers, such as Niantic's library,
take a file's axes for OpenGL's, half a turn around x away.
"""

from __future__ import annotations

import gzip
import math
import struct
from typing import IO

import numpy as np
from numpy.typing import NDArray

from sadgs_ns.errors import InputError
from sadgs_ns.formats.gaussians import Context, Gaussians
from sadgs_ns.formats.packing import sigmoid, smallest_three, to_bytes

_MAGIC = 0x5053474E
_VERSION = 3
_MOST_BITS = 20  # Most binary places of positions
_LEAST_BITS = 8  # Fewest binary places of positions: steps of 1/256 of a unit
_RANGE = 1 << 23
_COLOR = 0.15 * 255  # Steps in a unit of the harmonic of degree 0
_AXES = struct.pack("<III", 0xADBE0003, 4, 6)  # Type, length, and axes right, down and forward, as of a PLY
_HAS_RECORDS = 2  # Flag of a file with records after the Gaussians; readers that know none stop before them
_STEP = 4  # Steps of the higher harmonics, in 128ths; gzip makes use of the bits that are always zero


def write(file: IO[bytes], gaussians: Gaussians, _: Context) -> None:
    """Write at least one Gaussian as SPZ; raise InputError if positions would be coarse, or most scales cut."""
    median = float(np.median(gaussians.scales))
    if not -10 < median < 5.94:
        problem = f"Most Gaussians' axes, about {math.exp(median):.1g} units, are beyond the 5e-5 to 380 that SPZ holds"
        raise InputError(f"{problem}: choose another format.")
    bits = _fractional_bits(float(np.abs(gaussians.means).max()))
    steps = np.rint(gaussians.means * np.float64(1 << bits))
    fixed = steps.clip(1 - _RANGE, _RANGE - 1).astype("<i4")  # [N, 3]
    positions = fixed.view(np.uint8).reshape(-1, 3, 4)[:, :, :3]  # The lower 24 of 32 bits
    alphas = to_bytes(255 * sigmoid(gaussians.opacities))
    colors = to_bytes(_COLOR * gaussians.features_dc + 127.5)
    scales = to_bytes(16 * (gaussians.scales + 10))
    rotations = _pack_rotations(gaussians.quats).view(np.uint8)
    harmonics = to_bytes(128 + _STEP * np.rint(128 / _STEP * gaussians.features_rest))
    header = struct.pack("<IIIBBBB", _MAGIC, _VERSION, len(gaussians), gaussians.degree, bits, _HAS_RECORDS, 0)
    with gzip.GzipFile(fileobj=file, mode="wb", compresslevel=6, mtime=0) as compressed:
        compressed.write(header)
        for part in (positions, alphas, colors, scales, rotations, harmonics):
            compressed.write(part.tobytes())
        compressed.write(_AXES)


def _pack_rotations(quats: NDArray[np.float32]) -> NDArray[np.uint32]:
    """Pack quaternions, wxyz: the largest component's index, and 9 bits and a sign of each other. [N, 4] → [N]"""
    xyzw = quats[:, [1, 2, 3, 0]]
    largest, others = smallest_three(xyzw)
    magnitudes = np.rint(np.abs(others) * (511 * math.sqrt(2))).clip(0, 511).astype("<u4")
    signs = (others < 0) << 9
    first, second, third = (magnitudes | signs).T  # [N] each
    packed = largest.astype("<u4") << 30 | first << 20 | second << 10 | third
    return packed.astype("<u4")


def _fractional_bits(reach: float) -> int:
    """Return how many of a position's 23 bits can be behind the point; raise InputError if they are too few."""
    bits_before_the_point = math.floor(math.log2(max(reach, 1e-6))) + 1
    bits = min(_MOST_BITS, 23 - bits_before_the_point)
    if bits < _LEAST_BITS:
        raise InputError(
            f"The Gaussians reach {reach:,.0f} units from the origin, so that SPZ would hold positions in steps "
            f"of over 1/{1 << _LEAST_BITS} of a unit: take the far ones away with --crop, or choose another format."
        )
    return bits
