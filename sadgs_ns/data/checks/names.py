"""Checks of the names of images, by which nerfstudio writes files, and which it passes to a shell."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from os.path import commonpath
from pathlib import Path, PurePosixPath

from sadgs_ns.errors import InputError

_SHELL = set('"$`\\')
"""Characters that a shell acts on within double quotes; nerfstudio puts names between such when it runs ffmpeg."""


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
