"""Gaussians → a `.ply` file in the layout of the original 3D Gaussian splatting code, readable by other viewers."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import torch
from plyfile import PlyData, PlyElement
from torch import Tensor

from sadgs_ns.errors import WriteError


@contextmanager
def atomic_path(path: Path, beside: Path | None = None) -> Iterator[Path]:
    """A temporary path that becomes `path` when the block ends well, and vanishes when it raises.

    It is named after `beside` and the same each time, so that the next write replaces what a killed one left.

    Args:
        path: Made with its folder, or replaced.
        beside: A neighbour of the temporary path: `path` itself, unless its folder takes no other files.

    Raises:
        WriteError: If the disk is full or the folder cannot be written.
    """
    path = Path(path)
    neighbour = path if beside is None else beside
    partial = neighbour.with_name(f".{neighbour.stem}.partial{neighbour.suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield partial
        os.replace(partial, path)
    except OSError as error:
        raise WriteError(path, error) from error
    finally:
        with suppress(OSError):  # where even the folder could not be made
            partial.unlink(missing_ok=True)


def write_ply(
    path: Path,
    means: Tensor,
    scales: Tensor,
    quats: Tensor,
    opacities: Tensor,
    features_dc: Tensor,
    features_rest: Tensor,
) -> int:
    """Write Gaussians as binary little-endian PLY.

    The columns are x y z, nx ny nz (zero), f_dc_*, f_rest_* (all of red, then green, then blue), opacity, scale_*,
    rot_*: the raw parameters, as training holds them. Rows with a value that is not finite are dropped, and one printed
    line says how many. The file appears complete or not at all.

    Args:
        path: Created, with its parents, or replaced.
        means: Positions, in whatever frame the caller wants to see. [N, 3]
        scales: Log of the standard deviations. [N, 3]
        quats: wxyz; written normalised. [N, 4]
        opacities: Logits. [N, 1] or [N]
        features_dc: Spherical harmonics of degree 0. [N, 3]
        features_rest: The higher degrees. [N, K, 3], K may be 0.

    Returns:
        The number of Gaussians written.

    Raises:
        ValueError: If a tensor has another shape than the number of means asks for, naming it.
        WriteError: If the file could not be written.
    """
    count = len(means)
    bands = features_rest.shape[1] if features_rest.dim() == 3 else 0
    columns: dict[str, tuple[Tensor, tuple[int, ...]]] = {
        "means": (means, (count, 3)),
        "features_dc": (features_dc, (count, 3)),
        "features_rest": (features_rest, (count, bands, 3)),
        "opacities": (opacities if opacities.dim() == 2 else opacities[:, None], (count, 1)),
        "scales": (scales, (count, 3)),
        "quats": (quats, (count, 4)),
    }
    for name, (tensor, shape) in columns.items():
        if tuple(tensor.shape) != shape:
            raise ValueError(f"{name} must have the shape {list(shape)}, got {list(tensor.shape)}")
    with torch.no_grad():
        rest = features_rest.transpose(1, 2).reshape(count, 3 * bands)  # colour before band
        parts = [means, torch.zeros_like(means), features_dc, rest, columns["opacities"][0], scales]
        parts.append(torch.nn.functional.normalize(quats, dim=-1))
        table = torch.cat([part.float() for part in parts], -1).cpu().numpy()  # [N, 17 + 3 K]
    finite = np.isfinite(table).all(axis=1)
    if not finite.all():
        print(f"{path}: dropped {count - int(finite.sum())} of {count} Gaussians that are not finite")
        table = table[finite]
    names = [
        "x",
        "y",
        "z",
        "nx",
        "ny",
        "nz",
        *(f"f_dc_{i}" for i in range(3)),
        *(f"f_rest_{i}" for i in range(3 * bands)),
    ]
    names += ["opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    rows = np.ascontiguousarray(table, dtype="<f4").view([(name, "<f4") for name in names]).reshape(-1)
    with atomic_path(path) as partial:
        PlyData([PlyElement.describe(rows, "vertex")], byte_order="<").write(str(partial))
    return len(rows)
