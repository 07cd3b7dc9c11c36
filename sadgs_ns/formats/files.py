"""Which format a file has by its name, and writing it."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from sadgs_ns.atomic import atomic_path
from sadgs_ns.errors import InputError
from sadgs_ns.formats import compressed_ply, glb, html, ply, sog, spz
from sadgs_ns.formats.gaussians import Gaussians

Frame = Literal["nerfstudio", "colmap"]
"""Coordinates: nerfstudio's, in which z is up, or those of the COLMAP model, in which y mostly is down."""

SUFFIXES = (".ply", ".compressed.ply", ".spz", ".sog", ".glb", ".html")
"""Ends of names, one for each format of Gaussians."""
MESH = ".mesh.ply"
"""End of the name of a triangle mesh."""
_TO_Y_UP = {"nerfstudio": (-(0.5**0.5), 0.0, 0.0, 0.5**0.5), "colmap": (1.0, 0.0, 0.0, 0.0)}
"""Rotations, xyzw, of the frames to one in which y is up."""


def format_of(path: Path) -> str:
    """Return one of `SUFFIXES`, or `MESH`.

    Args:
        path: The file that is to be written.

    Raises:
        InputError: If its name has none of these ends, or it is a folder.
    """
    found = [suffix for suffix in (*SUFFIXES, MESH) if path.name.lower().endswith(suffix)]
    if not found:
        raise InputError(f"--output {path} must end in {', '.join(SUFFIXES)} or {MESH}.")
    if path.is_dir():
        raise InputError(f"--output {path} is a folder: name a file in it.")
    return max(found, key=len)


def write(path: Path, gaussians: Gaussians, frame: Frame = "nerfstudio", start: html.Start | None = None) -> None:
    """Write Gaussians in the format that the file's name asks for; the file appears complete or not at all.

    Args:
        path: Created, with its parents, or replaced.
        gaussians: What is written, at least one unless it is a PLY.
        frame: The frame in which they are.
        start: Where an HTML page opens; it must be given for one.

    Raises:
        InputError: If there is nothing to write, or the format cannot hold it.
        WriteError: If the file could not be written.
    """
    suffix = format_of(path)
    if not len(gaussians) and suffix != ".ply":
        raise InputError(f"{path} would hold no Gaussians: take away fewer of them.")
    with atomic_path(path) as partial, partial.open("wb") as file:
        if suffix == ".ply":
            ply.write(file, gaussians)
        elif suffix == ".compressed.ply":
            compressed_ply.write(file, gaussians)
        elif suffix == ".spz":
            spz.write(file, gaussians)
        elif suffix == ".sog":
            sog.write(file, gaussians)
        elif suffix == ".glb":
            glb.write(file, gaussians, _TO_Y_UP[frame])
        else:
            assert start is not None
            html.write(file, gaussians, start)
