"""Checks of the lists that say which images are trained on, and which are held out."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Any

from sadgs_ns.data.checks.findings import Finding
from sadgs_ns.errors import InputError

SPLITS = ("train", "val", "test")
"""Parts of the images: nerfstudio trains on the first, `ns-train` measures the second, and `ns-eval` the third."""


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
