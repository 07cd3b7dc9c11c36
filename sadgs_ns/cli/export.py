"""`sadgs-export RUN --output FILE.ply`: a run's Gaussians in the layout of the original 3D Gaussian splatting code."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from sadgs_ns.atomic import atomic_path
from sadgs_ns.data.coordinates import TRANSFORMS_NAME, Similarity, from_data
from sadgs_ns.errors import InputError, RunError, WriteError

if TYPE_CHECKING:  # torch takes seconds, which `--help` and a wrong path need not wait for
    from torch import Tensor

Frame = Literal["nerfstudio", "colmap"]

_ROWS = 1 << 16
"""Number of Gaussians that are converted at a time, so that writing takes little memory beyond their own."""
_PREFIX = "_model.gauss_params."
_DEGREE_0 = 0.5 / np.sqrt(np.pi)
"""The spherical harmonic of degree 0."""
_REMEDY = "give another checkpoint step-*.ckpt of a run of sadgs or splatfacto"
"""What to do about a checkpoint that cannot be used."""


def write_ply(
    path: Path,
    means: Tensor,
    scales: Tensor,
    quats: Tensor,
    opacities: Tensor,
    features_dc: Tensor,
    features_rest: Tensor,
    similarity: Similarity | None = None,
) -> int:
    """Write Gaussians as binary little-endian PLY.

    The columns are x y z, nx ny nz (zero), f_dc_*, f_rest_* (all of red, then green, then blue), opacity, scale_*,
    rot_*: the raw parameters, as training holds them. Rows with a value that is not finite are dropped, and one printed
    line says how many. The file appears complete or not at all.

    Args:
        path: Created, with its parents, or replaced.
        means: Positions. [N, 3]
        scales: Log of the standard deviations. [N, 3]
        quats: wxyz; written normalised. [N, 4]
        opacities: Logits. [N, 1] or [N]
        features_dc: Spherical harmonics of degree 0. [N, 3]
        features_rest: The higher degrees. [N, K, 3] with a K of 0, 3, 8 or 15.
        similarity: From the Gaussians' frame to the file's; None leaves them as they are.

    Returns:
        The number of Gaussians written.

    Raises:
        ValueError: If a tensor has another shape than the number of means asks for, naming it.
        WriteError: If the file could not be written.
    """
    count = len(means)
    bands = features_rest.shape[1] if features_rest.dim() == 3 else 0
    if bands not in (0, 3, 8, 15):
        raise ValueError(f"features_rest must hold the 0, 3, 8 or 15 harmonics of degree 1 to 3, got {bands}")
    shapes: dict[str, tuple[Tensor, tuple[int, ...]]] = {
        "means": (means, (count, 3)),
        "features_dc": (features_dc, (count, 3)),
        "features_rest": (features_rest, (count, bands, 3)),
        "opacities": (opacities if opacities.dim() == 2 else opacities[:, None], (count, 1)),
        "scales": (scales, (count, 3)),
        "quats": (quats, (count, 4)),
    }
    for name, (tensor, shape) in shapes.items():
        if tuple(tensor.shape) != shape:
            raise ValueError(f"{name} must have the shape {list(shape)}, got {list(tensor.shape)}")
    params = {name: tensor.detach() for name, (tensor, _) in shapes.items()}
    rotate = None if similarity is None else similarity.harmonics(degree=round((bands + 1) ** 0.5) - 1)[1:, 1:]
    written = 0
    with atomic_path(path) as partial, partial.open("wb") as file:
        file.write(_header(count, bands, most=count))
        for start in range(0, count, _ROWS):
            chunk = {name: value[start : start + _ROWS].cpu().double().numpy() for name, value in params.items()}
            rows = _rows(chunk, similarity, rotate)
            finite = np.isfinite(rows).all(axis=1)
            rows = rows if finite.all() else rows[finite]
            file.write(rows.data)
            written += len(rows)
        file.seek(0)
        file.write(_header(written, bands, most=count))
    if written < count:
        print(f"{path}: dropped {count - written} of {count} Gaussians that are not finite")
    return written


def _rows(
    params: Mapping[str, NDArray[np.float64]], similarity: Similarity | None, rotate: NDArray[np.float64] | None
) -> NDArray[np.float32]:
    """Return Gaussians as the file holds them. [n, 17 + 3 K]"""
    means, scales, quats = params["means"], params["scales"], params["quats"]
    rest = params["features_rest"].transpose(0, 2, 1)  # [n, 3, K]: the file has colour before band
    with np.errstate(all="ignore"):  # what is, or becomes, infinite is dropped
        if similarity is not None and rotate is not None:
            means, scales = similarity.positions(means), similarity.log_scales(scales)
            quats = similarity.rotations(quats)
            rest = rest.reshape(-1, len(rotate)) @ rotate.T if len(rotate) else rest
        quats = quats / np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-12)
        parts = [means, np.zeros_like(means), params["features_dc"], rest.reshape(len(means), -1)]
        return np.concatenate([*parts, params["opacities"], scales, quats], axis=1).astype("<f4")


def _header(count: int, bands: int, most: int) -> bytes:
    """Return the file's head, equally long for every count up to `most`, since the count is known only at the end."""
    padding = " " * (len(str(most)) - len(str(count)))
    names = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3))]
    names += [f"f_rest_{i}" for i in range(3 * bands)]
    names += ["opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    lines = ["ply", "format binary_little_endian 1.0", f"comment sadgs_ns{padding}", f"element vertex {count}"]
    return "\n".join([*lines, *(f"property float {name}" for name in names), "end_header\n"]).encode()


def export(run: Path, output: Path, frame: Frame = "nerfstudio") -> int:
    """Write the Gaussians of a run of sadgs or splatfacto.

    Nothing in the run's folder is executed, not even its `config.yml`, and the data need not be there any more.

    Args:
        run: The run's folder, its `config.yml`, or one of its checkpoints; without one the latest is taken.
        output: The PLY.
        frame: "nerfstudio" is the frame of training: centred, upright, cameras within ±1. "colmap" is that of the
            COLMAP model, or of `transforms.json` where no COLMAP model stands behind it.

    Returns:
        The number of Gaussians written.

    Raises:
        InputError: If the run or the output cannot be used.
        WriteError: If the file could not be written.
    """
    if output.suffix.lower() != ".ply":
        raise InputError(f"--output {output} must end in .ply, the one format that is written.")
    if output.is_dir():
        raise InputError(f"--output {output} is a folder: name a file in it.")
    checkpoint = _checkpoint_of(run)
    similarity = None
    if frame == "colmap":
        folders = checkpoint.absolute().parents[:2]
        path = next((folder / TRANSFORMS_NAME for folder in folders if (folder / TRANSFORMS_NAME).is_file()), None)
        if path is None:
            raise InputError(
                f"{folders[-1]} holds no {TRANSFORMS_NAME}, where nerfstudio notes how it moved the data: give the run "
                "where it was made, or export in nerfstudio's frame."
            )
        similarity = from_data(path).inverse()
    params = _read(checkpoint, latest=checkpoint != run)
    if params["features_rest"].shape[1] == 0:  # then training holds colours' logits
        params["features_dc"] = (params["features_dc"].sigmoid() - 0.5) / _DEGREE_0
    try:
        return write_ply(output, **params, similarity=similarity)
    except ValueError as error:
        raise InputError(f"{checkpoint} holds no Gaussians that can be exported ({error}): {_REMEDY}.") from error


def _checkpoint_of(run: Path) -> Path:
    """Return the checkpoint that a run's folder, its `config.yml` or the checkpoint itself names."""
    if run.suffix == ".ckpt" and run.is_file():
        return run
    folder = run.parent if run.is_file() else run
    found = [*folder.glob("step-*.ckpt"), *folder.glob("*/step-*.ckpt")]
    found = [path for path in found if path.stem[5:].isdecimal()]
    if not found:
        what = "does not exist" if not run.exists() else "holds no checkpoint"
        raise InputError(f"{run} {what}: give the folder of a run, its config.yml or a checkpoint step-*.ckpt.")
    return max(found, key=lambda path: int(path.stem[5:]))


def _read(checkpoint: Path, latest: bool) -> dict[str, Tensor]:
    """Return the Gaussians' parameters, mapped from the file, so that what is not written takes no memory."""
    # torch, which both import, takes seconds, and `--help` and a wrong path need not wait for it.
    from torch import Tensor

    from sadgs_ns.plugin import checkpoints

    folder, single = (checkpoint.parent, None) if latest else (None, checkpoint)
    chosen = checkpoints.read_chosen(folder, None, single, _REMEDY, mmap=True)
    assert chosen is not None
    checkpoint, state = chosen
    loaded = state["pipeline"] if isinstance(state["pipeline"], dict) else {}
    params = {}
    for name in ("means", "scales", "quats", "opacities", "features_dc", "features_rest"):
        value = loaded.get(_PREFIX + name)
        if not isinstance(value, Tensor) or value.dim() < 2:
            raise InputError(f"{checkpoint} holds no {name} of Gaussians, so another method made it: {_REMEDY}.")
        params[name] = value
    return params


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code, 2 if the run or the output cannot be used."""
    parser = argparse.ArgumentParser(
        prog="sadgs-export",
        description="Write a trained run's Gaussians as the PLY that viewers of 3D Gaussian splatting read. It needs "
        "neither a GPU nor the data, and executes nothing of the run's files.",
    )
    parser.add_argument("run", type=Path, help="folder of a run, its config.yml, or one of its checkpoints")
    parser.add_argument("--output", "-o", type=Path, required=True, metavar="FILE.ply", help="the PLY to write")
    parser.add_argument(
        "--frame",
        choices=["nerfstudio", "colmap"],
        default="nerfstudio",
        help="coordinates: nerfstudio's, centred, upright and with cameras within ±1, or those of the COLMAP model or "
        "transforms.json that the data came with (default %(default)s)",
    )
    given = parser.parse_args(argv)
    try:
        count = export(given.run, given.output, given.frame)
    except (InputError, RunError, WriteError) as error:
        print(f"sadgs-export: {error}", file=sys.stderr)
        return 2
    size = given.output.stat().st_size
    print(f"{given.output}: {count:,} Gaussians, {size / 1e6:,.1f} MB, in the frame of {given.frame}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
