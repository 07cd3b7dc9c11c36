"""Checks of the names of images, and of the lists that say which are trained on and which are held out."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from os.path import commonpath
from pathlib import Path, PurePosixPath
from typing import Any

from sadgs_ns.data.checks.findings import Finding
from sadgs_ns.errors import InputError

SPLITS = ("train", "val", "test")
"""Parts of the images: nerfstudio trains on the first, `ns-train` measures the second, and `ns-eval` the third."""
_SHELL = set('"$`\\')
"""Characters that a shell acts on within double quotes; nerfstudio puts names between such when it runs ffmpeg."""


def check_splits(
    lists: Mapping[str, Any],
    called: Callable[[str], str],
    locate: Callable[[str], Path],
    images: Collection[Path],
) -> Iterator[Finding]:
    """Check the lists of a capture that has any; nerfstudio then divides the images by nothing else.

    Args:
        lists: What is given as the list of each split, for the splits that have one.
        called: The start of a sentence about a split's list.
        locate: The file that a name in a list stands for.
        images: The files that have poses.

    Raises:
        InputError: If training or evaluation on the way lacks its list, or one of the lists names no such image.
    """
    for split in ("train", "val"):
        if split not in lists:
            raise InputError(f"{called(split)} is missing beside other lists of images: add it, or remove the others.")
    located: dict[str, set[Path]] = {}
    for split, names in lists.items():
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise InputError(f"{called(split)} is no list of images' names: correct it, or remove all such lists.")
        unknown = [name for name in names if locate(name) not in images]
        if unknown:
            more = f" (and {len(unknown) - 1} more)" if len(unknown) > 1 else ""
            raise InputError(f"{called(split)} names {unknown[0]!r}{more}, which is no image with a pose: correct it.")
        located[split] = {locate(name) for name in names}
    if not located.get("test"):
        state = "is empty" if "test" in located else "is missing"
        yield Finding("warning", f"{called('test')} {state}: `ns-eval` will have nothing to measure; name some images.")
    elif both := located["train"] & located["test"]:
        yield Finding(
            "warning",
            f"{called('test')} names {len(both)} of the {len(located['train'])} training images: what `ns-eval` "
            "measures of them shows nothing about new views.",
        )


def check_names(names: Iterable[str], source: Path) -> None:
    """Refuse names of images that leave their folder, or that a shell would act on.

    nerfstudio gives its downscaled copies these names, and has a shell make them.

    Args:
        names: Relative to the folder of images.
        source: The file that holds them.

    Raises:
        InputError: Names the first such image.
    """
    for name in names:
        if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
            raise InputError(f"{source}: image {name!r} lies outside the folder of images: move it there.")
        if _SHELL & set(name) or not name.isprintable():
            raise InputError(f"{source}: image {name!r} has a name that a shell would act on: rename it.")


def check_paths(paths: Sequence[Path]) -> None:
    """Refuse images if one of them leaves the folder that all have in common by "..".

    `ns-render dataset` writes each image below its output folder, under the image's path from that common folder.

    Raises:
        InputError: Names the first such path.
    """
    if not paths or len({path.is_absolute() for path in paths}) > 1:
        return  # Absolute and relative paths have no folder in common.
    shared = commonpath(paths)
    for path in paths:
        if ".." in path.relative_to(shared).parts:
            raise InputError(f"{path} leads out of {shared}, where the other images are: name it without '..'.")
