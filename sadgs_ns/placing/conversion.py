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

from sadgs_ns.data.images import color_profile
from sadgs_ns.errors import InputError
from sadgs_ns.placing.panoramas import cut
from sadgs_ns.placing.photos import Photo, empty_folder, threads

_KEPT_SUFFIXES = {".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp"}  # COLMAP writes by these, and reads by content.


def convert_photos(folder: Path, photos: Sequence[Photo], converted: Path) -> tuple[Path, list[Photo]]:
    """Convert photos that COLMAP does not read, turn those that are not upright, and cut panoramas.

    The folder `converted` then holds conversions, and links to the other photos, unless it exists already. Return the
    folder of photos that COLMAP reads, and the photos and views in it. Raise InputError if one would replace another.
    """

    def converted_name(photo: Photo) -> str:
        suffix = Path(photo.name).suffix.lower()
        if suffix in _KEPT_SUFFIXES and not (photo.has_alpha and suffix in (".jpg", ".jpeg")):
            return photo.name
        return photo.name + (".png" if photo.has_alpha else ".jpg")

    new = [dataclasses.replace(view, name=converted_name(view)) for photo in photos for view in photo.views]
    if doubles := [name for name, number in Counter(view.name for view in new).items() if number > 1]:
        raise InputError(f"{folder}: converted, two photos would be called {doubles[0]}; rename one of them.")
    if new == list(photos) and all(photo.is_read and not photo.is_turned for photo in photos):
        return folder, new
    if converted.exists():
        return converted, new
    partial = empty_folder(converted.with_name(f"{converted.name}.partial"))

    def convert(photo: Photo) -> None:
        source = Path(os.path.realpath(folder / photo.name))
        targets = [partial / converted_name(view) for view in photo.views]
        targets[0].parent.mkdir(parents=True, exist_ok=True)
        if photo.is_turned or not photo.is_read or photo.is_panorama:
            with Image.open(source) as image:
                exif = Image.Exif() if image.format == "TIFF" else image.getexif()  # A TIFF's tells of its pixels, too.
                image.info.pop("exif", None)  # Pillow would write it anew, which fails where it is damaged.
                pixels = ImageOps.exif_transpose(image) if photo.is_turned else image
                exif.pop(ExifTags.Base.Orientation, None)
                kept = b""
                with contextlib.suppress(Exception):  # Pillow raises anything where EXIF is damaged.
                    kept = exif.tobytes()
                if pixels.mode != "I;16":
                    pixels = _in_srgb(pixels, "RGBA" if photo.has_alpha else "RGB")
                for part, target in zip(cut(pixels) if photo.is_panorama else [pixels], targets, strict=True):
                    part.save(target, exif=kept, quality=97, subsampling=0)  # the latter two for JPEG alone
            return
        try:
            targets[0].symlink_to(source)
        except OSError:  # Some file systems hold no links.
            shutil.copyfile(source, targets[0])

    with threads() as pool:
        list(pool.map(convert, photos))
    partial.rename(converted)
    return converted, new


def _in_srgb(image: Image.Image, mode: str) -> Image.Image:
    """Convert an image to RGB or RGBA in sRGB, since training and viewers know no profiles."""
    if (profile := color_profile(image)) is None:
        return image.convert(mode)
    image = image if image.mode == "CMYK" else image.convert(mode)
    with contextlib.suppress(ImageCms.PyCMSError):  # The profile is of another kind of pixels.
        image = ImageCms.profileToProfile(image, profile, ImageCms.createProfile("sRGB"), outputMode=mode) or image
    return image.convert(mode)


def write_alpha(folder: Path, photos: Sequence[Photo], alphas: Path) -> int:
    """Empty `alphas`, write the opacity of each partly transparent photo `NAME` there as `NAME.png`, and count them."""
    empty_folder(alphas)
    for photo in photos:
        if photo.has_alpha:
            with Image.open(folder / photo.name) as image:
                alpha = image.convert("RGBA").getchannel("A")
            if alpha.getextrema() != (255, 255):
                target = alphas / f"{photo.name}.png"
                target.parent.mkdir(parents=True, exist_ok=True)
                alpha.save(target)
    return sum(1 for _ in alphas.rglob("*.png"))


def write_masks(
    folder: Path, masks: Mapping[str, str], photos: Sequence[Photo], converted: Sequence[Photo], target: Path
) -> None:
    """Write a mask for each photo `NAME` as it was `converted`, `NAME.png` in `target`, a white one if it has none.

    Raise InputError if a mask has another shape than its photo.
    """
    names = iter(f"{photo.name}.png" for photo in converted)
    for photo in photos:
        mask = Image.new("L", photo.size, 255)
        if photo.name in masks:
            with Image.open(folder / masks[photo.name]) as image, Image.open(folder / photo.name) as stored:
                grey = np.asarray(image.convert("L"))
                mask = Image.fromarray(np.uint8(255 * (grey > grey.max() // 2)))
                if photo.is_turned and (mask.width > mask.height) != (photo.size[0] > photo.size[1]):
                    mask.getexif()[ExifTags.Base.Orientation] = stored.getexif()[ExifTags.Base.Orientation]
                    mask = ImageOps.exif_transpose(mask)
        if not 0.97 < mask.width * photo.size[1] / (mask.height * photo.size[0]) < 1.03:
            problem = f"{folder / masks[photo.name]} has another shape than {photo.name}, whose mask it is by its name"
            raise InputError(f"{problem}: make it of the whole photo, or take it out of the folder.")
        mask = mask.resize(photo.size, Image.Resampling.NEAREST)
        for part, name in zip(cut(mask) if photo.is_panorama else [mask], names, strict=False):
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            part.save(target / name)


def restore_alpha(images: Path, alphas: Path) -> None:
    """Give those images that exist the opacity that `write_alpha` wrote, which has their size."""
    for path in alphas.rglob("*.png"):
        if (target := images / path.relative_to(alphas).with_suffix("")).exists():
            with Image.open(target) as image, Image.open(path) as alpha:
                pixels = image.convert("RGB")
                pixels.putalpha(alpha.convert("L"))
            pixels.save(target)
