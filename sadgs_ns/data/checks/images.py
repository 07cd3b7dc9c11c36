"""Checks of image files, which mostly look at their headers alone."""

from __future__ import annotations

import os
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from sadgs_ns.data import images
from sadgs_ns.data.checks.findings import Finding, and_more, fault, note, warning
from sadgs_ns.data.nearby import NearbyFiles

_TURN = "turn their pixels as those poses want it, and take the tag away, as ImageMagick's `mogrify -auto-orient` does"


def check_images(
    frames: Sequence[images.Frame], source: Path, data: Path, look_for_unused: bool = False
) -> Iterator[Finding]:
    """Check the images and masks of frames from a source, and say in a note how many and of what kind they are.

    Files that are missing are looked for below the folder of the data. Images without mask beside others with one give
    a warning with their number.

    Images are decoded until one shows something, and masks until one hides a part. If asked, a warning
    tells of images beside the frames' that no frame uses.
    """
    with ThreadPoolExecutor() as pool:
        headers = list(pool.map(images.read_header, (frame.image for frame in frames)))
        masks = list(pool.map(lambda frame: frame.mask and images.read_header(frame.mask), frames))
    problems: dict[str, list[tuple[Path, str]]] = defaultdict(list)
    nearby = NearbyFiles(data, {frame.image for frame in frames} | {frame.mask for frame in frames if frame.mask})
    for frame, header, mask in zip(frames, headers, masks, strict=True):
        found = _problem(frame, header, mask, source, nearby)
        if found is not None:
            problems[found[0]].append(found[1:])
    for same in problems.values():
        path, text = same[0]
        yield fault(f"{and_more(path, len(same))} {text}.")
    poses = Counter(frame.image for frame in frames)
    repeated = [image for image, number in poses.items() if number > 1]
    if repeated:
        where = and_more(repeated[0], len(repeated))
        yield fault(f"{source} has more than one pose of {where}: keep one, or give each an image of its own.")
    if look_for_unused:
        yield from _check_unused(frames, source)
    if problems:
        return
    if all(images.is_flat(frame.image) for frame in frames):
        problem = f"{source} has {len(frames)} images that show a single colour and nothing else"
        yield fault(f"{problem}, such as {frames[0].image}: export them again.")
    yield from _check_masks(frames, source)
    yield from _check_headers(frames, headers)
    yield note(_describe(source, headers, masks))


def _check_unused(frames: Sequence[images.Frame], source: Path) -> Iterator[Finding]:
    unused = _unused_images(frames)
    if unused:
        where = and_more(unused[0], len(unused))
        yield warning(f"{where} has no pose in {source} and is not used: reconstruct again if it matters.")


def _check_masks(frames: Sequence[images.Frame], source: Path) -> Iterator[Finding]:
    """Check that good masks leave a pixel to train on, and hide one, and tell of images without mask beside others."""
    masks = [frame.mask for frame in frames if frame.mask is not None]
    if not masks:
        return
    unmasked = [frame.image for frame in frames if frame.mask is None]
    if unmasked:
        problem = f"{source} has masks for {len(masks)} of {len(frames)} images"
        yield warning(f"{problem}: nothing is hidden in the others, such as {unmasked[0]}; add masks if it should be.")
    elif all(images.is_uniform_mask(mask, valid=False) for mask in masks):
        problem = f"{source} has {len(masks)} masks that are all black, such as {masks[0]}"
        yield fault(f"{problem}, which leaves no pixel to train on: make white what is to be trained on.")
    if all(images.is_uniform_mask(mask, valid=True) for mask in masks):
        problem = f"{source} has {len(masks)} masks that hide nothing, such as {masks[0]}"
        yield warning(f"{problem}: make black what is to be hidden, which is what is darker than half of the white.")


def _check_headers(frames: Sequence[images.Frame], headers: Sequence[images.Header]) -> Iterator[Finding]:
    """Check good images for orientations and colour profiles, which training ignores."""
    paths = [frame.image for frame in frames]
    turned = [path for path, header in zip(paths, headers, strict=True) if _may_be_turned(header)]
    if turned:
        problem = f"{and_more(turned[0], len(turned))} has an EXIF orientation that would turn it"
        remedy = f"if the poses are those of the turned images, {_TURN}"
        yield warning(f"{problem}, which training ignores, as COLMAP does: {remedy}.")
    profiled = [path for path, header in zip(paths, headers, strict=True) if header.has_profile]
    if profiled:
        problem = f"{and_more(profiled[0], len(profiled))} has a colour profile, which training takes for sRGB"
        remedy = "convert to sRGB, as ImageMagick's `mogrify -profile sRGB.icc` does"
        yield warning(f"{problem}, so that viewers show other colours: {remedy}.")


def _may_be_turned(image: images.Header) -> bool:
    """Return whether EXIF would turn or mirror an image without a change of its size, which the pose could be of."""
    if image.format == "TIFF":
        return False
    width, height = image.size
    if width == height:
        return image.orientation in images.NOT_UPRIGHT
    return image.orientation in images.NOT_UPRIGHT and image.orientation not in images.SIDEWAYS


def _problem(
    frame: images.Frame, image: images.Header, mask: images.Header | None, source: Path, nearby: NearbyFiles
) -> tuple[str, Path, str] | None:
    """Return the kind of a problem, the file that has it, and the rest of a sentence; None if the files are good.

    Problems of one kind are told in one sentence.

    Args:
        frame: The frame whose image and mask are checked.
        image: The image's header.
        mask: The mask's header, or None if the frame has no mask.
        source: The file that the frame is from.
        nearby: Finds the file that is meant by the name of a missing one.
    """
    if image.problem.startswith("does not exist"):
        sentence = nearby.sentence(frame.image)
        if sentence is not None:
            return "near", frame.image, sentence
    if image.problem:
        kind = image.problem.split(" (")[0]  # Details follow in brackets.
        return kind, frame.image, image.problem
    if image.mode not in ("RGB", "RGBA", "L"):
        return "mode", frame.image, f"has pixels of Pillow's mode {image.mode}: convert it to 8-bit RGB"
    width, height = image.size
    if min(width, height) < 2:
        return "small", frame.image, f"has {width} × {height} px: leave it out of the reconstruction"
    if frame.size is not None and frame.size != image.size:
        camera_width, camera_height = frame.size
        sizes = f"{width} × {height} px, but its camera in {source} {camera_width} × {camera_height}"
        if image.orientation in images.SIDEWAYS and frame.size == (height, width):
            orientation = f"EXIF orientation {image.orientation}"
            return "orientation", frame.image, f"has {orientation} and is read as {sizes}: {_TURN}"
        return "size", frame.image, f"has {sizes}: use the images that the poses were computed from"
    if frame.mask is None or mask is None:
        return None
    return _mask_problem(frame.image, image, frame.mask, mask, nearby)


def _mask_problem(
    image_path: Path, image: images.Header, path: Path, mask: images.Header, nearby: NearbyFiles
) -> tuple[str, Path, str] | None:
    """Return the problem of the mask of a good image, as `_problem` does."""
    if mask.problem.startswith("does not exist"):
        sentence = nearby.sentence(path)
        if sentence is not None:
            return "near mask", path, sentence
    if mask.problem:
        kind = mask.problem.split(" (")[0]
        return kind, path, mask.problem
    if mask.mode not in images.GREY_MODES:
        return "mask mode", path, f"is a mask of Pillow's mode {mask.mode}: convert it to 8-bit grey"
    if mask.size != image.size:
        return "mask", path, f"is a mask of another size than {image_path}: resize it"
    return None


def _describe(source: Path, headers: Sequence[images.Header], masks: Sequence[images.Header | None]) -> str:
    """Return a sentence on number, size and kind of good images, and on the number of masks."""
    sizes = Counter(image.size for image in headers)
    kinds = Counter(f"{image.format} {image.mode}" for image in headers)
    (width, height), _ = sizes.most_common(1)[0]
    of_size = f"{width} × {height} px"
    if len(sizes) > 1:
        of_size += " and other sizes"
    of_kind = ", ".join(kinds)
    if len(kinds) > 1:
        of_kind = ", ".join(f"{kind} ({count})" for kind, count in kinds.most_common())
    num_masks = sum(mask is not None for mask in masks)
    with_masks = "without masks"
    if num_masks:
        with_masks = f"with {num_masks} masks"
    text = f"{source} has {len(headers)} images of {of_size}, {of_kind}, {with_masks}."
    if max(map(max, sizes)) > images.MAX_AUTO_RESOLUTION:
        half = "`--pipeline.datamanager.camera-res-scale-factor 0.5` trains at half their resolution"
        text += f" Images of more than {images.MAX_AUTO_RESOLUTION} px take long: {half}."
    return text


def _unused_images(frames: Sequence[images.Frame]) -> list[Path]:
    # Unlike Path.resolve, realpath does not raise where links form a loop.
    used = {os.path.realpath(frame.image) for frame in frames}
    used |= {os.path.realpath(frame.mask) for frame in frames if frame.mask is not None}
    unused = []
    for folder in sorted({frame.image.parent for frame in frames}):
        unused += [path for path in images.images_in(folder) if os.path.realpath(path) not in used]
    return unused
