"""Compressed PLY, PlayCanvas's layout: 16 bytes for each Gaussian, in chunks of 256.

Between a chunk's extremes positions and scales have 11, 10 and 11 bits, and colours 8. Opacities have 8 bits, the three
smallest components of quaternions 10, the higher harmonics 8 in ±4 (errors up to 1/64). Scales are cut at e^±20.
"""

from __future__ import annotations

from typing import IO

import numpy as np
from numpy.typing import NDArray

from sadgs_ns.formats.gaussians import DEGREE_0, Context, Gaussians
from sadgs_ns.formats.packing import morton_order, sigmoid, smallest_three

_CHUNK = 256  # Number of Gaussians that share their extremes
_HARMONICS_SPAN = 8.0  # The higher harmonics lie between −4 and 4


def write(file: IO[bytes], gaussians: Gaussians, _: Context) -> None:
    """Write at least one Gaussian as compressed PLY, in an order that keeps neighbours in one chunk."""
    gaussians = gaussians[morton_order(gaussians.means)]
    count, bands = gaussians.features_rest.shape[:2]
    colors = np.float32(DEGREE_0) * gaussians.features_dc + np.float32(0.5)
    mean_shares, mean_extremes = _in_chunk(gaussians.means)
    scale_shares, scale_extremes = _in_chunk(gaussians.scales.clip(-20, 20))
    color_shares, color_extremes = _in_chunk(colors)
    largest, others = smallest_three(gaussians.quats)
    other_shares = others * np.float32(np.sqrt(0.5)) + 0.5
    alphas = _steps(sigmoid(gaussians.opacities), 8)
    positions = _pack(mean_shares, (11, 10, 11))
    rotations = largest.astype("<u4") << 30 | _pack(other_shares, (10, 10, 10))
    scales = _pack(scale_shares, (11, 10, 11))
    colors_and_alphas = _pack(color_shares, (8, 8, 8)) << 8 | alphas
    extremes = np.concatenate([mean_extremes, scale_extremes, color_extremes], axis=1)  # [chunks, 18]
    packed = np.stack([positions, rotations, scales, colors_and_alphas], axis=1)  # [N, 4]
    file.write(_header(count, len(extremes), bands))
    file.write(extremes.astype("<f4").tobytes())
    file.write(packed.astype("<u4").tobytes())
    if bands:
        rest = gaussians.features_rest.transpose(0, 2, 1).reshape(count, -1)  # The file has colour before band.
        steps = np.floor((rest / _HARMONICS_SPAN + 0.5) * 256)
        file.write(steps.clip(0, 255).astype(np.uint8).tobytes())


def _header(count: int, chunks: int, bands: int) -> bytes:
    """Return the header of a file with so many Gaussians, chunks and higher harmonics of each colour."""
    lines = ["ply", "format binary_little_endian 1.0", "comment sadgs_ns"]
    lines.append(f"element chunk {chunks}")
    for prefix, axes in (("", "xyz"), ("scale_", "xyz"), ("", "rgb")):
        for end in ("min", "max"):
            lines += [f"property float {end}_{prefix}{axis}" for axis in axes]
    lines.append(f"element vertex {count}")
    lines += [f"property uint packed_{name}" for name in ("position", "rotation", "scale", "color")]
    if bands:
        lines.append(f"element sh {count}")
        lines += [f"property uchar f_rest_{index}" for index in range(3 * bands)]
    lines.append("end_header\n")
    return "\n".join(lines).encode()


def _in_chunk(values: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return values [N, 3] as shares between their chunk's extremes, in [0, 1], and these, lowest first [chunks, 6]."""
    starts = np.arange(0, len(values), _CHUNK)
    low = np.minimum.reduceat(values, starts)
    high = np.maximum.reduceat(values, starts)
    chunk = np.arange(len(values)) // _CHUNK
    span = np.where(high > low, high - low, np.float32(1))
    above = values - low[chunk]
    shares = above / span[chunk]
    extremes = np.concatenate([low, high], axis=1)
    return shares.astype(np.float32), extremes


def _steps(shares: NDArray[np.float32], bits: int) -> NDArray[np.uint32]:
    """Quantise shares, in [0, 1]. [N] → [N]"""
    most = (1 << bits) - 1
    steps = np.floor(shares * most + np.float32(0.5))
    return steps.clip(0, most).astype(np.uint32)


def _pack(shares: NDArray[np.float32], bits: tuple[int, int, int]) -> NDArray[np.uint32]:
    """Quantise three shares into one number, the first into its highest bits. [N, 3] → [N]"""
    packed = np.zeros(len(shares), np.uint32)
    for values, number in zip(shares.T, bits, strict=True):
        packed = packed << np.uint32(number) | _steps(values, number)
    return packed
