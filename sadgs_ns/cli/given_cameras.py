"""Cameras that the source of `sadgs` brings, so that none are looked for."""

from __future__ import annotations

import os
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from sadgs_ns.cli.division import is_divided
from sadgs_ns.cli.sadgs_options import Sadgs, adapt_remedy
from sadgs_ns.data.checks import check_data
from sadgs_ns.data.checks.findings import check_findings
from sadgs_ns.data.layouts import find_cameras
from sadgs_ns.errors import InputError
from sadgs_ns.placing.folder import images_of
from sadgs_ns.placing.stamps import changes_of, photo_stamps

_PARSERS = ("colmap", "nerfstudio-data", "blender-data")


@dataclass(frozen=True)
class GivenCameras:
    """The file of a capture's cameras: a COLMAP model's images, or transforms.json."""

    file: Path
    capture: Path  # The folder of the capture
    is_divided: bool  # Whether something else than `--measure` says which views are held out

    def describe(self) -> str:
        """Return a text that is another one if the file is another one."""
        name = os.path.relpath(self.file, self.capture)
        return f"{name} (checksum {zlib.crc32(self.file.read_bytes()):08x})"

    def is_described_by(self, text: str) -> bool:
        """Return whether a text is the description, in earlier versions with the path as it was typed."""
        return text == self.describe() or text.endswith(f"/{self.describe()}")

    def stamp_images(self) -> dict[str, list[int]]:
        """Return a stamp of each image and mask, as `photo_stamps` does."""
        return photo_stamps(self.capture, images_of(self.file, self.capture))

    def changed_images(self, stamps: dict[str, list[int]]) -> list[str]:
        """Return the changes of images and masks since they were stamped, as parts of a sentence."""
        changes = changes_of(self.capture, stamps, images_of(self.file, self.capture))
        return [f"images {change}" for change in changes.values()]


def find_given_cameras(options: Sadgs, train_options: Sequence[str]) -> GivenCameras | None:
    """Find the cameras that the source brings; raise InputError if they cannot be trained on."""
    if options.cameras == "new":
        return None
    try:
        file = find_cameras(options.source)
        if file is None:
            return None
        if not any(
            parser in train_options for parser in _PARSERS
        ):  # Training checks what a parser reads that is named.
            check_findings(check_data(options.source), options.source)
        divided = is_divided(file, options.source, options.measure, train_options)
    except InputError as error:
        problem = adapt_remedy(str(error).rstrip("."), train_options)
        raise InputError(f"{problem}; or find new cameras with --cameras new.") from None
    if options.max_size != Sadgs.max_size:
        smaller = "or for images of half the size `-- --pipeline.datamanager.camera-res-scale-factor 0.5` at the end"
        raise InputError(f"--max-size is for new cameras, and those of {file} are used: leave it out, {smaller}.")
    capture = options.source
    if not capture.is_dir():
        capture = capture.parent
    return GivenCameras(file, capture, divided)
