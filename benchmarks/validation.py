"""`python -m benchmarks validation ROOT OUT`: scenes whose validation views are held out, for choosing rules.

Test views are for tables alone. This writes a copy of each scene of a folder (images are links) in which every 8th view
from 0, a test view, is gone, and every 8th from 4 is held out. Where the scene names its own test views (a
`transforms.json` with lists of file names), every 8th training view from 4 is held out instead. With `--folds 2,4,6`,
there are copies NAME-2, NAME-4 and NAME-6, in each of which every 8th view from that number is held out. Fold 0 holds
out the test views and trains on all others, as the tables do. With `--noisy`, the camera of each training view is
turned by a random angle, and those of held-out views are true.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from scipy.spatial.transform import Rotation
from tyro.conf import Positional

from benchmarks.datasets import image_names

SPARSE = Path("sparse/0")
"""Folder of a COLMAP scene's model."""
INTERVAL = 8
"""Every so many views, one is held out."""
TEST = 0
"""Number of the first test view."""
VALIDATION = 4
"""Number of the first validation view."""
NOISY_DEGREES = 0.1
"""Standard deviation of the angle by which `--noisy` turns a camera about each of its axes: 2 px at a focal length of
1,150 px."""


def write_colmap(scene: Path, out: Path, fold: int = VALIDATION) -> tuple[int, int]:
    """Write one COLMAP scene, of `images` and `sparse/0`, with the lists that nerfstudio's parser reads.

    A folder `out` that is there is replaced. Every 8th view from `fold`, in [0, 7], is held out, and no test view is in
    the training views. Returns the numbers of training and of held-out views; raises as `image_names`.
    """
    names = image_names(ColmapDataParserConfig(colmap_path=SPARSE, downscale_factor=1), scene)
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    for name in ("images", "sparse"):
        (out / name).symlink_to((scene / name).resolve())
    held_out = names[fold::INTERVAL]
    train = [name for i, name in enumerate(names) if i % INTERVAL not in (TEST, fold)]
    for split, chosen in {"train": train, "test": held_out, "val": held_out}.items():
        (out / f"{split}_list.txt").write_text("\n".join(chosen))
    return len(train), len(held_out)


def turn_cameras(out: Path) -> None:
    """Turn the training cameras of a copy of `write_colmap` about their centres, the same at each call."""
    import pycolmap  # Pillow cannot write PNGs if it is loaded after this.

    model = pycolmap.Reconstruction(out / SPARSE)
    train = set((out / "train_list.txt").read_text().splitlines())
    generator = np.random.default_rng(0)
    for image in sorted(model.images.values(), key=lambda image: image.name):
        turn = Rotation.from_rotvec(generator.normal(0, NOISY_DEGREES, 3), degrees=True)
        if image.name in train:
            pose = image.cam_from_world()
            matrix = turn.as_matrix() @ pose.matrix()
            image.frame.set_cam_from_world(image.camera_id, pycolmap.Rigid3d(matrix))
    (out / "sparse").unlink()  # It was a link.
    (out / SPARSE).mkdir(parents=True)
    model.write(out / SPARSE)


def write_transforms(scene: Path, out: Path, fold: int = VALIDATION) -> tuple[int, int]:
    """Write one scene of a `transforms.json` that lists its splits, otherwise as `write_colmap`.

    The training view `fold`, in [1, 7], and every 8th after it are held out; 0 holds out the listed test views.
    """
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    for path in scene.iterdir():
        if path.name != "transforms.json":
            (out / path.name).symlink_to(path.resolve())
    content = json.loads((scene / "transforms.json").read_text())
    names = content["train_filenames"]
    held_out = names[fold::INTERVAL]
    if fold == TEST:
        held_out = content["test_filenames"]
    train = [name for name in names if name not in held_out]
    listed = {*train, *held_out}
    content["frames"] = [frame for frame in content["frames"] if frame["file_path"] in listed]
    content |= {"train_filenames": train, "val_filenames": held_out, "test_filenames": held_out}
    (out / "transforms.json").write_text(json.dumps(content))
    return len(train), len(held_out)


@dataclass
class Command:
    """Copy scenes with validation views held out and test views left out."""

    root: Positional[Path]
    """folder that holds the scenes"""
    out: Positional[Path]
    """folder for the copies"""
    folds: str | None = None
    """such as 2,4,6: write NAME-2, … with every 8th view from 2, … held out (default: 4, as NAME)"""
    noisy: tuple[str, ...] = ()
    """scenes of which NAME-noisy is written, too"""

    def __call__(self) -> int:
        folds = [str(VALIDATION)]
        if self.folds is not None:
            folds = self.folds.split(",")
        if not {*folds} <= {str(fold) for fold in range(INTERVAL)}:
            raise ValueError(
                f"--folds must be whole numbers from 0 to {INTERVAL - 1}, such as 2,4,6, not {self.folds!r}."
            )
        scenes = []
        if self.root.is_dir():
            for folder in sorted(self.root.iterdir()):
                if (folder / SPARSE).is_dir() or (folder / "transforms.json").exists():
                    scenes.append(folder)
        if not scenes:
            raise ValueError(f"{self.root} holds no folder with {SPARSE} or transforms.json; give that of the scenes.")
        for scene, fold in product(scenes, map(int, folds)):
            name = scene.name
            if self.folds is not None:
                name = f"{name}-{fold}"
            if (scene / SPARSE).is_dir():
                train, held_out = write_colmap(scene, self.out / name, fold)
                if scene.name in self.noisy:
                    write_colmap(scene, self.out / f"{name}-noisy", fold)
                    turn_cameras(self.out / f"{name}-noisy")
            else:
                train, held_out = write_transforms(scene, self.out / name, fold)
            print(f"{name}: {train} training views, {held_out} held-out views")
        return 0
