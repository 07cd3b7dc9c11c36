"""Converts photos that COLMAP does not read, their opacities and masks."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image, ImageCms, ImageOps

from sadgs_ns.data.images import valid_pixels
from sadgs_ns.errors import InputError
from sadgs_ns.placing.bit_depth import read_scaled
from sadgs_ns.placing.colours import profile_of
from sadgs_ns.placing.panoramas import cut
from sadgs_ns.placing.photos import Photo, empty_folder, threads

_KEPT_SUFFIXES = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp"}  # COLMAP writes by these, and reads by content.


def convert_photos(folder: Path, photos: Sequence[Photo], converted: Path) -> tuple[Path, list[Photo]]:
    """Convert photos that COLMAP does not read, turn those that are not upright, and cut panoramas.

    The folder `converted` then holds conversions, and links to the other photos, unless it exists already. Return the
    folder of photos that COLMAP reads, and the photos and views in it. Raise InputError if one would replace another.
    """
    new = []
    for photo in photos:
        new += [dataclasses.replace(view, name=_converted_name(view)) for view in photo.views]
    counts = Counter(view.name for view in new)
    doubles = [name for name, count in counts.items() if count > 1]
    if doubles:
        raise InputError(f"{folder}: converted, two photos would be called {doubles[0]}; rename one of them.")
    if new == list(photos) and all(photo.is_read and not photo.is_turned for photo in photos):
        return folder, new
    if converted.exists():
        return converted, new
    partial = empty_folder(converted.with_name(f"{converted.name}.partial"))
    with threads() as pool:
        list(pool.map(lambda photo: _convert(photo, folder, partial), photos))
    partial.rename(converted)
    return converted, new


def _converted_name(photo: Photo) -> str:
    """Return the name of a photo or view after its conversion; its suffix is one by which COLMAP writes."""
    suffix = Path(photo.name).suffix.lower()
    is_jpeg = suffix in (".jpg", ".jpeg")
    if suffix in _KEPT_SUFFIXES and not (photo.has_alpha and is_jpeg):
        return photo.name
    if photo.has_alpha:
        return f"{photo.name}.png"
    return f"{photo.name}.jpg"


def _convert(photo: Photo, folder: Path, target: Path) -> None:
    """Write the conversion or the views of a photo to the folder `target`, or a link to it if it needs none."""
    source = Path(os.path.realpath(folder / photo.name))
    files = [target / _converted_name(view) for view in photo.views]
    files[0].parent.mkdir(parents=True, exist_ok=True)
    if photo.is_turned or photo.is_panorama or not photo.is_read:
        with Image.open(source) as image:
            exif = Image.Exif()
            if image.format != "TIFF":  # A TIFF's tells of its pixels, too.
                exif = image.getexif()
            profile = profile_of(image)
            image.info.pop("exif", None)  # Pillow would write it anew, which fails where it is damaged.
            stored: Image.Image = image
            if photo.bit_depth is not None:
                stored = read_scaled(image, source, photo.bit_depth)
            pixels = _upright_pixels(stored, photo, profile)
            kept = _without_orientation(exif)  # Only now, since `image` needs it to be turned.
            parts = [pixels]
            if photo.is_panorama:
                parts = cut(pixels)
            for part, file in zip(parts, files, strict=True):
                part.save(file, exif=kept, quality=97, subsampling=0)  # the latter two for JPEG alone
        return
    try:
        files[0].symlink_to(source)
    except OSError:  # Some file systems hold no links.
        shutil.copyfile(source, files[0])


def _without_orientation(exif: Image.Exif) -> bytes:
    """Remove the orientation from EXIF data, and return these as a file holds them, empty if they are damaged."""
    exif.pop(ExifTags.Base.Orientation, None)
    with contextlib.suppress(Exception):  # Pillow raises anything where EXIF is damaged.
        return exif.tobytes()
    return b""


def _upright_pixels(image: Image.Image, photo: Photo, profile: ImageCms.ImageCmsProfile | None) -> Image.Image:
    """Turn an image as its EXIF data says, and convert it from its profile to sRGB unless it is grey of 16 bits."""
    if photo.is_turned:
        image = ImageOps.exif_transpose(image)
    if image.mode == "I;16":
        return image
    mode = "RGB"
    if photo.has_alpha:
        mode = "RGBA"
    return _in_srgb(image, profile, mode)


def _in_srgb(image: Image.Image, profile: ImageCms.ImageCmsProfile | None, mode: str) -> Image.Image:
    """Convert an image from its profile to RGB or RGBA in sRGB, since training and viewers know no profiles."""
    if profile is None:
        return image.convert(mode)
    if image.mode != "CMYK":
        image = image.convert(mode)
    with contextlib.suppress(ImageCms.PyCMSError):  # The profile is of another kind of pixels.
        srgb = ImageCms.createProfile("sRGB")
        image = ImageCms.profileToProfile(image, profile, srgb, outputMode=mode) or image
    return image.convert(mode)


def write_alpha(folder: Path, photos: Sequence[Photo], alphas: Path) -> int:
    """Empty `alphas`, write the opacity of each partly transparent photo `NAME` there as `NAME.png`, and count them."""
    empty_folder(alphas)
    count = 0
    for photo in photos:
        if photo.has_alpha:
            with Image.open(folder / photo.name) as image:
                alpha = image.convert("RGBA").getchannel("A")
            if alpha.getextrema() != (255, 255):
                target = alphas / f"{photo.name}.png"
                target.parent.mkdir(parents=True, exist_ok=True)
                alpha.save(target)
                count += 1
    return count


def write_masks(
    folder: Path, masks: Mapping[str, str], photos: Sequence[Photo], converted: Sequence[Photo], target: Path
) -> int:
    """Write a mask for each photo `NAME` as it was `converted`, `NAME.png` in `target`, a white one if it has none.

    Return how many of them hide something. Raise InputError if a mask has another shape than its photo, or white parts
    that are transparent.
    """
    num_hiding = 0
    names = iter(f"{photo.name}.png" for photo in converted)
    for photo in photos:
        mask = Image.new("L", photo.size, 255)
        if photo.name in masks:
            mask = _read_mask(folder / masks[photo.name], photo, folder / photo.name)
        if mask.getextrema() != (255, 255):
            num_hiding += 1
        parts = [mask]
        if photo.is_panorama:
            parts = cut(mask)
        for part in parts:
            file = target / next(names)
            file.parent.mkdir(parents=True, exist_ok=True)
            part.save(file)
    return num_hiding


def _read_mask(file: Path, photo: Photo, photo_file: Path) -> Image.Image:
    """Read a mask, upright and in the photo's size, in black and white.

    Raise InputError if it has another shape, or white parts that are transparent, which may mean either of the two.
    """
    with Image.open(file) as image:
        is_transparent = False
        if image.has_transparency_data:
            image = image.convert("RGBA")
            is_transparent = np.asarray(image.getchannel("A")) < 128
        is_valid = valid_pixels(image)
        if (is_valid & is_transparent).any():
            problem = f"{file} is a mask whose white has transparent parts"
            raise InputError(f"{problem}: save it without transparency, black where {photo.name} is to be hidden.")
        mask = Image.fromarray(np.uint8(255 * is_valid))
    width, height = photo.size
    lies_on_side = (mask.width > mask.height) != (width > height)
    if photo.is_turned and lies_on_side:  # It was made of the photo as that is stored.
        with Image.open(photo_file) as stored:
            mask.getexif()[ExifTags.Base.Orientation] = stored.getexif()[ExifTags.Base.Orientation]
        mask = ImageOps.exif_transpose(mask)
    stretch = mask.width * height / (mask.height * width)
    if not 0.97 < stretch < 1.03:
        problem = f"{file} has another shape than {photo.name}, whose mask it is by its name"
        raise InputError(f"{problem}: make it of the whole photo, or take it out of the folder.")
    return mask.resize(photo.size, Image.Resampling.NEAREST)


def restore_alpha(images: Path, alphas: Path) -> None:
    """Give those images that exist the opacity that `write_alpha` wrote, which has their size."""
    for path in alphas.rglob("*.png"):
        target = images / path.relative_to(alphas).with_suffix("")
        if target.exists():
            with Image.open(target) as image, Image.open(path) as alpha:
                pixels = image.convert("RGB")
                pixels.putalpha(alpha.convert("L"))
            pixels.save(target)
