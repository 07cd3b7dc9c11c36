"""`sadgs-bench validation ROOT OUT`: scenes whose validation views are held out, for choosing constants and rules.

Test views are for tables alone. This writes a copy of each scene of a folder (images are links) in which every 8th view
from 0, a test view, is gone, and every 8th from 4 is held out. Where the scene names its own test views (a
`transforms.json` with lists of file names), every 8th training view from 4 is held out instead. With `--masked`, a
rectangle in each training view, somewhere else in each and a quarter of it in all, is masked; held-out views are whole.
"""

from __future__ import annotations

import argparse
import json
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from nerfstudio.data.utils.colmap_parsing_utils import read_cameras_binary, read_images_binary
from PIL import Image

INTERVAL, TEST, VALIDATION = 8, 0, 4
"""Every 8th view from 0 is a test view, every 8th from 4 a validation view."""
MASKED_SHARE = 0.25
"""Share of a training view's pixels that `--masked` masks."""


def write_colmap(scene: Path, out: Path, masked: bool = False) -> tuple[int, int]:
    """Write one COLMAP scene, whose `sparse/0` is binary, with the lists that nerfstudio's parser reads.

    Args:
        scene: Folder with `images` and `sparse/0`.
        out: Folder to write; one that is there is replaced.
        masked: Whether to write `masks`, too.

    Returns:
        Numbers of training and of held-out views.
    """
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    for name in ("images", "sparse"):
        (out / name).symlink_to((scene / name).resolve())
    images = [
        image for _, image in sorted(read_images_binary(scene / "sparse/0/images.bin").items())
    ]  # the parser's order
    names = {offset: [image.name for image in images[offset::INTERVAL]] for offset in range(INTERVAL)}
    held_out = names[VALIDATION]
    train = [image.name for i, image in enumerate(images) if i % INTERVAL not in (TEST, VALIDATION)]
    for split, chosen in {"train": train, "test": held_out, "val": held_out}.items():
        (out / f"{split}_list.txt").write_text("\n".join(chosen))
    if masked:
        cameras = read_cameras_binary(scene / "sparse/0/cameras.bin")
        for i, image in enumerate(images):
            camera = cameras[image.camera_id]
            mask = np.full((camera.height, camera.width), 255, np.uint8)
            if image.name in train:
                generator = np.random.default_rng(i)
                height, width = (int(side * MASKED_SHARE**0.5) for side in mask.shape)
                row, column = generator.integers(mask.shape[0] - height), generator.integers(mask.shape[1] - width)
                mask[row : row + height, column : column + width] = 0
            path = (out / "masks" / image.name).with_suffix(".png")
            path.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(mask).save(path)
    return len(train), len(held_out)


def write_transforms(scene: Path, out: Path) -> tuple[int, int]:
    """Write one scene of a `transforms.json` that lists its splits, with every 8th training view from 4 held out.

    Returns:
        Numbers of training and of held-out views.
    """
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    for path in scene.iterdir():
        if path.name != "transforms.json":
            (out / path.name).symlink_to(path.resolve())
    content = json.loads((scene / "transforms.json").read_text())
    names = content["train_filenames"]
    held_out = names[VALIDATION::INTERVAL]
    train = [name for name in names if name not in held_out]
    listed = {*train, *held_out}
    content["frames"] = [frame for frame in content["frames"] if frame["file_path"] in listed]
    content |= {"train_filenames": train, "val_filenames": held_out, "test_filenames": held_out}
    (out / "transforms.json").write_text(json.dumps(content))
    return len(train), len(held_out)


def main(argv: Sequence[str] | None = None) -> int:
    """Write the scenes and print how many views each has."""
    parser = argparse.ArgumentParser(
        prog="sadgs-bench validation", description="Hold out validation views, and leave test views out."
    )
    parser.add_argument("root", type=Path, help="folder that holds the scenes")
    parser.add_argument("out", type=Path, help="folder for the copies")
    parser.add_argument("--masked", nargs="*", default=[], metavar="SCENE", help="also write NAME-masked of these")
    arguments = parser.parse_args(argv)
    for scene in sorted(path for path in arguments.root.iterdir() if path.is_dir()):
        if (scene / "sparse/0/images.bin").exists():
            train, held_out = write_colmap(scene, arguments.out / scene.name)
            if scene.name in arguments.masked:
                write_colmap(scene, arguments.out / f"{scene.name}-masked", masked=True)
        elif (scene / "transforms.json").exists():
            train, held_out = write_transforms(scene, arguments.out / scene.name)
        else:
            continue
        print(f"{scene.name}: {train} training views, {held_out} validation views")
    return 0
