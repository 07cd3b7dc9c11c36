"""Held-out views of a benchmark side by side: the photograph, every method, and the window where they differ most."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, UnidentifiedImageError

from benchmarks.plots import Groups

TRUTH = "photograph"
WINDOW = 96
"""Width and height of a crop in pixels; less in an image that is smaller."""
WIDTH = 640
"""Largest width of an overview in pixels."""

Box = tuple[int, int, int, int]
"""Left, top, right (exclusive) and bottom (exclusive) in pixels."""


@dataclass(frozen=True)
class Picture:
    """One rendering (or the photograph) of a view: the whole with the window marked, and the window."""

    label: str
    overview: Path
    crop: Path


@dataclass(frozen=True)
class View:
    """A held-out view: the photograph first, then the methods that have it."""

    scene: str
    name: str
    box: Box
    pictures: list[Picture]


def crop_window(truth: NDArray[np.floating], images: Sequence[NDArray[np.floating]], size: int = WINDOW) -> Box:
    """The window where the methods differ most in how far they are from the truth.

    Args:
        truth: Photograph. [H, W, 3]
        images: One rendering a method. [H, W, 3] each
        size: Width and height of the window in pixels, cut to those of the image.

    Returns:
        The window with the largest variance over methods of the root mean squared error within it; with one method,
        the window of its largest error.
    """
    height, width = min(size, truth.shape[0]), min(size, truth.shape[1])
    errors = []
    for image in images:
        total = cv2.integral(np.square(image - truth).mean(-1))
        sums = total[height:, width:] - total[:-height, width:] - total[height:, :-width] + total[:-height, :-width]
        errors.append(np.sqrt(np.maximum(sums, 0) / (height * width)))
    score = np.var(errors, 0) if len(errors) > 1 else errors[0]
    top, left = (int(i) for i in np.unravel_index(np.argmax(score), score.shape))
    return left, top, left + width, top + height


def compare(groups: Groups, images: Path, output: Path, count: int) -> list[View]:
    """Write overviews and crops of held-out views, one seed a method.

    Args:
        images: Folder that the results' paths of images are relative to; "<scene>/truth/<view>.png" are photographs.
        output: Folder for PNGs, made if need be.
        count: Views a scene, spread over those there are.

    Returns:
        Paths are relative to `output`. A method that lacks an image is left out of that view.

    Raises:
        ValueError: No image at all, one that cannot be read, or of another size than the photograph; names it.
    """
    sources: dict[tuple[str, str], dict[str, Path]] = {}
    for (scene, label), group in groups.items():
        row = min((row for row in group if row.get("images")), key=lambda row: row["seed"], default=None)
        for path in map(PurePosixPath, row["images"] if row else []):
            view = sources.setdefault((scene, path.stem), {TRUTH: images / path.parents[1] / "truth" / path.name})
            if (images / path).is_file():
                view[label] = images / path
    complete = {key: paths for key, paths in sources.items() if len(paths) > 1 and paths[TRUTH].is_file()}
    if not complete:
        raise ValueError(f"{images} holds none of the results' images with its photograph; check --images.")

    output.mkdir(parents=True, exist_ok=True)
    views = []
    for scene in dict.fromkeys(scene for scene, _ in complete):
        names = sorted(name for s, name in complete if s == scene)
        chosen = np.linspace(0, len(names) - 1, min(count, len(names))).round().astype(int)
        views += [
            _write(scene, names[i], complete[scene, names[i]], output, f"{len(views) + n}-")
            for n, i in enumerate(chosen)
        ]
    return views


def _write(scene: str, name: str, paths: dict[str, Path], output: Path, prefix: str) -> View:
    pictures = {label: _read(path) for label, path in paths.items()}
    for label, picture in pictures.items():
        if picture.size != pictures[TRUTH].size:
            sizes = [f"{width}×{height}" for width, height in (picture.size, pictures[TRUTH].size)]
            raise ValueError(f"{paths[label]} has {sizes[0]} pixels, but its photograph has {sizes[1]}.")
    truth, *rendered = pictures.values()
    pictures = {label: picture.convert("RGB") for label, picture in pictures.items()}
    if truth.has_transparency_data:
        pictures[TRUTH] = _opaque(truth.convert("RGBA"), [np.asarray(image.convert("RGB")) for image in rendered])
    arrays = [np.asarray(picture, np.float32) / 255 for picture in pictures.values()]
    box = crop_window(arrays[0], arrays[1:])
    written = []
    for i, (label, picture) in enumerate(pictures.items()):
        overview, crop = Path(f"{prefix}{i}.png"), Path(f"{prefix}{i}-crop.png")
        picture.crop(box).save(output / crop)
        _overview(picture, box).save(output / overview)
        written.append(Picture(label, overview, crop))
    return View(scene, name, box, written)


def _read(path: Path) -> Image.Image:
    try:
        with Image.open(path) as image:
            image.load()
            return image
    except (OSError, UnidentifiedImageError) as error:
        raise ValueError(f"{path} is not an image that can be read ({error}).") from error


def _opaque(truth: Image.Image, rendered: Sequence[NDArray[np.uint8]]) -> Image.Image:
    """A photograph with alpha over the background that the renderings show where it is transparent."""
    clear = np.asarray(truth)[..., 3] == 0
    shown = np.concatenate([image[clear] for image in rendered])
    color = np.median(shown, 0).round().astype(int).tolist() if len(shown) else [0, 0, 0]
    return Image.alpha_composite(Image.new("RGBA", truth.size, (*color, 255)), truth).convert("RGB")


def _overview(picture: Image.Image, box: Box) -> Image.Image:
    """The whole picture, at most `WIDTH` wide, with the window outlined in white within black."""
    scale = min(1.0, WIDTH / picture.width)
    small = picture.resize(
        (round(picture.width * scale), max(1, round(picture.height * scale))), Image.Resampling.LANCZOS
    )
    left, top, right, bottom = (round(edge * scale) for edge in box)
    draw = ImageDraw.Draw(small)
    draw.rectangle((left - 3, top - 3, right + 2, bottom + 2), outline="black", width=6)
    draw.rectangle((left - 1, top - 1, right, bottom), outline="white", width=2)
    return small
