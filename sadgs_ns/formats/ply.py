"""PLY in the layout of the original 3D Gaussian splatting code: the raw parameters in float32, without loss."""

from __future__ import annotations

from typing import IO

import numpy as np

from sadgs_ns.formats.gaussians import ROWS, Context, Gaussians


def write(file: IO[bytes], gaussians: Gaussians, _: Context) -> None:
    """Write Gaussians as binary little-endian PLY.

    Columns: x y z, nx ny nz (zero), f_dc_*, f_rest_* (all of red, then green, blue), opacity, scale_*, rot_* (wxyz).
    """
    names = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3))]
    names += [f"f_rest_{i}" for i in range(3 * gaussians.features_rest.shape[1])]
    names += ["opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    lines = ["ply", "format binary_little_endian 1.0", "comment sadgs_ns", f"element vertex {len(gaussians)}"]
    file.write("\n".join([*lines, *(f"property float {name}" for name in names), "end_header\n"]).encode())
    for start in range(0, len(gaussians), ROWS):
        part = gaussians[start : start + ROWS]
        rest = part.features_rest.transpose(0, 2, 1).reshape(len(part), -1)  # The file has colour before band.
        columns = [part.means, np.zeros_like(part.means), part.features_dc, rest, part.opacities[:, None]]
        file.write(np.concatenate([*columns, part.scales, part.quats], axis=1).astype("<f4").tobytes())
