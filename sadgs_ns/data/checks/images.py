"""Checks of image files, which mostly look at their headers alone."""

from __future__ import annotations

import os
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path, PureWindowsPath

from sadgs_ns.data import images
from sadgs_ns.data.checks.findings import Finding, and_more, fault, note, warning

MASK_MODES = ("L", "1", "I;16", "I")  # Pillow's modes of masks; nerfstudio trains on every pixel that is not 0
_TURN = "turn their pixels as those poses want it, and take the tag away, as ImageMagick's `mogrify -auto-orient` does"


def check_images(frames: Sequence[images.Frame], source: Path, look_for_unused: bool = False) -> Iterator[Finding]:
    """Check the images and masks of frames from a source, and say in a note how many and of what kind they are.

    Images are decoded until one shows something, and masks until one leaves a pixel to train on. If asked, a warning
    tells of images beside the frames' that no frame uses.
    """
    with ThreadPoolExecutor() as pool:
        headers = list(pool.map(images.read_header, (frame.image for frame in frames)))
        masks = list(pool.map(lambda frame: frame.mask and images.read_header(frame.mask), frames))
    problems: dict[str, list[tuple[Path, str]]] = defaultdict(list)
    for found in filter(None, map(_problem, frames, headers, masks, [source] * len(frames))):
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
    if all(images.is_flat(frame.image) for frame in frames):
        told = f"{source} has {len(frames)} images that show a single colour and nothing else"
        yield fault(f"{told}, such as {frames[0].image}: export them again.")
    if all(frame.mask is not None and images.is_flat(frame.mask, black=True) for frame in frames):
        told = f"{source} has {len(frames)} masks that are all black, such as {frames[0].mask}"
        yield fault(f"{told}, which leaves no pixel to train on: make white what is to be trained on.")
    if lying := [frame.image for frame, image in zip(frames, headers, strict=True) if _may_lie(image)]:
        told = f"{and_more(lying[0], len(lying))} has an EXIF orientation that would turn it"
        remedy = f"if the poses are those of the turned images, {_TURN}"
        yield warning(f"{told}, which training ignores, as COLMAP does: {remedy}.")
    if other := [frame.image for frame, image in zip(frames, headers, strict=True) if image.has_profile]:
        told = f"{and_more(other[0], len(other))} has a colour profile, which training takes for sRGB, so that viewers"
        yield warning(f"{told} show other colours: convert to sRGB, as ImageMagick's `mogrify -profile sRGB.icc` does.")
    yield note(_describe(source, headers, masks))


def _may_lie(image: images.Header) -> bool:
    """Return whether EXIF would turn or mirror an image without a change of its size, which the pose could be of."""
    return image.format != "TIFF" and image.orientation in (
        images.NOT_UPRIGHT if len({*image.size}) == 1 else range(2, 5)
    )


def _problem(
    frame: images.Frame, image: images.Header, mask: images.Header | None, source: Path
) -> tuple[str, Path, str] | None:
    """Return the problem of a frame's files, or None: its kind, the file and the rest of the sentence."""
    if image.problem.startswith("does not exist"):
        places = (frame.image.parent, source.parent / "images", source.parent)
        stem = PureWindowsPath(str(frame.image)).stem.lower()  # Windows' paths and names in other case occur.
        if near := [path for place in places for path in images.images_in(place) if path.stem.lower() == stem]:
            return "near", frame.image, f"does not exist, but {near[0]} does: correct the name, or save that as this"
    if image.problem:
        return image.problem.split(" (")[0], frame.image, image.problem
    if image.mode not in ("RGB", "RGBA", "L"):
        return "mode", frame.image, f"has pixels of Pillow's mode {image.mode}: convert it to 8-bit RGB"
    if min(image.size) < 2:
        return "small", frame.image, "has {} × {} px: leave it out of the reconstruction".format(*image.size)
    if frame.size not in (None, image.size):
        sizes = "{} × {} px, but its camera in {} {} × {}".format(*image.size, source, *frame.size)
        if image.orientation in images.SIDEWAYS and frame.size == image.size[::-1]:
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


def _describe(source: Path, headers: Sequence[images.Header], masks: Sequence[images.Header | None]) -> str:
    """Return a sentence on number, size and kind of good images, and on the number of masks."""
    sizes = Counter(image.size for image in headers)
    kinds = Counter(f"{image.format} {image.mode}" for image in headers)
    (width, height), _ = sizes.most_common(1)[0]
    of_size = f"{width} × {height} px" + (" and other sizes" if len(sizes) > 1 else "")
    of_kind = ", ".join(f"{kind} ({count})" if len(kinds) > 1 else kind for kind, count in kinds.most_common())
    masked = sum(mask is not None for mask in masks)
    count = f"with {masked}" if masked else "without"
    text = f"{source} has {len(headers)} images of {of_size}, {of_kind}, {count} masks."
    if max(map(max, sizes)) > images.MAX_AUTO_RESOLUTION:
        half = "`--pipeline.datamanager.camera-res-scale-factor 0.5` trains at half their resolution"
        text += f" Images of more than {images.MAX_AUTO_RESOLUTION} px take long: {half}."
    return text


def _unused_images(frames: Sequence[images.Frame]) -> list[Path]:
    # Unlike Path.resolve, realpath does not raise where links form a loop.
    used = {os.path.realpath(path) for frame in frames for path in (frame.image, frame.mask) if path is not None}
    folders = sorted({frame.image.parent for frame in frames})
    return [path for folder in folders for path in images.images_in(folder) if os.path.realpath(path) not in used]
