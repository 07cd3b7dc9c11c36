"""PLY in the layout of the original 3D Gaussian splatting code: the raw parameters in float32, without loss."""

from __future__ import annotations

from typing import IO

import numpy as np

from sadgs_ns.formats.gaussians import ROWS, Context, Gaussians


def write(file: IO[bytes], gaussians: Gaussians, _: Context) -> None:
    """Write Gaussians as binary little-endian PLY.

    Columns: x y z, nx ny nz (zero), f_dc_*, f_rest_* (all of red, then green, blue), opacity, scale_*, rot_* (wxyz).
    """
    names = ["x", "y", "z", "nx", "ny", "nz"]
    names += [f"f_dc_{index}" for index in range(3)]
    names += [f"f_rest_{index}" for index in range(3 * gaussians.features_rest.shape[1])]
    names.append("opacity")
    names += [f"scale_{index}" for index in range(3)]
    names += [f"rot_{index}" for index in range(4)]
    lines = ["ply", "format binary_little_endian 1.0", "comment sadgs_ns"]
    lines.append(f"element vertex {len(gaussians)}")
    lines += [f"property float {name}" for name in names]
    lines.append("end_header\n")
    file.write("\n".join(lines).encode())
    for start in range(0, len(gaussians), ROWS):
        part = gaussians[start : start + ROWS]
        normals = np.zeros_like(part.means)
        rest = part.features_rest.transpose(0, 2, 1).reshape(len(part), -1)  # The file has colour before band.
        opacities = part.opacities[:, None]  # [rows, 1]
        columns = [part.means, normals, part.features_dc, rest, opacities, part.scales, part.quats]
        rows = np.concatenate(columns, axis=1)
        file.write(rows.astype("<f4").tobytes())
