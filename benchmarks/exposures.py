"""`python -m benchmarks exposures SCENE OUT`: a copy of a COLMAP scene with known exposures and white balances.

Each training photo gets a gain in linear light, so that the gains' logarithms are evenly spread and the largest is
`--spread` times the smallest, and factors of its channels of up to `--white-balance`, whose product is 1. Every 8th
view from 0 and from 4, a test and a validation view, gets the geometric mean of the gains and no factors: what is
learned can be compared with it without fitting its colours first. By default that mean is the largest one, `--mean`, at
which no pixel saturates that was not saturated before.

`exposures.json` beside the images holds gain and factors of each photo. With `--spread 1 --white-balance 0 --mean M`
the copy is the control: its photos all have the exposure that the held-out ones of the other copy have.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from numpy.typing import NDArray
from PIL import Image
from tyro.conf import Positional

from benchmarks.datasets import image_names
from benchmarks.validation import INTERVAL, SPARSE, TEST, VALIDATION

FILE = "exposures.json"
"""Name of the file with the gains."""
JPEG: dict[str, Any] = {"quality": 98, "subsampling": 0}
"""Options with which JPEG files are written: the gains are to be the only difference that can be seen."""
Array = NDArray[np.float64]


def draw_gains(views: int, spread: float, white_balance: float, mean: float, seed: int) -> tuple[Array, Array]:
    """Draw the gains [V] of one photo or more, and the factors of their channels [V, 3].

    The gains' geometric mean is `mean`, and of several gains the largest is `spread` times the smallest. A photo's
    factors lie between 1 + `white_balance` and its inverse, and their product is 1.
    """
    generator = np.random.default_rng(seed)
    exponents = np.zeros(views)
    if views > 1:
        exponents = generator.permutation(views) / (views - 1) - 0.5
    gains = mean * spread**exponents
    powers = generator.uniform(-1, 1, (views, 3))
    powers -= powers.mean(axis=1, keepdims=True)
    powers *= 0.75  # Without their mean they lie between −4/3 and 4/3.
    return gains, (1 + white_balance) ** powers


def linear_light(values: Array) -> Array:
    """Return the linear light in [0, 1] that sRGB's values in [0, 1] stand for."""
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def srgb_values(light: Array) -> Array:
    """Return sRGB's values in [0, 1] of linear light in [0, 1]; the inverse of `linear_light`."""
    return np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 0.0031308) ** (1 / 2.4) - 0.055)


def with_gains(image: NDArray[np.uint8], gains: Array) -> NDArray[np.uint8]:
    """Multiply the linear light of an image [H, W, 3] by a gain for each channel [3]; what exceeds 1 saturates."""
    levels = linear_light(np.arange(256) / 255.0)  # [256]
    table = np.rint(255 * srgb_values((levels[:, None] * gains).clip(0, 1))).astype(np.uint8)  # [256, 3]
    return np.stack([table[image[..., channel], channel] for channel in range(3)], axis=-1)


def write_scene(scene: Path, out: Path, spread: float, white_balance: float, mean: float, seed: int = 0) -> None:
    """Write the copy; an earlier one is replaced. Raises as `image_names`."""
    names = image_names(ColmapDataParserConfig(colmap_path=SPARSE, downscale_factor=1), scene)
    held_out = [i % INTERVAL in (TEST, VALIDATION) for i in range(len(names))]
    drawn = zip(*draw_gains(held_out.count(False), spread, white_balance, mean, seed), strict=True)
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    (out / "sparse").symlink_to((scene / "sparse").resolve())
    written: dict[str, dict[str, Any]] = {}
    for name, holds_out in zip(names, held_out, strict=True):
        gain = mean
        of_channels = np.ones(3)
        if not holds_out:
            gain, of_channels = next(drawn)
        with Image.open(scene / "images" / name) as image:
            changed = Image.fromarray(with_gains(np.asarray(image.convert("RGB")), gain * of_channels))
        path = out / "images" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        options = {}
        if path.suffix.lower() in (".jpg", ".jpeg"):
            options = JPEG
        changed.save(path, **options)
        written[name] = {"gain": float(gain), "channels": of_channels.tolist(), "held_out": holds_out}
    (out / FILE).write_text(json.dumps(written, indent=1) + "\n")


@dataclass
class Command:
    """Copy a COLMAP scene, with known exposures of its training photos."""

    scene: Positional[Path]
    """folder of a COLMAP scene"""
    out: Positional[Path]
    """folder for the copy"""
    spread: float = 4.0
    """largest gain over the smallest"""
    white_balance: float = 0.1
    """largest change of a channel, a share"""
    mean: float | None = None
    """geometric mean of the gains (default: the largest at which nothing saturates)"""

    def __call__(self) -> int:
        mean = self.mean
        if mean is None:
            mean = (1 + self.white_balance) ** -1 * max(self.spread, 1e-9) ** -0.5
        if not (self.scene / SPARSE).is_dir():
            raise ValueError(f"{self.scene} holds no {SPARSE}; give the folder of a COLMAP scene.")
        if self.out.exists() and not (self.out / FILE).exists():
            raise ValueError(f"{self.out} is there and holds no {FILE}, so it is no earlier copy; give another folder.")
        if not (self.spread >= 1 and 0 <= self.white_balance < 1 and 0 < mean <= 1):
            raise ValueError("--spread must be at least 1, --white-balance in [0, 1), and --mean in (0, 1].")
        write_scene(self.scene, self.out, self.spread, self.white_balance, mean)
        return 0
