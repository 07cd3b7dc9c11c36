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


def find_reconstructions(data: Path) -> dict[Path, list[str]]:
    """Return the folders of COLMAP's reconstructions, relative to the data, and the names of each one's images.

    The first is the one to read: one in a usual place, or else the one with the most images. A reconstruction right in
    the data's folder counts if there is no other and its images are at hand. One that cannot be read has no names.
    """
    found: dict[Path, list[str]] = {folder: [] for folder in _model_folders(data)}
    for folder in found:
        with contextlib.suppress(InputError):
            found[folder] = colmap.image_names(data / folder)
    return dict(sorted(found.items(), key=lambda item: 0 if str(item[0]) in COLMAP_FOLDERS else 1 / (1 + len(item[1]))))


def _model_folders(data: Path) -> list[Path]:
    numbered = [path for place in ("colmap/sparse", "sparse") for path in sorted((data / place).glob("[0-9]*"))]
    folders = (*map(Path, COLMAP_FOLDERS), Path("images"), *(path.relative_to(data) for path in numbered))
    if found := [folder for folder in folders if colmap.model_kind(data / folder)]:
        return found
    kind = colmap.model_kind(data)
    is_whole = kind and (data / f"images.{kind}").is_file()
    return [Path()] if is_whole and images_folder(data, Path(), colmap.image_names(data)) is not None else []


def transforms_path(data: Path) -> Path:
    """Return the file of a capture whose path is that of a JSON file, or of a folder with a `transforms.json`."""
    if data.suffix == ".json":
        return data
    return data / "transforms.json"


def find_cameras(data: Path) -> Path | None:
    """Return the file with the poses that a folder or JSON file brings, or None; raises as `colmap.read_poses`."""
    files = [transforms_path(data), data / "transforms_train.json"]
    if not any(file.is_file() for file in files) and (models := find_reconstructions(data)):
        model = next(iter(models))
        files = [data / model / f"images.{colmap.model_kind(data / model)}"]
    return next((file for file in files if file.is_file()), None)


def images_folder(data: Path, model: Path, names: Sequence[str]) -> Path | None:
    """Return the folder that has images of a reconstruction by their names, both relative to the data, or None."""
    others = [path.name for path in data.iterdir() if not re.search(r"mask|depth|normal|_\d+$", path.name)]
    beside = [folder / "images" for folder in (model, *model.parents)]
    folders = map(Path, ("images", "", model, *beside, *sorted(others)))
    return next((folder for folder in folders if any(os.path.isfile(data / folder / name) for name in names)), None)


def layout_of(data: Path) -> Literal["nerfstudio", "blender", "colmap"] | None:
    """Return the layout of a capture's folder or file; None if it is unknown."""
    if data.is_file() or (data / "transforms.json").is_file():
        return "nerfstudio"
    if (data / "transforms_train.json").is_file():
        return "blender"
    return "colmap" if _model_folders(data) else None


def automatic_options(data: Path) -> ParserOptions:
    """Return how a folder's reconstruction, which it must have, is read where no parser is named.

    Without the smaller copies that it wants, nerfstudio's parser of COLMAP's files asks a question at the terminal. So
    that it never has to, the images are then taken at full resolution, as they are beside a `transforms.json`.
    """
    model, names = next(iter(find_reconstructions(data).items()))
    folder = images_folder(data, model, names) or Path("images")
    options = ParserOptions(images_path=folder, colmap_path=model, downscale_factor=1, eval_mode="interval")
    if not names or folder == Path():  # The smaller copies of images right in the capture would lie outside of it.
        return options
    image, copies = data / folder / names[0], lambda by: images.smaller_folder(data / folder, by) / names[0]
    factor = images.automatic_factor(image, copies)
    rounding = images.rounding_of(image, copies(factor), factor)
    return dataclasses.replace(options, downscale_factor=factor, downscale_rounding_mode=rounding)


def unreadable(error: OSError) -> str:
    """Return the sentence for a folder that may not be entered, or a name that is too long to be one."""
    return f"{error.filename} cannot be read ({reason(error)}): correct its name or rights."
