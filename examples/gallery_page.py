"""The gallery's pages, in which splats can be turned. mkdocs makes them while it builds the site.

A page bundles a viewer, so it is made and not committed. Where what makes pages cannot be had, as without a network, or
where a splat is missing, the site is built without the page, and a line says so.
"""

from __future__ import annotations

import io
import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sadgs_ns.data.coordinates import Similarity
from sadgs_ns.errors import InputError
from sadgs_ns.formats import html, ply
from sadgs_ns.formats.gaussians import Context, Start

GALLERY = "gallery.md"
logger = logging.getLogger("mkdocs.hooks.gallery")


@dataclass(frozen=True)
class Entry:
    """A page of the gallery."""

    splat: str
    """File below `docs/figures` of which the page is made."""
    page: str
    """Name of the page's file."""
    marker: str
    """Place in the gallery where the link to the page stands."""
    title: str
    """Title of the page."""
    start: Start
    """Camera with which the page opens, in the splat's frame. It looks neither straight up nor straight down."""
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Direction in the splat's frame, of unit length, that is up in the page."""

    @property
    def link(self) -> str:
        """Link that replaces the marker if the page was made."""
        return f"[Turn it with the mouse]({self.page})"


ROOM = Entry(
    splat="room.ply",
    page="room.html",
    marker="<!-- page of the drawn room -->",
    title="A drawn room",
    start=Start(position=(2.466, 2.466, 1.791), target=(0.85, 0.85, 0.55), degrees=64.0),
)
"""The page of the drawn scene. It opens at the first camera, which looks at the middle of the room."""
SITE = Entry(
    splat="site.ply",
    page="site.html",
    marker="<!-- page of the building site -->",
    title="A building site from a drone",
    start=Start(position=(0.005, 4.756, -0.349), target=(0.612, 0.349, 4.588), degrees=66.5),
    up=(-0.1292, -0.0603, -0.9898),
)
"""The page of the drone's capture, whose splat is in the frame of its COLMAP model.

The ground is a plane, and `up` is perpendicular to it. The page opens at the drone's height and with its angle of view,
and looks 45° down at the ground below the middle of the flight. The drone looked nearly straight down, where a viewer
that keeps the horizon level has no heading.
"""
ENTRIES = (ROOM, SITE)


def page_of(entry: Entry, splat: Path) -> bytes:
    """Return the page of an entry, made of its splat.

    Raises InputError if the splat cannot be read, or if what makes pages cannot be run or downloaded.
    """
    gaussians = ply.read(splat)
    to_page = Similarity(1.0, _upright(entry), np.zeros(3))
    points = np.array([entry.start.position, entry.start.target])
    position, target = to_page.positions(points).tolist()
    start = Start(tuple(position), tuple(target), entry.start.degrees)
    page = io.BytesIO()
    html.write(page, gaussians.moved(to_page), Context(start=start, title=entry.title))
    return page.getvalue()


def _upright(entry: Entry) -> NDArray[np.float64]:
    """Return the rotation to a frame in which z is up and the start camera has its right along x. [3, 3]"""
    up = np.array(entry.up)
    forward = np.subtract(entry.start.target, entry.start.position)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    ahead = np.cross(up, right)
    return np.stack([right, ahead, up])


def on_files(files, config):
    """Add the pages to the files of the site. mkdocs calls this."""
    for entry in ENTRIES:
        try:
            content = page_of(entry, Path(config.docs_dir) / "figures" / entry.splat)
        except InputError as error:
            logger.info('The gallery has no page "%s". %s', entry.title, error)
            continue
        from mkdocs.structure.files import File  # pyright: ignore[reportMissingImports]

        files.append(File.generated(config, entry.page, content=content))
    return files


def on_page_markdown(markdown, page, config, files):
    """Return the text of a page of the site, with a link for each page of a splat that was made. mkdocs calls this."""
    if page.file.src_uri != GALLERY:
        return markdown
    for entry in ENTRIES:
        if files.get_file_from_path(entry.page) is not None:
            markdown = markdown.replace(entry.marker, entry.link)
    return markdown
