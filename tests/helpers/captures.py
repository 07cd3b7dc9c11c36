"""Folders of photos that bring their cameras, as users have them from other programs."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

from PIL import Image

from helpers.json_files import read_json, write_json
from helpers.short_runs import nerfstudio_data
from helpers.small_scenes import HEIGHT, WIDTH


@dataclass
class Capture:
    """A folder of photos and their cameras, with a mask of the first photo."""

    folder: Path
    given: Path  # The argument of `sadgs`: the folder, or a file there
    cameras: Path
    mask: Path

    def command(self, output: Path) -> list[str]:
        """Arguments of `sadgs` that make a PLY file of it."""
        return [str(self.given), "-o", str(output), "--formats", "ply"]


LAYOUTS = {
    # name: the file of the cameras
    "sparse/0": "sparse/0/images.bin",
    "beside": "images.bin",  # The COLMAP model lies in the folder itself, beside `images`.
    "transforms.json": "transforms.json",
    "file": "transforms.json",  # This file is given to `sadgs`, and not the folder.
}


def write_capture(layout: str, folder: Path, scene: Path) -> Capture:
    """Write a capture of one of the `LAYOUTS`, from a scene that has a COLMAP model in `sparse/0`."""
    shutil.copytree(scene, folder)
    cameras = folder / LAYOUTS[layout]
    if layout != "sparse/0":
        shutil.rmtree(folder / "sparse")
    if layout == "beside":
        shutil.copytree(scene / "sparse/0", folder, dirs_exist_ok=True)
    elif layout != "sparse/0":
        shutil.rmtree(folder / "images")
        nerfstudio_data(folder)
    mask = folder / "masks/000.png"
    mask.parent.mkdir()
    Image.new("L", (WIDTH, HEIGHT), 255).save(mask)
    if cameras.name == "transforms.json":
        described = read_json(cameras)
        described["frames"] = [frame | {"mask_path": r"masks\000.png"} for frame in described["frames"]]
        write_json(cameras, described)
    given = cameras if layout == "file" else folder
    return Capture(folder, given, cameras, mask)
