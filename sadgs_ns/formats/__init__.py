"""Files of Gaussians and meshes: each module writes one format, and knows neither torch nor nerfstudio.

A new format is a module with a function `write` and a line in `FORMATS`.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import IO, Literal

from sadgs_ns.errors import InputError
from sadgs_ns.files import atomic_path
from sadgs_ns.formats import compressed_ply, glb, html, ply, sog, spz
from sadgs_ns.formats.gaussians import Gaussians

Frame = Literal["nerfstudio", "colmap"]
"""Coordinates: nerfstudio's, in which z is up, or those of the COLMAP model, in which y mostly is down."""

FORMATS: dict[str, Callable[[IO[bytes], Gaussians, Frame, html.Start | None], None]] = {
    ".ply": lambda file, gaussians, *_: ply.write(file, gaussians),
    ".compressed.ply": lambda file, gaussians, *_: compressed_ply.write(file, gaussians),
    ".spz": lambda file, gaussians, *_: spz.write(file, gaussians),
    ".sog": lambda file, gaussians, *_: sog.write(file, gaussians),
    ".glb": lambda file, gaussians, frame, _: glb.write(file, gaussians, _TO_Y_UP[frame]),
    ".html": lambda file, gaussians, _, start: html.write(file, gaussians, start),
}
"""The writer of each format of Gaussians, by the end of the file's name: a function of an open file, the Gaussians,
their frame, and the camera with which a page opens."""
MESH = ".mesh.ply"
"""End of the name of a triangle mesh."""
_TO_Y_UP = {"nerfstudio": (-(0.5**0.5), 0.0, 0.0, 0.5**0.5), "colmap": (1.0, 0.0, 0.0, 0.0)}
"""Rotations, xyzw, of the frames to one in which y is up."""


def format_of(path: Path) -> str:
    """Return the key of `FORMATS`, or `MESH`, in which a file's name ends; raise InputError for others and folders."""
    found = [suffix for suffix in (*FORMATS, MESH) if path.name.lower().endswith(suffix)]
    if not found:
        raise InputError(f"--output {path} must end in {', '.join(FORMATS)} or {MESH}.")
    if path.is_dir():
        raise InputError(f"--output {path} is a folder: name a file in it.")
    return max(found, key=len)


def write(path: Path, gaussians: Gaussians, frame: Frame = "nerfstudio", start: html.Start | None = None) -> None:
    """Write Gaussians in the format that the file's name asks for; the file appears complete or not at all.

    Only a PLY may hold none, and an HTML page needs a start. Raise InputError if there is nothing to write, or the
    format cannot hold it, and WriteError if the file cannot be written.
    """
    suffix = format_of(path)
    if not len(gaussians) and suffix != ".ply":
        raise InputError(f"{path} would hold no Gaussians: take away fewer of them.")
    with atomic_path(path) as partial, partial.open("wb") as file:
        FORMATS[suffix](file, gaussians, frame, start)
