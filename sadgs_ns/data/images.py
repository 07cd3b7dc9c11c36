"""Readers of image files: their headers, sizes and colours, and the names of their smaller copies and masks."""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageCms, UnidentifiedImageError

from sadgs_ns.errors import reason

IMAGE_SUFFIXES = {".png", ".jpg", ".jpeg", ".jpe", ".jfif", ".webp", ".avif", ".tif", ".tiff", ".bmp"}
"""Suffixes of the formats of photos that training reads."""
MAX_AUTO_RESOLUTION = 1600  # Longest side in px up to which nerfstudio looks for no smaller copies of images
NOT_UPRIGHT, SIDEWAYS = range(2, 9), range(5, 9)
"""EXIF's orientations, and those of them that exchange the sides. Pillow turns TIFF by itself, and nothing else."""
Rounding = Literal["floor", "round", "ceil"]
Size = tuple[int, int]  # Width and height in px


@dataclass(frozen=True)
class Frame:
    """An image, and the size that its camera tells."""

    image: Path
    size: Size | None  # The camera's size; None if it has none of its own
    mask: Path | None = None


@dataclass(frozen=True)
class Header:
    """The header of an image file."""

    size: Size = (0, 0)  # Zeros if it is unknown
    mode: str = ""  # Pillow's name for the kind of pixels
    format: str = ""  # Pillow's name for the format of the file
    orientation: int = 1  # As EXIF tells it
    has_profile: bool = False  # Whether its colours are others than sRGB's
    problem: str = ""  # The rest of a sentence that starts with the file; empty for a good image


def color_profile(image: Image.Image) -> ImageCms.ImageCmsProfile | None:
    """Return the profile of an image's colours if they are others than sRGB's, such as a phone's Display P3."""
    with suppress(KeyError, OSError, ImageCms.PyCMSError):  # Most have none, and some a damaged one.
        profile = ImageCms.ImageCmsProfile(io.BytesIO(image.info["icc_profile"]))
        is_other = image.mode in ("RGB", "RGBA", "CMYK") and "sRGB" not in ImageCms.getProfileDescription(profile)
        return profile if is_other else None
    return None


def image_size(path: Path) -> Size:
    """Return width and height in px, zeros where they cannot be read."""
    return read_header(path).size


def scaled_size(size: Size, factor: int, rounding: Rounding) -> Size:
    """Return a camera's width and height after nerfstudio scaled them down, in its float32."""
    width, height = (float(np.float32(side) * np.float32(1.0 / factor)) for side in size)
    to_int = {"floor": math.floor, "round": lambda value: math.floor(value + 0.5), "ceil": math.ceil}[rounding]
    return to_int(width), to_int(height)


def rounding_of(image: Path, copy: Path, factor: int) -> Rounding:
    """Return how the sides of an image's smaller copy were rounded; "floor", nerfstudio's default, if none fits."""
    fitting = (mode for mode in get_args(Rounding) if scaled_size(image_size(image), factor, mode) == image_size(copy))
    return next(fitting, "floor")


def smaller_folder(folder: Path, factor: int) -> Path:
    """Return the folder in which nerfstudio keeps copies of a folder's images that are smaller by a factor."""
    return folder.with_name(f"{folder.name}_{factor}") if factor > 1 else folder


def mask_name(folder: Path, image: str) -> Path:
    """Return the file of an image's mask, relative to a folder of masks, by the first name in use that exists there."""
    stem = PurePosixPath(image).with_suffix("")
    names = [Path(f"{start}.png") for start in (stem, image, f"{stem}_mask", f"{stem}.mask", f"{image}.mask")]
    return next((name for name in names if (folder / name).is_file()), names[0])


def automatic_factor(image: Path, copy_of: Callable[[int], Path] | None = None) -> int:
    """Return the factor by which nerfstudio scales images down if the user names none.

    It is the smallest power of 2 that makes the image's sides 1600 px or less. If `copy_of` returns where the copy for
    a factor would lie, the factor is only as large as there are copies, as for a `transforms.json`.
    """
    factor, size = 1, image_size(image)
    while max(size) / factor > MAX_AUTO_RESOLUTION and (copy_of is None or copy_of(2 * factor).exists()):
        factor *= 2
    return factor


def images_in(folder: Path) -> list[Path]:
    """Return the images right in a folder, sorted; none if there is no folder."""
    paths = folder.iterdir() if folder.is_dir() else ()
    return sorted(path for path in paths if path.suffix.lower() in IMAGE_SUFFIXES)


def read_header(path: Path) -> Header:
    """Read an image's header, and decode it only if the file's end does not tell that it is whole."""
    again = "copy it again, or leave it out of the reconstruction"
    try:
        if path.stat().st_size == 0:
            return Header(problem=f"has 0 bytes: {again}")
        with Image.open(path) as image:
            size, mode, kind, orientation = image.size, image.mode, image.format or "", 1
            with suppress(Exception):  # Damaged EXIF matters to no one. A PNG's own method would decode the image.
                orientation = Image.Image.getexif(image).get(ExifTags.Base.Orientation, 1)
            has_profile, whole = color_profile(image) is not None, _ends_well(path, image)
        if not whole:
            with Image.open(path) as image:
                image.load()
    except FileNotFoundError:
        return Header(problem="does not exist: put it there, or leave it out of the reconstruction")
    except UnidentifiedImageError:
        return Header(problem=f"is no image that Pillow knows: {again}")
    except Exception as error:  # Decoders raise OSError, SyntaxError, struct.error, …
        return Header(problem=f"cannot be read as an image ({reason(error)}): {again}")
    return Header(size, mode, kind, orientation, has_profile)


def _ends_well(path: Path, image: Image.Image) -> bool:
    """Return whether an open image is whole for sure; otherwise only decoding it tells."""
    if image.format == "JPEG":
        with path.open("rb") as file:
            file.seek(-2, 2)
            return file.read() == b"\xff\xd9"
    if image.format != "PNG":
        return False
    with suppress(Exception):  # It raises anything, also where the last bytes alone lack, which decodes well.
        image.verify()  # This reads its checksums.
        return True
    return False


def read_small(path: Path) -> NDArray[np.uint8] | None:
    """Return an image's colours [H, W, 3], of a JPEG scaled down as it is decoded; None if it cannot be read."""
    try:
        with Image.open(path) as image:
            image.draft("RGB", (160, 160))  # It keeps at least as many px.
            return np.asarray(image.convert("RGB"))
    except Exception:  # `check_images` tells of broken images.
        return None


def is_flat(path: Path, black: bool = False) -> bool:
    """Return whether all visible pixels have one colour, or are black; a JPEG is decoded at an eighth of its size."""
    try:
        with Image.open(path) as image:
            if not black:  # as in masks
                image.draft(None, (image.width // 8, image.height // 8))
            seen = image.convert("RGBa") if image.mode == "RGBA" else image  # Transparent pixels become black.
            extrema: Any = seen.getextrema()
    except Exception:  # What a decoder stumbles over is no single colour; nerfstudio's reader may yet read it.
        return False
    channels = extrema if isinstance(extrema[0], tuple) else [extrema]
    return all(low == high and not (black and high) for low, high in channels)
