"""Colour spaces of photos: the profile that a file holds, or Adobe RGB where EXIF alone tells it."""

from __future__ import annotations

import contextlib
import functools
import io
import struct

from PIL import ExifTags, Image, ImageCms

from sadgs_ns.data.images import UNREADABLE, color_profile

_CAMERA_FORMATS = ("JPEG", "MPO")
_UNCALIBRATED = 65535  # EXIF's ColorSpace that is not sRGB
_INDEX = 1  # EXIF's tag InteroperabilityIndex
_ADOBE_RGB_FILE = "R03"  # The index by which cameras tell Adobe RGB
_ADOBE_RGB = {  # In 1/65536, from Adobe's specification of 1998; the columns are adapted to D50.
    b"wtpt": (62289, 65536, 71372),  # White, D65
    b"rXYZ": (39960, 20389, 1276),
    b"gXYZ": (13453, 41004, 3989),
    b"bXYZ": (9777, 4143, 48796),
}
_ADOBE_GAMMA = 563  # in 1/256
_ADOBE_DATE = (1998, 5, 1, 0, 0, 0)
_D50 = (63190, 65536, 54061)  # White of ICC profiles, in 1/65536
_HEADER_SIZE = 128  # Bytes of an ICC profile's header
_ICC_VERSION = 0x02100000  # 2.1


def profile_of(image: Image.Image) -> ImageCms.ImageCmsProfile | None:
    """Return the profile of a photo's colours, None if these are sRGB's or not known.

    Many cameras write no profile for Adobe RGB, but tell it by EXIF.
    """
    if _is_adobe_rgb_by_exif(image):
        return ImageCms.ImageCmsProfile(io.BytesIO(adobe_rgb_profile()))
    return color_profile(image)


def _is_adobe_rgb_by_exif(image: Image.Image) -> bool:
    """Return whether a photo has no profile, and EXIF tells of Adobe RGB as the standard of camera files wants it."""
    if image.mode != "RGB" or image.format not in _CAMERA_FORMATS or "icc_profile" in image.info:
        return False
    # EXIF may be damaged, and Pillow 11 raises KeyError where it has no part on interoperability.
    with contextlib.suppress(*UNREADABLE, KeyError):
        exif = image.getexif()
        if exif.get_ifd(ExifTags.IFD.Exif).get(ExifTags.Base.ColorSpace) == _UNCALIBRATED:
            index = exif.get_ifd(ExifTags.IFD.Interop).get(_INDEX)
            return str(index).rstrip("\0 ") == _ADOBE_RGB_FILE
    return False


@functools.cache
def adobe_rgb_profile() -> bytes:
    """Return an ICC profile of Adobe RGB (1998), as a display's of three primaries and a gamma."""
    name = b"Adobe RGB (1998)\0"
    unused = bytes(78)  # of a description: its translations
    tags = {
        b"desc": struct.pack(">4s4xI", b"desc", len(name)) + name + unused,
        b"cprt": struct.pack(">4s4x5s", b"text", b"none\0"),
    }
    for tag, xyz in _ADOBE_RGB.items():
        tags[tag] = struct.pack(">4s4x3i", b"XYZ ", *xyz)
    for tag in (b"rTRC", b"gTRC", b"bTRC"):
        tags[tag] = struct.pack(">4s4xIH", b"curv", 1, _ADOBE_GAMMA)
    start = _HEADER_SIZE + 4 + 12 * len(tags)
    table = struct.pack(">I", len(tags))
    values = b""
    for tag, value in tags.items():
        table += struct.pack(">4sII", tag, start + len(values), len(value))
        padding = bytes(-len(value) % 4)
        values += value + padding
    header = struct.pack(">I4xI4s4s4s", start + len(values), _ICC_VERSION, b"mntr", b"RGB ", b"XYZ ")
    header += struct.pack(">6H4s28x", *_ADOBE_DATE, b"acsp")
    header += struct.pack(">3i", *_D50)
    return header.ljust(_HEADER_SIZE, b"\0") + table + values
