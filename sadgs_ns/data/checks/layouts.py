"""Layouts of a capture's folder, and the sentences for folders with no known one."""

from __future__ import annotations

import contextlib
import os
import re
import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from sadgs_ns.data import colmap
from sadgs_ns.data.images import Rounding, images_in
from sadgs_ns.errors import InputError

COLMAP_FOLDERS = ("colmap/sparse/0", "sparse/0", "sparse", "colmap")  # Places of a reconstruction, nerfstudio's first
_BUNDLER = (
    "kapture_import_bundler.py -i {file} -l LIST.txt -im {photos} --add-reconstruction -o KAPTURE && "
    "kapture_export_colmap.py -i KAPTURE -db KAPTURE/colmap.db -txt {data}/sparse"
)
_EXPORTS = {
    "*.xml": (b"<chunk", "ns-process-data metashape --data {photos} --xml {file} --output-dir FOLDER"),
    "*.psx": (b"", "ns-process-data metashape --data {photos} --xml EXPORTED.xml --output-dir FOLDER"),
    "*.csv": (b"#name,", "ns-process-data realitycapture --data {photos} --csv {file} --output-dir FOLDER"),
    "*.xmp": (b"xcr:Rotation", "ns-process-data realitycapture --data {photos} --csv EXPORTED.csv --output-dir FOLDER"),
    "odm_report/shots.geojson": (b"", "ns-process-data odm --data {data} --output-dir FOLDER"),
    "keyframes/cameras/*.json": (b"", "ns-process-data polycam --data {data} --output-dir FOLDER"),
    "metadata.json": (b'"poses"', "ns-process-data record3d --data {data} --output-dir FOLDER"),
    "reconstruction.json": (b'"shots"', "opensfm export_colmap {data} && mv {data}/colmap_export {data}/sparse"),
    "*sfm*": (b'"poses"', "aliceVision_exportColmap --input {file} --output FOLDER --copyImages true"),
    "bundle.out": (b"# Bundle", _BUNDLER),
}
"""Files with other programs' poses, a part of their content, and the command that reads them."""
GIVE_POSES = "compute poses with `sadgs-process PHOTOS FOLDER` or `ns-process-data`"  # A remedy where there are none


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


def find_cameras(data: Path) -> Path | None:
    """Return the file with the poses that a folder or JSON file brings, or None; raises as `colmap.read_poses`."""
    files = [data if data.suffix == ".json" else data / "transforms.json", data / "transforms_train.json"]
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


def poses_elsewhere(data: Path) -> str | None:
    """Return the sentence for a folder with another program's poses, which a command reads, or None."""
    for pattern, (mark, command) in _EXPORTS.items():
        if files := [file for file in sorted(data.glob(pattern)) if file.is_file() and mark in file.read_bytes()]:
            photos = next((folder for folder in (data, *sorted(data.glob("*/"))) if images_in(folder)), data)
            named = {"file": files[0], "photos": photos, "data": data}
            command = command.format(**{name: shlex.quote(str(path)) for name, path in named.items()})
            return f"{files[0]} has poses: `{command}` keeps them."
    return None


def no_layout(data: Path) -> str:
    """Return the sentence for a folder without poses."""
    config = data if data.name == "config.yml" else data / "config.yml"
    if config.is_file() and any(config.parent.glob("nerfstudio_models/step-*.ckpt")):
        run = shlex.quote(str(config))
        shown = f"`ns-viewer --load-config {run}` shows it"
        return f"{data} is a run and no capture: {shown}, and `sadgs-export {run} --output splat.ply` exports it."
    if not data.is_dir():
        return f"{data} {'is a file' if data.exists() else 'does not exist'}: give --data the folder of a capture."
    if models := find_reconstructions(data):
        told = f"{data} holds no transforms.json, but {data / next(iter(models))} holds a COLMAP reconstruction"
        return f"{told}: leave `nerfstudio-data` out of the command."
    around = data.absolute()
    for other in around.parents[:3]:
        inside = around.relative_to(other).parts[0]
        if (inside.startswith("images") or inside in ("masks", "sparse", "colmap")) and layout_of(other) is not None:
            return f"{data} is a part of the capture {other}: give --data that folder."
    if kind := colmap.model_kind(data):
        first = colmap.image_names(data)[:1]
        return f"{data}/images.{kind} has poses, but its images, such as {first}, are not in {data}: put them there."
    if told := poses_elsewhere(data):
        return told
    photos = data if images_in(data) else data / "images"
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
