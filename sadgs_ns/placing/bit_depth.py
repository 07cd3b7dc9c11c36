"""Bits that the values of photos use: files of 16 bits a value often hold 10, 12 or 14, as a sensor gives them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image

WHOLE = 16  # Bits of a file that uses all of them
_DEPTHS = (8, 10, 12, 14, WHOLE)
_BITS_OF_PNG = 24  # Place in a PNG's header of the byte that tells its bits a value


def largest_value(image: Image.Image, file: Path) -> int | None:
    """Return the largest value of a photo's colours, None if its file has 8 bits a value or fewer."""
    if _bits_of_file(image, file) <= 8:
        return None
    pixels = _read_16_bits(file)
    if pixels is None:
        return None
    return int(_colours_of(pixels).max())


def depth_of(largest_values: Iterable[int]) -> int:
    """Return the bits that the values of all photos use, given each one's largest value."""
    largest = max(largest_values)
    return next(depth for depth in _DEPTHS if largest < 2**depth)


def read_scaled(image: Image.Image, file: Path, depth: int) -> Image.Image:
    """Read a photo's file of 16 bits whose values use `depth` bits, and scale these to 8 bits.

    The result has the orientation of Pillow's `image` of the file. Raise OSError if it cannot be read any more.
    """
    pixels = _read_16_bits(file)
    if pixels is None:
        raise OSError(f"{file} cannot be read any more: put it back, and run the same command again")
    scaled = _to_8_bits(_colours_of(pixels), depth)
    if pixels.shape[2] == 4:
        opacity = pixels[:, :, 3:]
        if opacity.max() >= 2**depth:  # Programs that leave colours as a sensor gives them make it 16 bits.
            depth = WHOLE
        scaled = np.dstack([scaled, _to_8_bits(opacity, depth)])
    result = Image.fromarray(scaled.squeeze())
    if image.format != "TIFF":  # OpenCV turns these by itself, but no other with IMREAD_UNCHANGED.
        orientation = image.getexif().get(ExifTags.Base.Orientation, 1)
        result.getexif()[ExifTags.Base.Orientation] = orientation
    return result


def sentence_on_depth(depth: int, largest_values: Sequence[int]) -> str:
    """Return the sentence that tells of photos of 16 bits whose values use fewer, given each one's largest value."""
    white = 2**depth - 1
    largest = max(largest_values)
    subject = f"{len(largest_values)} photos of 16 bits use"
    if len(largest_values) == 1:
        subject = "1 photo of 16 bits uses"
    sentence = f"{subject} {depth} of them (largest value {largest:,}): {white:,} becomes white."
    brighter = sum(value > white for value in largest_values)
    if brighter:
        sentence += (
            f" The first photos of the scene decided this; {brighter} of these hold larger values, which become white,"
            " too: begin another scene to keep them."
        )
    return sentence


def _bits_of_file(image: Image.Image, file: Path) -> int:
    """Return the bits of a value in a photo's file. Pillow's modes do not tell, as colours of 16 bits become RGB."""
    if image.format == "PNG":
        with file.open("rb") as stored:
            return stored.read(_BITS_OF_PNG + 1)[_BITS_OF_PNG]
    if image.format == "TIFF":
        return int(np.max(image.getexif().get(ExifTags.Base.BitsPerSample, 1)))
    return 8  # The libraries of other formats return 8 bits.


def _read_16_bits(file: Path) -> NDArray[np.uint16] | None:
    """Read a file with all its bits, None if OpenCV cannot, or its values are no integers. [H, W, 1, 3 or 4], BGR"""
    import cv2  # Most photos need it not, and it takes time to import.

    pixels = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    if pixels is None or pixels.dtype != np.uint16:
        return None
    return np.asarray(pixels.reshape(*pixels.shape[:2], -1), np.uint16)


def _colours_of(pixels: NDArray[np.uint16]) -> NDArray[np.uint16]:
    """Return the colours without opacity. BGR or BGRA [H, W, 3 or 4], grey [H, W, 1] → RGB [H, W, 3], [H, W, 1]"""
    return pixels[:, :, 2::-1]


def _to_8_bits(values: NDArray[np.uint16], depth: int) -> NDArray[np.uint8]:
    """Scale values of `depth` bits to 8 bits; larger ones become white. [H, W, C]"""
    white = 2**depth - 1
    table = np.round(np.arange(2**WHOLE).clip(max=white) * (255 / white)).astype(np.uint8)
    return table[values]
