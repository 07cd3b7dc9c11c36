"""Checks of image files, which mostly look at their headers alone."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from PIL import Image, UnidentifiedImageError

from sadgs_ns.data.validation.findings import Finding
from sadgs_ns.errors import reason

IMAGE_SUFFIXES = {".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp"}
MAX_AUTO_RESOLUTION = 1600
"""Longest side in px; nerfstudio looks for smaller copies of images that are larger."""
Rounding = Literal["floor", "round", "ceil"]
Size = tuple[int, int]
"""Width and height in px."""


@dataclass(frozen=True)
class Frame:
    """An image with what its camera says."""

    image: Path
    size: Size | None
    """What the camera says, or None where nothing but the image tells."""
    mask: Path | None = None


@dataclass(frozen=True)
class _Image:
    """What is known of an image file."""

    size: Size = (0, 0)
    """Zeros where it is unknown."""
    mode: str = ""
    """Pillow's name for the kind of pixels."""
    problem: str = ""
    """The rest of a sentence that starts with the file; empty for a good image."""


def image_size(path: Path) -> Size:
    """Width and height in px, zeros where they cannot be read."""
    return _inspect(path).size


def scaled_size(size: Size, factor: int, rounding: Rounding) -> Size:
    """A camera's width and height after nerfstudio scaled them down, in its float32."""
    width, height = (float(np.float32(side) * np.float32(1.0 / factor)) for side in size)
    to_int = {"floor": math.floor, "round": lambda value: math.floor(value + 0.5), "ceil": math.ceil}[rounding]
    return to_int(width), to_int(height)


def smaller_folder(folder: Path, factor: int) -> Path:
    """The folder in which nerfstudio keeps copies of a folder's images that are smaller by a factor."""
    return folder.with_name(f"{folder.name}_{factor}") if factor > 1 else folder


def check_images(frames: Sequence[Frame], source: Path, look_for_unused: bool = False) -> Iterator[Finding]:
    """Check the frames' images and masks.

    Args:
        frames: All frames.
        source: The file that the frames' sizes are from.
        look_for_unused: Whether to warn of images beside the frames' that no frame uses.
    """
    for sentence in image_problems(frames, source):
        yield Finding("error", sentence)
    if look_for_unused and (unused := unused_images(frames, source)) is not None:
        yield Finding("warning", unused)


def image_problems(frames: Sequence[Frame], source: Path) -> Iterator[str]:
    """A sentence for each kind of problem with images and masks, naming the first that has it.

    Args:
        source: The file that the frames' sizes are from.
    """

    def problem(frame: Frame) -> tuple[str, Path, str] | None:
        """Kind, file and the rest of the sentence."""
        image = _inspect(frame.image)
        if image.problem:
            return image.problem.split(" (")[0], frame.image, image.problem
        if image.mode not in ("RGB", "RGBA", "L"):
            return "mode", frame.image, f"has pixels of Pillow's mode {image.mode}: convert it to 8-bit RGB"
        if frame.size not in (None, image.size):
            sizes = "{} × {} px, but its camera in {} {} × {}".format(*image.size, source, *frame.size)
            return "size", frame.image, f"has {sizes}: use the images that the poses were computed from"
        if frame.mask is not None:
            mask = _inspect(frame.mask)
            if mask.problem:
                return mask.problem.split(" (")[0], frame.mask, mask.problem
            if mask.size != image.size:
                return "mask", frame.mask, f"is a mask of another size than {frame.image}: resize it"
        return None

    problems: dict[str, list[tuple[Path, str]]] = defaultdict(list)
    with ThreadPoolExecutor() as pool:
        for found in pool.map(problem, frames):
            if found is not None:
                problems[found[0]].append(found[1:])
    for same in problems.values():
        path, text = same[0]
        yield f"{_and_more(path, len(same))} {text}."


def unused_images(frames: Sequence[Frame], source: Path) -> str | None:
    """A sentence on images beside the frames' that have no pose in the source; None if there are none."""
    used = {path.resolve() for frame in frames for path in (frame.image, frame.mask) if path is not None}
    folders = sorted({frame.image.parent for frame in frames})
    unused = [path for folder in folders for path in images_in(folder) if path.resolve() not in used]
    if not unused:
        return None
    return (
        f"{_and_more(unused[0], len(unused))} has no pose in {source} and is not used: reconstruct again if it matters."
    )


def images_in(folder: Path) -> list[Path]:
    """The images right in a folder, sorted; none where there is no folder."""
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES)


def _and_more(path: Path, count: int) -> str:
    """The first of some paths, and how many others there are."""
    return f"{path} (and {count - 1} more)" if count > 1 else f"{path}"


def _inspect(path: Path) -> _Image:
    """Read an image's header, and decode it only where the file's end does not tell that it is whole."""
    again = "copy it again, or leave it out of the reconstruction"
    try:
        if path.stat().st_size == 0:
            return _Image(problem=f"has 0 bytes: {again}")
        with Image.open(path) as image:
            size, mode = image.size, image.mode
            whole = _ends_well(path, image)
        if not whole:
            with Image.open(path) as image:
                image.load()
    except FileNotFoundError:
        return _Image(problem="does not exist: put it there, or leave it out of the reconstruction")
    except UnidentifiedImageError:
        return _Image(problem=f"is no image that Pillow knows: {again}")
    except Exception as error:  # decoders raise whatever they stumble over: OSError, SyntaxError, struct.error, …
        return _Image(problem=f"cannot be read as an image ({reason(error)}): {again}")
    return _Image(size, mode)


def _ends_well(path: Path, image: Image.Image) -> bool:
    """Whether an image that opened is surely whole, found without decoding it; if not, decoding it tells."""
    if image.format == "JPEG":
        with path.open("rb") as file:
            file.seek(-2, 2)
            return file.read() == b"\xff\xd9"
    if image.format == "PNG":
        try:
            image.verify()  # its checksums
        except Exception:  # as above; a file without its last bytes fails here and decodes well
            return False
        return True
    return False
