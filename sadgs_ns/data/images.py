"""Readers of image files: their headers, sizes and colours, and the names of their smaller copies and masks."""

from __future__ import annotations

import io
import math
import re
import struct
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
UNREAD_SUFFIXES = {
    ".heic", ".heif", ".jxl", ".exr", ".hdr", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".pef",
    ".srw",
}  # fmt: skip
"""Suffixes of HEIC, JPEG XL, pixels without a limit, and raw files, which training does not read.

Programs also give them to JPEG; Pillow takes previews of some for TIFF."""
UNREAD_REMEDY = (
    "convert it, as ImageMagick's `mogrify -format png` does, and put the PNG in its place under the name in the poses"
)
"""What to do with an image in a format that is not read. The name's suffix does not matter to training."""
_UNREAD_STARTS = {
    "HEIC": rb"....ftyp(hei|hev|mif1|msf1)",
    "JPEG XL": rb"\xff\x0a|\x00\x00\x00\x0cJXL ",
    "OpenEXR": rb"\x76\x2f\x31\x01",
    "Radiance": rb"#\?R(ADIANCE|GBE)",
    "raw": rb"....ftypcrx|FUJIFILMCCD-RAW|IIRO|IIU\x00|MMOR",
}
"""How files in formats that are not read begin, in regular expressions."""
VIDEO_SUFFIXES = {
    ".3gp", ".avi", ".m2ts", ".m4v", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg", ".mts", ".mxf", ".ogv", ".webm", ".wmv",
}  # fmt: skip
"""Suffixes of videos in a folder."""
UNSTITCHED_SUFFIXES = {".360", ".insp", ".insv"}
"""Suffixes of photos and videos as 360° cameras store them: circles of two fisheye lenses, or faces of a cube."""
MAX_AUTO_RESOLUTION = 1600  # Longest side in px up to which nerfstudio looks for no smaller copies of images
UNREADABLE = (
    OSError, RuntimeError, SyntaxError, TypeError, ValueError, struct.error, Image.DecompressionBombError,
)  # fmt: skip
"""What Pillow raises where an image is damaged. Only its functions are called where this is caught, so that a mistake
in others is not taken for damage."""
NOT_UPRIGHT = range(2, 9)  # EXIF's orientations of turned or mirrored images. Pillow turns TIFF by itself, but no other
SIDEWAYS = range(5, 9)  # Those of them that exchange the sides
GREY_MODES = ("L", "1", "I;16", "I")
"""Pillow's modes of images with one number a pixel, as masks have."""
NO_MASK = Path("no mask")
"""Stands among masks' files for that of an image without mask, of which nothing is hidden."""
Rounding = Literal["floor", "round", "ceil"]
Size = tuple[int, int]  # Width and height in px


@dataclass(frozen=True)
class Frame:
    """An image, the size that its camera has, and its mask."""

    image: Path
    size: Size | None  # The camera's size; None if it has none of its own
    mask: Path | None = None


@dataclass(frozen=True)
class Header:
    """The header of an image file."""

    size: Size = (0, 0)  # Zeros if it is unknown
    mode: str = ""  # Pillow's name for the kind of pixels
    format: str = ""  # Pillow's name for the format of the file
    orientation: int = 1  # As EXIF gives it
    has_profile: bool = False  # Whether its colours are others than sRGB's
    problem: str = ""  # The rest of a sentence that starts with the file; empty for a good image


def images_in(folder: Path) -> list[Path]:
    """Return the images directly in a folder, sorted; none if there is no folder."""
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in IMAGE_SUFFIXES)


def read_header(path: Path) -> Header:
    """Read an image's header, and decode the image only if the end of the file does not show that it is whole.

    For a file that cannot be read, the header has a problem.
    """
    remedy = "copy it again, or leave it out of the reconstruction"
    try:
        if path.stat().st_size == 0:
            return Header(problem=f"has 0 bytes: {remedy}")
        with Image.open(path) as image:
            orientation = 1
            with suppress(Exception):  # An image with damaged EXIF counts as upright.
                # `image.getexif` would decode a PNG.
                orientation = Image.Image.getexif(image).get(ExifTags.Base.Orientation, 1)
            has_profile = color_profile(image) is not None
            header = Header(image.size, image.mode, image.format or "", orientation, has_profile)
            is_raw = image.format == "TIFF" and path.suffix.lower() in UNREAD_SUFFIXES
            is_unread = image.format == "HEIF" or is_raw
            is_whole = is_unread or _ends_well(path, image)
        if is_unread:
            return Header(problem=_unread_problem(path))
        if not is_whole:
            with Image.open(path) as image:
                image.load()
        return header
    except FileNotFoundError:
        return Header(problem="does not exist: put it there, or leave it out of the reconstruction")
    except UnidentifiedImageError:
        if _unread_format(path) is not None:
            return Header(problem=_unread_problem(path))
        return Header(problem=f"is no image that Pillow knows: {remedy}")
    except Exception as error:  # Decoders raise OSError, SyntaxError, struct.error, …
        return Header(problem=f"cannot be read as an image ({reason(error)}): {remedy}")


def _unread_format(path: Path) -> str | None:
    """Return the name of a file's format if its first bytes are those of one that is not read, or None."""
    with path.open("rb") as file:
        start = file.read(16)
    return next((name for name, pattern in _UNREAD_STARTS.items() if re.match(pattern, start, re.DOTALL)), None)


def _unread_problem(path: Path) -> str:
    """Return the rest of a sentence on a file whose format is not read, or is that of a raw file if none is known."""
    return f"is a file in the format {_unread_format(path) or 'raw'}, which is not read: {UNREAD_REMEDY}"


def _ends_well(path: Path, image: Image.Image) -> bool:
    """Return whether the file of an open image is surely whole. If not, only decoding shows whether it is."""
    if image.format == "JPEG":
        with path.open("rb") as file:
            file.seek(-2, 2)
            return file.read() == b"\xff\xd9"
    if image.format != "PNG":
        return False
    with suppress(Exception):  # It also fails where only the last bytes are missing, and the image can be decoded.
        image.verify()  # This reads its checksums.
        return True
    return False


SMALL_PHOTO = 640
"""Longest side in px below which a photo shows few features; those of phones have 3,000 and more."""


def image_size(path: Path) -> Size:
    """Return width and height in px, or zeros if they cannot be read."""
    return read_header(path).size


def color_profile(image: Image.Image) -> ImageCms.ImageCmsProfile | None:
    """Return the profile of an image's colours if they are others than sRGB's, such as a phone's Display P3."""
    if image.mode not in ("RGB", "RGBA", "CMYK"):
        return None
    with suppress(KeyError, OSError, ImageCms.PyCMSError):  # Most images have no profile, and some a damaged one.
        profile = ImageCms.ImageCmsProfile(io.BytesIO(image.info["icc_profile"]))
        if "sRGB" not in ImageCms.getProfileDescription(profile):
            return profile
    return None


def read_small(path: Path) -> NDArray[np.uint8] | None:
    """Return an image's colours, or None if it cannot be read. [H, W, 3]

    A JPEG is scaled down while it is decoded, which takes less time.
    """
    try:
        with Image.open(path) as image:
            image.draft("RGB", (160, 160))  # The least width and height of a JPEG that is scaled down
            return np.asarray(image.convert("RGB"))
    except Exception:  # The check of images names broken ones.
        return None


def is_flat(path: Path) -> bool:
    """Return whether all visible pixels have one colour. A JPEG is decoded at an eighth of its size."""
    try:
        with Image.open(path) as image:
            image.draft(None, (image.width // 8, image.height // 8))
            shown = image
            if image.mode == "RGBA":
                shown = image.convert("RGBa")  # Transparent pixels become black.
            extrema: Any = shown.getextrema()
    except Exception:  # A decoder's failure shows no single colour, and nerfstudio's reader may yet read the file.
        return False
    channels = extrema
    if not isinstance(extrema[0], tuple):  # The image has one channel.
        channels = [extrema]
    return all(low == high for low, high in channels)


def valid_pixels(mask: Image.Image) -> NDArray[np.bool_]:
    """Return which pixels of an open mask are brighter than half of its brightest one; the others are hidden. [H, W]

    Black may so be 16, as in video, or have noise, as in JPEG, and white may be 1. A mask of one value hides nothing
    unless it is 0.
    """
    if mask.mode not in GREY_MODES:
        mask = mask.convert("L")
    values = np.asarray(mask)
    return values > int(values.max()) // 2


def is_uniform_mask(path: Path, valid: bool) -> bool:
    """Return whether no pixel of a mask is hidden if `valid`, or else whether all are; False if it cannot be read."""
    try:
        with Image.open(path) as mask:
            pixels = valid_pixels(mask)
    except Exception:  # As in `is_flat`
        return False
    return bool((pixels == valid).all())


def scaled_size(size: Size, factor: int, rounding: Rounding) -> Size:
    """Return a camera's width and height after nerfstudio scaled them down, in its float32."""
    width, height = (float(np.float32(side) * np.float32(1.0 / factor)) for side in size)
    if rounding == "floor":
        return math.floor(width), math.floor(height)
    if rounding == "ceil":
        return math.ceil(width), math.ceil(height)
    return math.floor(width + 0.5), math.floor(height + 0.5)


def rounding_of(image: Path, copy: Path, factor: int) -> Rounding:
    """Return how the sides of an image's smaller copy were rounded; "floor", nerfstudio's default, if none fits."""
    size = image_size(image)
    copy_size = image_size(copy)
    for rounding in get_args(Rounding):
        if scaled_size(size, factor, rounding) == copy_size:
            return rounding
    return "floor"


def smaller_folder(folder: Path, factor: int) -> Path:
    """Return the folder in which nerfstudio keeps copies of a folder's images that are smaller by a factor."""
    if factor <= 1:
        return folder
    return folder.with_name(f"{folder.name}_{factor}")


def automatic_factor(image: Path, copy_of: Callable[[int], Path] | None = None) -> int:
    """Return the factor by which nerfstudio scales images down if the user names none.

    It is the smallest power of 2 that makes the image's sides 1600 px or less. If `copy_of` returns where the copy for
    a factor would lie, the factor is only as large as there are copies, as for a `transforms.json`.
    """
    longest = max(image_size(image))
    factor = 1
    while longest / factor > MAX_AUTO_RESOLUTION:
        if copy_of is not None and not copy_of(2 * factor).exists():
            break
        factor *= 2
    return factor


def mask_name(folder: Path, image: str) -> Path | None:
    """Return the path of an image's mask, relative to the folder of masks; None if the image has no mask.

    Programs name masks in several ways. The first name that exists in the folder counts.
    """
    stem = PurePosixPath(image).with_suffix("")
    for start in (stem, image, f"{stem}_mask", f"{stem}.mask", f"{image}.mask"):
        name = Path(f"{start}.png")
        if (folder / name).is_file():
            return name
    return None
