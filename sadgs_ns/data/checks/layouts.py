"""Layouts of a capture's folder, and what to say where there is none that is known."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from sadgs_ns.data.checks.images import Rounding, images_in
from sadgs_ns.errors import InputError

COLMAP_FOLDERS = ("colmap/sparse/0", "sparse/0", "sparse", "colmap")
"""Folders in which a reconstruction is looked for; nerfstudio's default is the first."""
GIVE_POSES = "compute poses with `sadgs-process PHOTOS FOLDER` or `ns-process-data`"
"""Remedy where poses are missing, as the end of a sentence."""


@dataclass(frozen=True)
class ParserOptions:
    """Options of nerfstudio's parsers, by the names that they have there; each layout reads those of its parser."""

    images_path: Path = Path("images")
    colmap_path: Path = Path(COLMAP_FOLDERS[0])
    masks_path: Path | None = None
    ply_path: Path | None = None
    downscale_factor: int | None = None
    downscale_rounding_mode: Rounding = "floor"
    load_3D_points: bool = True
    eval_mode: str = "fraction"
    train_split_fraction: float = 0.9
    eval_interval: int = 8

    def __post_init__(self) -> None:
        if self.downscale_factor is not None and self.downscale_factor < 1:
            raise InputError(f"downscale-factor must be at least 1, got {self.downscale_factor}.")


def find_reconstruction(data: Path) -> Path | None:
    """Return the folder of a COLMAP reconstruction, relative to the data, or None."""
    for folder in COLMAP_FOLDERS:
        if any((data / folder / f"cameras.{kind}").is_file() for kind in ("txt", "bin")):
            return Path(folder)
    return None


def layout_of(data: Path) -> Literal["nerfstudio", "blender", "colmap"] | None:
    """Return how a capture's folder, or file, is laid out; None if nothing that is known lies there."""
    if data.is_file() or (data / "transforms.json").is_file():
        return "nerfstudio"
    if (data / "transforms_train.json").is_file():
        return "blender"
    return None if find_reconstruction(data) is None else "colmap"


def no_layout(data: Path) -> str:
    """Return the sentence for a folder without poses."""
    models = [data / folder for folder in COLMAP_FOLDERS]
    files = [folder / f"cameras.{kind}" for folder in models for kind in ("txt", "bin")]
    for path in (data, data / "transforms.json", data / "transforms_train.json", *models, *files):
        if path.is_symlink() and not path.exists():
            return f"{path} is a link that leads nowhere: put there what it should lead to."
    if not data.exists():
        return f"{data} does not exist: give --data the folder of a capture."
    if data.is_file():
        return f"{data} is a file: give --data the folder of a capture."
    around = data.absolute()
    for other in around.parents[:3]:
        inside = around.relative_to(other).parts[0]
        if (inside.startswith("images") or inside in ("masks", "sparse", "colmap")) and layout_of(other) is not None:
            return f"{data} is a part of the capture {other}: give --data that folder."
    for photos in (data, data / "images"):
        if images := images_in(photos):
            command = f"`sadgs-process {shlex.quote(str(photos))} FOLDER`"
            return f"{data} holds {len(images)} images but no camera poses: compute them with {command}."
    for other in sorted(data.iterdir())[:100]:
        if other.is_dir() and layout_of(other) is not None:
            return f"{data} is no capture, but {other} in it is one: give --data that folder."
    return (
        f"{data.absolute()} holds neither transforms.json nor a COLMAP reconstruction ({', '.join(COLMAP_FOLDERS)}): "
        f"give --data another folder, or {GIVE_POSES}."
    )
