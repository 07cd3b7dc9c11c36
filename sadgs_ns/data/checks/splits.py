"""Checks of the names of images, and of the lists that say which are trained on and which are held out."""

from __future__ import annotations

import math
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from os.path import commonpath
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from sadgs_ns.data.checks.findings import Finding, and_more, warning
from sadgs_ns.data.layouts import ParserOptions
from sadgs_ns.data.nearby import similar_name
from sadgs_ns.errors import InputError

SPLITS = ("train", "val", "test")  # nerfstudio trains on the first, `ns-train` measures the second, `ns-eval` the third
_SHELL = set('"$`\\')  # A shell acts on them in double quotes, between which nerfstudio names files to ffmpeg.


def check_splits(
    names: Sequence[str], lists: Mapping[str, Any], subject: Callable[[str], str], locate: Callable[[str], Path],
    options: ParserOptions,
) -> Generator[Finding, None, int]:  # fmt: skip
    """Check how the images with poses are divided, and return how many are trained on.

    Args:
        names: The names of all images that have poses.
        lists: The list of each split that has one. If there are any, nerfstudio divides the images by these alone.
        subject: Returns the subject of a sentence about a split's list.
        locate: Returns the file that a name stands for.
        options: How the images are divided without lists.

    Raises:
        InputError: If there are lists but none of "train" or none of "val", if a list is no list of names or names an
            unknown image, or if `eval_mode` is "filename" and a file's name has neither "train" nor "eval".
    """
    if not lists:
        return _count_training_images(names, options)
    images = set(map(locate, names))
    for split in ("train", "val"):
        if split not in lists:
            raise InputError(f"{subject(split)} is missing beside other lists of images: add it, or remove the others.")
    located: dict[str, set[Path]] = {}
    for split, listed in lists.items():
        if not isinstance(listed, list) or not all(isinstance(name, str) for name in listed):
            raise InputError(f"{subject(split)} is no list of images' names: correct it, or remove all such lists.")
        unknown = [name for name in listed if locate(name) not in images]
        if unknown:
            which = and_more(repr(unknown[0]), len(unknown))
            remedy = "correct it"
            similar = similar_name(unknown[0], names)
            if similar is not None:
                remedy = f"{similar!r} may be meant; {remedy}"
            raise InputError(f"{subject(split)} names {which}, which is no image with a pose: {remedy}.")
        located[split] = set(map(locate, listed))
    training = located["train"]
    tests = located.get("test", set())
    in_both = training & tests
    if "test" not in located:
        yield warning(f"{subject('test')} is missing: `ns-eval` will have nothing to measure; name some images.")
    elif not tests and located["val"]:
        yield warning(f"{subject('test')} is empty: `ns-eval` will have nothing to measure; name some images.")
    elif in_both:
        problem = f"{subject('test')} names {len(in_both)} of the {len(training)} training images"
        yield warning(f"{problem}: what `ns-eval` measures of them shows nothing about new views.")
    return len(training)


def _count_training_images(names: Sequence[str], options: ParserOptions) -> int:
    """Return how many images are trained on if there are no lists; raise InputError for a name without a split."""
    if options.eval_mode == "fraction":
        return math.ceil(len(names) * options.train_split_fraction)
    if options.eval_mode == "interval":
        is_held_out = np.arange(len(names)) % options.eval_interval == 0
        return len(names) - int(np.count_nonzero(is_held_out))
    if options.eval_mode != "filename":
        return len(names)
    files = [PurePosixPath(name).name for name in names]
    for name, file in zip(names, files, strict=True):
        if "train" not in file and "eval" not in file:
            problem = f"{name} has neither train nor eval in its name"
            cause = "by which `--eval-mode filename` divides the images"
            raise InputError(f"{problem}, {cause}: rename them, or leave that option out.")
    return sum("train" in file for file in files)


def check_names(names: Iterable[str], source: Path) -> None:
    """Raise InputError for the first image whose name leaves its folder, or that nerfstudio's shell would act on."""
    for name in names:
        if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts:
            raise InputError(f"{source}: image {name!r} lies outside the folder of images: move it there.")
        if _SHELL & set(name) or not name.isprintable():
            raise InputError(f"{source}: image {name!r} has a name that a shell would act on: rename it.")


def check_paths(paths: Sequence[Path]) -> None:
    """Raise InputError for the first image that leaves the folder that all have in common by "..".

    `ns-render dataset` writes each image below its output folder, under the image's path from that common folder.
    """
    if not paths or len({path.is_absolute() for path in paths}) > 1:
        return  # Absolute and relative paths have no folder in common.
    shared = commonpath(paths)
    for path in paths:
        if ".." in path.relative_to(shared).parts:
            raise InputError(f"{path} leads out of {shared}, where the other images are: name it without '..'.")
