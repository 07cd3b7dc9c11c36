"""Layouts of a capture's folder: which one it has, and where its poses and images are."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from sadgs_ns.data import colmap, images
from sadgs_ns.data.images import Rounding
from sadgs_ns.errors import InputError, reason

COLMAP_FOLDERS = ("colmap/sparse/0", "sparse/0", "sparse", "colmap")  # Places of a reconstruction, nerfstudio's first
_MOST_FOLDERS = 100  # In which the images of a reconstruction are looked for


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


def layout_of(data: Path) -> Literal["nerfstudio", "blender", "colmap"] | None:
    """Return the layout of a capture's folder or file, or None if it is unknown; raises as `find_reconstructions`."""
    if data.is_file() or (data / "transforms.json").is_file():
        return "nerfstudio"
    if (data / "transforms_train.json").is_file():
        return "blender"
    if _model_folders(data):
        return "colmap"
    return None


def transforms_path(data: Path) -> Path:
    """Return the JSON file of a capture, which is given as that file, or as a folder with a `transforms.json`."""
    if data.suffix == ".json":
        return data
    return data / "transforms.json"


def find_reconstructions(data: Path) -> dict[Path, list[str]]:
    """Return the folders of COLMAP's reconstructions, relative to the data, and the names of each one's images.

    The first is the one to read: one in a usual place, or else the one with the most images. A reconstruction directly
    in the data's folder counts if there is no other and its images are there. Raise InputError if its poses cannot be
    read. One elsewhere that cannot be read has no names.
    """
    models: dict[Path, list[str]] = {}
    for folder in _model_folders(data):
        models[folder] = []
        with contextlib.suppress(InputError):
            models[folder] = colmap.image_names(data / folder)

    def order(folder: Path) -> tuple[bool, int]:
        if str(folder) in COLMAP_FOLDERS:
            return False, 0
        return True, -len(models[folder])

    return {folder: models[folder] for folder in sorted(models, key=order)}


def _model_folders(data: Path) -> list[Path]:
    """Return the folders of a capture that have a file of COLMAP's cameras, the usual ones first.

    Raises as `find_reconstructions`.
    """
    folders = [Path(name) for name in (*COLMAP_FOLDERS, "images")]
    for parent in ("colmap/sparse", "sparse"):
        folders += [path.relative_to(data) for path in sorted((data / parent).glob("[0-9]*"))]
    models = [folder for folder in dict.fromkeys(folders) if colmap.model_kind(data / folder)]
    if models:
        return models
    kind = colmap.model_kind(data)
    if kind is None or not (data / f"images.{kind}").is_file():
        return []
    if images_folder(data, Path(), colmap.image_names(data)) is None:
        return []
    return [Path()]


def find_cameras(data: Path) -> Path | None:
    """Return the file with the poses of a folder or JSON file, or None; raises as `find_reconstructions`."""
    for path in (transforms_path(data), data / "transforms_train.json"):
        if path.is_file():
            return path
    models = find_reconstructions(data)
    if not models:
        return None
    model = data / next(iter(models))
    poses = model / f"images.{colmap.model_kind(model)}"
    if not poses.is_file():
        return None
    return poses


def images_folder(data: Path, model: Path, names: Sequence[str]) -> Path | None:
    """Return the folder that has images of a reconstruction by their names, both relative to the data, or None."""
    beside = [folder / "images" for folder in (model, *model.parents)]
    others = [path.name for path in data.iterdir() if not re.search(r"mask|depth|normal|_\d+$", path.name)]
    for folder in map(Path, ("images", "", model, *beside, *sorted(others))):
        if any(os.path.isfile(data / folder / name) for name in names):
            return folder
    for folder in _folders_in(data, "images"):
        if names and all(os.path.isfile(data / folder / name) for name in names):
            return folder
    return None


def _folders_in(data: Path, name: str) -> list[Path]:
    """Return the folders in a folder of the data, and in those, relative to the data."""
    folders = []
    for pattern in ("*/", "*/*/"):
        folders += sorted((data / name).glob(pattern))[:_MOST_FOLDERS]
    return [folder.relative_to(data) for folder in folders]


def automatic_options(data: Path) -> ParserOptions:
    """Return the options with which a folder's reconstruction is read if no parser is named; it must have one.

    Without the smaller copies that it wants, nerfstudio's parser of COLMAP's files asks a question at the terminal. So
    that it never has to, the images are then taken at full resolution, as they are beside a `transforms.json`.
    """
    model, names = next(iter(find_reconstructions(data).items()))
    folder = images_folder(data, model, names) or Path("images")
    options = ParserOptions(images_path=folder, colmap_path=model, downscale_factor=1, eval_mode="interval")
    # The smaller copies of images directly in the capture's folder would lie outside of it.
    if not names or folder == Path():
        return options

    def copy_of(factor: int) -> Path:
        return images.smaller_folder(data / folder, factor) / names[0]

    first = data / folder / names[0]
    factor = images.automatic_factor(first, copy_of)
    rounding = images.rounding_of(first, copy_of(factor), factor)
    return dataclasses.replace(options, downscale_factor=factor, downscale_rounding_mode=rounding)


def unreadable(error: OSError) -> str:
    """Return the sentence for a folder that may not be entered, or a name that is too long to be one."""
    return f"{error.filename} cannot be read ({reason(error)}): correct its name or rights."
