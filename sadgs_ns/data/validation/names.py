"""What the names of a data set's images may be: nerfstudio writes files by them, and passes them to a shell."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from os.path import commonpath
from pathlib import Path, PurePosixPath

from sadgs_ns.errors import InputError

_SHELL = set('"$`\\')
"""What a shell reads within double quotes, which are all that nerfstudio puts around a name when it runs ffmpeg."""


def check_names(names: Iterable[str], source: Path) -> None:
    """Refuse names of images that leave their folder, or that a shell would act on.

    nerfstudio's downscaled copies lie under the names, and a shell makes them.

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
    """Refuse images of which one lies outside the folder that all have in common, by way of "..".

    `ns-render dataset` writes each below its output folder under its path from there.

    Raises:
        InputError: Names the first such path.
    """
    if not paths or len({path.is_absolute() for path in paths}) > 1:
        return  # of a mixture it makes nothing
    shared = commonpath(paths)
    for path in paths:
        if ".." in path.relative_to(shared).parts:
            raise InputError(f"{path} leads out of {shared}, where the other images are: name it without '..'.")
