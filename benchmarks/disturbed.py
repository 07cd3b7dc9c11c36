"""`python -m benchmarks disturbed ROOT OUT`: scenes with things in some photos that are not there in the others.

It writes a copy of each COLMAP scene of a folder. In some photos, as many as 30 % of the training photos, stand one to
three people, cars, or things cut out of the photos of `--photos`. Together they cover 3 to 15 % of a photo.

A copy holds

- `images` and `sparse`, links to the scene's own, and the lists of training and held-out photos;
- `disturbed`, the same photos by the same names, some of them with such things. Those are PNG whatever their names
  say, as a JPEG would change all pixels; programs tell the format by the file's first bytes. All others, and so those
  that are held out, are links to the scene's files;
- `true_masks/NAME.png` of each disturbed photo, black where it differs from the scene's own and white elsewhere;
- `disturbed.json`: which photos are disturbed, by what, and the share of their pixels.

Every 8th view from `--fold` is held out: from 4, a validation view, for choosing (test views are gone then), or from 0,
a test view, for tables. Photos that `chain` would hold out are never disturbed, so that it can find the cameras of a
folder `disturbed`. The same seed gives the same copies.
"""

from __future__ import annotations

import json
import shutil
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from numpy.typing import NDArray
from PIL import Image, ImageFilter
from tyro.conf import Positional

from benchmarks.chain import held_out
from benchmarks.cut_outs import CutOut, Pixels, all_cut_outs
from benchmarks.datasets import image_names
from benchmarks.validation import INTERVAL, SPARSE, VALIDATION, write_colmap

FILE = "disturbed.json"
"""Name of the file that tells which photos are disturbed."""
IMAGES, MASKS = "disturbed", "true_masks"
"""Folders of a copy: its photos, and the masks of those that are disturbed."""
DISTURBED_SHARE = 0.3
"""Share of the training photos that are disturbed."""
SMALLEST, LARGEST = 0.03, 0.15
"""Shares of a photo that all things in it cover together."""
MOST_THINGS = 3
"""Largest number of things in a photo."""
LARGEST_ANGLE = 15.0
"""Largest angle in degrees by which a thing leans."""
MOST_BEYOND = 0.25
"""Largest share of a thing's width or height that lies beyond a side of the photo."""
ATTEMPTS = 200
"""Number of arrangements that are tried until one covers as much as it has to."""

Mask = NDArray[np.bool_]


def generator_of(seed: int, name: str) -> np.random.Generator:
    """Return the random numbers of a scene or photo, which others' numbers do not change."""
    return np.random.default_rng([seed, zlib.crc32(name.encode())])


def choose(training: Sequence[str], clean: Sequence[str], generator: np.random.Generator) -> list[str]:
    """Return the training photos that are disturbed, at least one and none of `clean`, in their order."""
    number = max(1, round(DISTURBED_SHARE * len(training)))
    names = [name for name in training if name not in clean]
    chosen = generator.choice(len(names), number, replace=False)
    return [names[i] for i in sorted(chosen)]


def pose(thing: CutOut, area: float, generator: np.random.Generator) -> Pixels:
    """Return a cut-out as it comes into a photo: scaled to an area in px², mirrored or not, and turned. [H, W, 4]

    Its opacity falls over a pixel at its edge, and is 0 where the cut-out has no colours.
    """
    scale = (area / thing.area) ** 0.5
    image = Image.fromarray(thing.pixels)
    if generator.random() < 0.5:
        image = image.transpose(Image.Transpose.FLIP_LEFT_RIGHT)
    width = max(1, round(scale * image.width))
    height = max(1, round(scale * image.height))
    angle = generator.uniform(-LARGEST_ANGLE, LARGEST_ANGLE)
    scaled = image.resize((width, height), Image.Resampling.LANCZOS)
    turned = scaled.rotate(angle, Image.Resampling.BICUBIC, expand=True)
    pixels = np.array(turned)
    inside = pixels[..., 3] > 127
    # The filter repeats the pixels at the image's sides: with a border of 0 the thing fades there, too.
    bordered = Image.fromarray(np.pad(np.uint8(255 * inside), 1))
    soft = np.asarray(bordered.filter(ImageFilter.BoxBlur(1)))[1:-1, 1:-1]
    pixels[..., 3] = np.where(inside, soft, 0)
    return pixels


def paste(photo: Pixels, covered: Mask, thing: Pixels, left: int, top: int) -> None:
    """Paste colours and opacity [h, w, 4] into a photo [H, W, 3], and add them to what is covered [H, W], in place.

    The thing's upper left pixel comes to `left` and `top`; what lies beyond the photo is lost.
    """
    height, width = covered.shape
    rows = slice(max(top, 0), min(top + thing.shape[0], height))
    columns = slice(max(left, 0), min(left + thing.shape[1], width))
    seen = thing[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left].astype(np.int64)
    opacity = seen[..., 3:]
    mixed = opacity * seen[..., :3] + (255 - opacity) * photo[rows, columns]
    photo[rows, columns] = (mixed + 127) // 255
    covered[rows, columns] |= opacity[..., 0] > 0


def disturb(photo: Pixels, things: Sequence[CutOut], generator: np.random.Generator) -> tuple[Pixels, Mask, list[str]]:
    """Paste one to three things into a photo [H, W, 3].

    Returns:
        The new photo [H, W, 3], which of its pixels differ [H, W], and the names of the things.

    Raises:
        ValueError: If no arrangement covers as much of the photo as it has to.
    """
    height, width = photo.shape[:2]
    for _ in range(ATTEMPTS):
        result = photo.copy()
        covered = np.zeros((height, width), np.bool_)
        share = generator.uniform(SMALLEST, LARGEST)
        number = int(generator.integers(1, MOST_THINGS + 1))
        parts = generator.uniform(0.5, 1.0, number)
        chosen = [things[i] for i in generator.integers(len(things), size=number)]
        for thing, part in zip(chosen, parts / parts.sum(), strict=True):
            posed = pose(thing, part * share * height * width, generator)
            left = _place(posed.shape[1], width, generator)
            top = _place(posed.shape[0], height, generator)
            paste(result, covered, posed, left, top)
        if SMALLEST <= covered.mean() <= LARGEST:
            _make_different(photo, result, covered)
            return result, covered, [thing.name for thing in chosen]
    raise ValueError(f"things that cover {SMALLEST} to {LARGEST} of it do not fit into {width} × {height} px.")


def _place(length: int, side: int, generator: np.random.Generator) -> int:
    """Return where a thing of a length begins on a side of a photo, both in px; it may lie a little beyond the ends."""
    beyond = MOST_BEYOND * length
    first = min(-beyond, (side - length) / 2)
    last = max(side - length + beyond, (side - length) / 2)
    return round(generator.uniform(first, last))


def _make_different(photo: Pixels, result: Pixels, covered: Mask) -> None:
    """Change the covered pixels of `result` that have the photo's colour by one level of blue, in place.

    The mask then is where the two differ, without holes where a colour happens to be the same. All [H, W, …].
    """
    same = covered & (result == photo).all(axis=-1)
    blue = result[..., 2]
    blue[same] = np.where(blue[same] < 255, blue[same] + 1, 254)


def write_scene(scene: Path, out: Path, things: Sequence[CutOut], fold: int, seed: int) -> int:
    """Write the copy of a COLMAP scene to a folder, as at the top of this module, and replace an earlier one.

    Returns the number of disturbed photos; raises as `image_names` and `disturb`.
    """
    partial = out.with_name(f".{out.name}.partial")
    try:
        write_colmap(scene, partial, fold)
        photos = _write_photos(scene, partial, things, seed)
        description = {"fold": fold, "seed": seed, "photos": photos}
        (partial / FILE).write_text(json.dumps(description, indent=1) + "\n")
        shutil.rmtree(out, ignore_errors=True)
        partial.rename(out)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return len(photos)


def _write_photos(scene: Path, copy: Path, things: Sequence[CutOut], seed: int) -> dict[str, dict[str, Any]]:
    """Write photos and masks into a copy with its lists, and return what `disturbed.json` says of each photo."""
    names = image_names(ColmapDataParserConfig(colmap_path=SPARSE, downscale_factor=1), scene)
    training = (copy / "train_list.txt").read_text().splitlines()
    chosen = choose(training, held_out(sorted(names)), generator_of(seed, scene.name))
    photos = {}
    for name in names:
        source = scene / "images" / name
        target = copy / IMAGES / name
        target.parent.mkdir(parents=True, exist_ok=True)
        if name in chosen:
            mask = (copy / MASKS / name).with_suffix(".png")
            mask.parent.mkdir(parents=True, exist_ok=True)
            generator = generator_of(seed, f"{scene.name}/{name}")
            photos[name] = _write_disturbed(source, target, mask, things, generator)
        else:
            target.symlink_to(source.resolve())
    return photos


def _write_disturbed(
    source: Path, target: Path, mask: Path, things: Sequence[CutOut], generator: np.random.Generator
) -> dict[str, Any]:
    """Write a disturbed photo and its mask, and return what `disturbed.json` says of it.

    Raises ValueError as `disturb`, with the photo's path.
    """
    with Image.open(source) as image:
        photo = np.asarray(image.convert("RGB"))
        # Programs that find cameras read the focal length there.
        kept = {name: image.info.get(name) for name in ("exif", "icc_profile")}
    try:
        pixels, covered, pasted = disturb(photo, things, generator)
    except ValueError as error:
        raise ValueError(f"{source}: {error}") from error
    # Level 1 of 9 is quick.
    Image.fromarray(pixels).save(target, format="PNG", compress_level=1, **kept)
    Image.fromarray(np.where(covered, 0, 255).astype(np.uint8)).save(mask)
    return {"share": round(float(covered.mean()), 4), "things": pasted}


@dataclass
class Command:
    """Copy COLMAP scenes, with things in some training photos that the other photos do not show."""

    root: Positional[Path]
    """folder that holds the scenes"""
    out: Positional[Path]
    """folder for the copies"""
    photos: Path | None = None
    """folder that holds the photos of plush and mouse, to cut both out (default: people and cars that are drawn)"""
    fold: int = VALIDATION
    """every 8th view from this one is held out"""
    only: str = ""
    """scenes to copy, with commas between; the default is all"""
    seed: int = 0
    """of the photos, things and places"""

    def scenes(self) -> list[Path]:
        """Return the folders of the scenes to copy, sorted.

        Raises ValueError if there is none, if `only` names another one, or if a copy would overwrite other files.
        """
        found = []
        if self.root.is_dir():
            for path in sorted(self.root.iterdir()):
                if (path / SPARSE).is_dir() and (path / "images").is_dir():
                    found.append(path)
        if not found:
            raise ValueError(f"{self.root} holds no folder with images and {SPARSE}; give that of the scenes.")
        if self.only:
            wanted = self.only.split(",")
            names = [path.name for path in found]
            unknown = sorted(set(wanted) - set(names))
            if unknown:
                raise ValueError(f"--only names {unknown[0]!r}; {self.root} has {', '.join(names)}.")
            found = [path for path in found if path.name in wanted]
        for scene in found:
            copy = self.out / scene.name
            if copy.exists() and not (copy / FILE).exists():
                raise ValueError(f"{copy} is there and holds no {FILE}, so it is no earlier copy; give another folder.")
        return found

    def __call__(self) -> int:
        if not 0 <= self.fold < INTERVAL:
            raise ValueError(f"--fold must be from 0 to {INTERVAL - 1}, not {self.fold}.")
        if self.seed < 0:
            raise ValueError(f"--seed must be 0 or more, not {self.seed}.")
        scenes = self.scenes()
        things = all_cut_outs(self.photos)
        for scene in scenes:
            disturbed = write_scene(scene, self.out / scene.name, things, self.fold, self.seed)
            print(f"{scene.name}: {disturbed} disturbed photos", flush=True)
        return 0
