"""PLY in the layout of the original 3D Gaussian splatting code: the raw parameters in float32, without loss."""

from __future__ import annotations

from pathlib import Path
from typing import IO

import numpy as np

from sadgs_ns.errors import InputError, reason
from sadgs_ns.formats.gaussians import ROWS, Array, Context, Gaussians, of_parameters


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


def read(path: Path) -> Gaussians:
    """Read the Gaussians of such a file, also of another program; raise InputError if it holds none."""
    from plyfile import PlyData

    try:
        vertices = PlyData.read(str(path))["vertex"].data

        def columns(*names: str) -> Array:
            return np.stack([vertices[name] for name in names], axis=1).astype(np.float32)

        num_rest = sum(name.startswith("f_rest_") for name in vertices.dtype.names or ())
        rest = np.zeros((len(vertices), 0, 3), np.float32)
        if num_rest:
            by_color = columns(*(f"f_rest_{index}" for index in range(num_rest))).reshape(len(vertices), 3, -1)
            rest = by_color.transpose(0, 2, 1)  # The file has colour before band.
        params = {
            "means": columns("x", "y", "z"),
            "scales": columns("scale_0", "scale_1", "scale_2"),
            "quats": columns("rot_0", "rot_1", "rot_2", "rot_3"),
            "opacities": columns("opacity"),
            "features_dc": columns("f_dc_0", "f_dc_1", "f_dc_2"),
            "features_rest": rest,
        }
        return of_parameters(params)
    except Exception as error:  # A damaged header may lead plyfile's parser to anything.
        raise InputError(f"{path} cannot be read as a PLY of Gaussians ({reason(error)}): write it again.") from error
