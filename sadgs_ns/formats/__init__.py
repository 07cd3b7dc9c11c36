"""Files of Gaussians and meshes: each module writes one format, and knows neither torch nor nerfstudio."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import IO

from sadgs_ns.errors import InputError
from sadgs_ns.files import atomic_path
from sadgs_ns.formats import compressed_ply, glb, html, ply, sog, spz
from sadgs_ns.formats.gaussians import DEFAULTS, Context, Gaussians

FORMATS: dict[str, Callable[[IO[bytes], Gaussians, Context], None]] = {
    ".ply": ply.write,
    ".compressed.ply": compressed_ply.write,
    ".spz": spz.write,
    ".sog": sog.write,
    ".glb": glb.write,
    ".html": html.write,
}
"""The writer of each format of Gaussians, by the end of the file's name. Help, options and tests iterate over them."""
MESH = ".mesh.ply"  # End of the name of a triangle mesh


def format_of(path: Path) -> str:
    """Return the key of `FORMATS`, or `MESH`, in which a file's name ends; raise InputError for others and folders."""
    name = path.name.lower()
    suffixes = [suffix for suffix in (*FORMATS, MESH) if name.endswith(suffix)]
    if not suffixes:
        raise InputError(f"--output {path} must end in {', '.join(FORMATS)} or {MESH}.")
    if path.is_dir():
        raise InputError(f"--output {path} is a folder: name a file in it.")
    return max(suffixes, key=len)


def write(path: Path, gaussians: Gaussians, context: Context = DEFAULTS) -> None:
    """Write Gaussians in the format that the file's name asks for; the file appears complete or not at all.

    Only a PLY may hold no Gaussians, and an HTML page needs `context.start`. Raise InputError if there are no Gaussians
    to write or if the format cannot hold them, and WriteError if the file cannot be written.
    """
    suffix = format_of(path)
    if not len(gaussians) and suffix != ".ply":
        raise InputError(f"{path} would hold no Gaussians: take away fewer of them.")
    with atomic_path(path) as partial, partial.open("wb") as file:
        FORMATS[suffix](file, gaussians, context)
