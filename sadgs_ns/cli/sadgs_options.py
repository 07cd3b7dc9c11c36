"""The options of `sadgs`, and what is checked of them before any work."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from sadgs_ns.data.checks import check_data
from sadgs_ns.data.checks.findings import check_findings
from sadgs_ns.data.layouts import find_cameras
from sadgs_ns.errors import InputError
from sadgs_ns.formats import FORMATS, MESH
from sadgs_ns.formats.mesh import load_open3d

SET_OPTIONS = (
    "data",
    "output-dir",
    "experiment-name",
    "timestamp",
    "vis",
    "load-dir",
    "load-checkpoint",
    "load-config",
)
"""Options of ns-train that this command sets."""
FORMAT_NAMES = [suffix[1:] for suffix in (*FORMATS, MESH)]


@dataclass
class Sadgs:
    """From photos or a video to a splat that opens in a browser: cameras (sadgs-process), training (ns-train sadgs) and
    export (sadgs-export), each of which is a command of its own, too. Run it again to resume; nothing is done twice.
    Options after -- go to ns-train, as in `sadgs photos -- --max-num-iterations 500`; `sadgs -- --help` lists them."""

    source: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="PHOTOS_OR_VIDEO")]
    """Folder of photos or of videos, or a video."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FOLDER")] = None
    """Folder for all results; by default the source's name and -splat, in the working directory."""
    effort: Annotated[float, tyro.conf.arg(metavar="X")] = 1.0
    """How much training: 0.5 is a draft, 2 resolves more."""
    cameras: Literal["given", "new"] = "given"
    """Use the folder's cameras, a COLMAP model or transforms.json, if it has any, or find new ones."""
    max_size: Annotated[int, tyro.conf.arg(metavar="PX")] = 1600
    """Longest side of the photos, at least 64, 0 to keep it."""
    formats: Annotated[
        str | None,
        tyro.conf.arg(metavar="A,B", help=f"Formats to export, of {', '.join(FORMAT_NAMES)}; by default html,ply."),
    ] = None
    anyway: bool = False
    """Continue even if fewer than half of the photos registered."""
    profile: bool = False
    """Also print where the time went as a table."""


def with_dashes(sentence: str, train_options: Sequence[str]) -> str:
    """Return a sentence on the end of a command of `ns-train` as it is for this one."""
    return sentence.replace("end the command with `", "end the command with `" + "-- " * (not train_options))


def find_given_cameras(options: Sadgs, train_options: Sequence[str]) -> Path | None:
    """Return the file of the source's cameras, or None; raise InputError if they cannot be trained on."""
    try:
        if options.cameras == "new" or (file := find_cameras(options.source)) is None:
            return None
        # Training checks what a parser reads that is named.
        if {"colmap", "nerfstudio-data", "blender-data"}.isdisjoint(train_options):
            check_findings(check_data(options.source), options.source)
    except InputError as error:
        told = with_dashes(str(error).rstrip("."), train_options)
        raise InputError(f"{told}; or find new cameras with --cameras new.") from None
    if options.max_size != Sadgs.max_size:
        smaller = "or for images of half the size `-- --pipeline.datamanager.camera-res-scale-factor 0.5` at the end"
        raise InputError(f"--max-size is for new cameras, and those of {file} are used: leave it out, {smaller}.")
    return file


def choose_formats(asked: str | None, console: Console) -> list[str]:
    """Return the formats to export; raise InputError for an unknown one, or for a page without Node.js."""
    has_node = shutil.which("npx") is not None
    if asked is None:
        if not has_node:
            console.print("Node.js (22 or newer) is not installed, without which no page is made: a PLY is.")
        return ["html", "ply"] if has_node else ["ply"]
    chosen = list(dict.fromkeys(asked.split(",")))
    if unknown := [name for name in chosen if name not in FORMAT_NAMES]:
        raise InputError(f"--formats knows {', '.join(FORMAT_NAMES)}, and not {unknown[0]!r}.")
    if "html" in chosen and not has_node:
        raise InputError("a page is made with the help of Node.js: install version 22 or newer, or leave html out.")
    if MESH[1:] in chosen:
        load_open3d()  # It may be missing, which the user shall know before cameras are found.
    return chosen
