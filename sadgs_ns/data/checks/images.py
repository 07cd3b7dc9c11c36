"""Checks of image files, which mostly look at their headers alone."""

from __future__ import annotations

import io
import math
import os
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageCms, UnidentifiedImageError

from sadgs_ns.data import IMAGE_SUFFIXES
from sadgs_ns.data.checks.findings import Finding, and_more, fault, note, warning
from sadgs_ns.errors import reason

MAX_AUTO_RESOLUTION = 1600  # Longest side in px up to which nerfstudio looks for no smaller copies of images
MASK_MODES = ("L", "1", "I;16", "I")  # Pillow's modes of masks; nerfstudio trains on every pixel that is not 0
NOT_UPRIGHT, SIDEWAYS = range(2, 9), range(5, 9)
"""EXIF's orientations, and those of them that exchange the sides. Pillow turns TIFF by itself, and nothing else."""
_TURN = "turn their pixels as those poses want it, and take the tag away, as ImageMagick's `mogrify -auto-orient` does"
Rounding = Literal["floor", "round", "ceil"]
Size = tuple[int, int]  # Width and height in px


@dataclass(frozen=True)
class Frame:
    """An image, and the size that its camera tells."""

    image: Path
    size: Size | None  # The camera's size; None if it has none of its own
    mask: Path | None = None


@dataclass(frozen=True)
class _Image:
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
    return _inspect(path).size


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


def check_images(frames: Sequence[Frame], source: Path, look_for_unused: bool = False) -> Iterator[Finding]:
    """Check the images and masks of frames from a source, and say in a note how many and of what kind they are.

    Images are decoded until one shows something, and masks until one leaves a pixel to train on. If asked, a warning
    tells of images beside the frames' that no frame uses.
    """
    with ThreadPoolExecutor() as pool:
        images = list(pool.map(_inspect, (frame.image for frame in frames)))
        masks = list(pool.map(lambda frame: frame.mask and _inspect(frame.mask), frames))
    problems: dict[str, list[tuple[Path, str]]] = defaultdict(list)
    for found in filter(None, map(_problem, frames, images, masks, [source] * len(frames))):
        problems[found[0]].append(found[1:])
    for same in problems.values():
        path, text = same[0]
        yield fault(f"{and_more(path, len(same))} {text}.")
    if twice := [image for image, poses in Counter(frame.image for frame in frames).items() if poses > 1]:
        told = f"{source} has more than one pose of {and_more(twice[0], len(twice))}"
        yield fault(f"{told}: keep one, or give each an image of its own.")
    if look_for_unused and (unused := _unused_images(frames)):
        where = and_more(unused[0], len(unused))
        yield warning(f"{where} has no pose in {source} and is not used: reconstruct again if it matters.")
    if problems:
        return
    if all(_is_flat(frame.image) for frame in frames):
        told = f"{source} has {len(frames)} images that show a single colour and nothing else"
        yield fault(f"{told}, such as {frames[0].image}: export them again.")
    if all(frame.mask is not None and _is_flat(frame.mask, black=True) for frame in frames):
        told = f"{source} has {len(frames)} masks that are all black, such as {frames[0].mask}"
        yield fault(f"{told}, which leaves no pixel to train on: make white what is to be trained on.")
    if lying := [frame.image for frame, image in zip(frames, images, strict=True) if _may_lie(image)]:
        told = f"{and_more(lying[0], len(lying))} has an EXIF orientation that would turn it"
        remedy = f"if the poses are those of the turned images, {_TURN}"
        yield warning(f"{told}, which training ignores, as COLMAP does: {remedy}.")
    if other := [frame.image for frame, image in zip(frames, images, strict=True) if image.has_profile]:
        told = f"{and_more(other[0], len(other))} has a colour profile, which training takes for sRGB, so that viewers"
        yield warning(f"{told} show other colours: convert to sRGB, as ImageMagick's `mogrify -profile sRGB.icc` does.")
    yield note(_describe(source, images, masks))


def _may_lie(image: _Image) -> bool:
    """Return whether EXIF would turn or mirror an image without a change of its size, which the pose could be of."""
    return image.format != "TIFF" and image.orientation in (NOT_UPRIGHT if len({*image.size}) == 1 else range(2, 5))


def _problem(frame: Frame, image: _Image, mask: _Image | None, source: Path) -> tuple[str, Path, str] | None:
    """Return the problem of a frame's files, or None: its kind, the file and the rest of the sentence."""
    if image.problem.startswith("does not exist"):
        places = (frame.image.parent, source.parent / "images", source.parent)
        stem = PureWindowsPath(str(frame.image)).stem.lower()  # Windows' paths and names in other case occur.
        if near := [path for place in places for path in images_in(place) if path.stem.lower() == stem]:
            return "near", frame.image, f"does not exist, but {near[0]} does: correct the name, or save that as this"
    if image.problem:
        return image.problem.split(" (")[0], frame.image, image.problem
    if image.mode not in ("RGB", "RGBA", "L"):
        return "mode", frame.image, f"has pixels of Pillow's mode {image.mode}: convert it to 8-bit RGB"
    if min(image.size) < 2:
        return "small", frame.image, "has {} × {} px: leave it out of the reconstruction".format(*image.size)
    if frame.size not in (None, image.size):
        sizes = "{} × {} px, but its camera in {} {} × {}".format(*image.size, source, *frame.size)
        if image.orientation in SIDEWAYS and frame.size == image.size[::-1]:
            sizes = f"EXIF orientation {image.orientation} and is read as {sizes}: {_TURN}"
            return "orientation", frame.image, f"has {sizes}"
        return "size", frame.image, f"has {sizes}: use the images that the poses were computed from"
    if frame.mask is None or mask is None:
        return None
    if mask.problem:
        return mask.problem.split(" (")[0], frame.mask, mask.problem
    if mask.mode not in MASK_MODES:
        return "mask mode", frame.mask, f"is a mask of Pillow's mode {mask.mode}: convert it to 8-bit grey"
    if mask.size != image.size:
        return "mask", frame.mask, f"is a mask of another size than {frame.image}: resize it"
    return None


def _describe(source: Path, images: Sequence[_Image], masks: Sequence[_Image | None]) -> str:
    """Return a sentence on number, size and kind of good images, and on the number of masks."""
    sizes = Counter(image.size for image in images)
    kinds = Counter(f"{image.format} {image.mode}" for image in images)
    (width, height), _ = sizes.most_common(1)[0]
    of_size = f"{width} × {height} px" + (" and other sizes" if len(sizes) > 1 else "")
    of_kind = ", ".join(f"{kind} ({count})" if len(kinds) > 1 else kind for kind, count in kinds.most_common())
    masked = sum(mask is not None for mask in masks)
    count = f"with {masked}" if masked else "without"
    text = f"{source} has {len(images)} images of {of_size}, {of_kind}, {count} masks."
    if max(map(max, sizes)) > MAX_AUTO_RESOLUTION:
        half = "`--pipeline.datamanager.camera-res-scale-factor 0.5` trains at half their resolution"
        text += f" Images of more than {MAX_AUTO_RESOLUTION} px take long: {half}."
    return text


def _unused_images(frames: Sequence[Frame]) -> list[Path]:
    # Unlike Path.resolve, realpath does not raise where links form a loop.
    used = {os.path.realpath(path) for frame in frames for path in (frame.image, frame.mask) if path is not None}
    folders = sorted({frame.image.parent for frame in frames})
    return [path for folder in folders for path in images_in(folder) if os.path.realpath(path) not in used]


def images_in(folder: Path) -> list[Path]:
    """Return the images right in a folder, sorted; none if there is no folder."""
    paths = folder.iterdir() if folder.is_dir() else ()
    return sorted(path for path in paths if path.suffix.lower() in IMAGE_SUFFIXES)


def _inspect(path: Path) -> _Image:
    """Read an image's header, and decode it only if the file's end does not tell that it is whole."""
    again = "copy it again, or leave it out of the reconstruction"
    try:
        if path.stat().st_size == 0:
            return _Image(problem=f"has 0 bytes: {again}")
        with Image.open(path) as image:
            size, mode, kind, orientation = image.size, image.mode, image.format or "", 1
            with suppress(Exception):  # Damaged EXIF matters to no one. A PNG's own method would decode the image.
                orientation = Image.Image.getexif(image).get(ExifTags.Base.Orientation, 1)
            has_profile, whole = color_profile(image) is not None, _ends_well(path, image)
        if not whole:
            with Image.open(path) as image:
                image.load()
    except FileNotFoundError:
        return _Image(problem="does not exist: put it there, or leave it out of the reconstruction")
    except UnidentifiedImageError:
        return _Image(problem=f"is no image that Pillow knows: {again}")
    except Exception as error:  # Decoders raise OSError, SyntaxError, struct.error, …
        return _Image(problem=f"cannot be read as an image ({reason(error)}): {again}")
    return _Image(size, mode, kind, orientation, has_profile)


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


def _is_flat(path: Path, black: bool = False) -> bool:
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
