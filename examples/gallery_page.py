"""The gallery's page of the drawn room, which mkdocs makes of `docs/figures/room.ply` while it builds the site.

The page bundles a viewer, so it is made and not committed. Where what makes pages cannot be had, as without a network,
the site is built without the page, and a line says so.
"""

from __future__ import annotations

import io
import logging
from pathlib import Path

from sadgs_ns.errors import InputError
from sadgs_ns.formats import html, ply
from sadgs_ns.formats.gaussians import Context, Start

GALLERY = "gallery.md"
PAGE = "room.html"
MARKER = "<!-- page of the drawn room -->"
"""Place in the gallery where the link to the page stands."""
LINK = f"[Turn it with the mouse]({PAGE})"
START = Start(position=(2.466, 2.466, 1.791), target=(0.85, 0.85, 0.55), degrees=64.0)
"""The drawn scene's first camera, which looks at the middle of the room."""
logger = logging.getLogger("mkdocs.hooks.gallery")


def page_of(splat: Path) -> bytes:
    """Return the page of a splat of the drawn scene, which opens at START.

    Raises InputError if what makes pages cannot be run or downloaded.
    """
    page = io.BytesIO()
    html.write(page, ply.read(splat), Context(start=START, title="A drawn room"))
    return page.getvalue()


def on_files(files, config):
    """Called by mkdocs with the files of the site."""
    try:
        page = page_of(Path(config.docs_dir) / "figures" / "room.ply")
    except InputError as error:
        logger.info("The gallery has no page of the drawn room. %s", error)
        return files
    from mkdocs.structure.files import File  # pyright: ignore[reportMissingImports]

    files.append(File.generated(config, PAGE, content=page))
    return files


def on_page_markdown(markdown, page, config, files):
    """Called by mkdocs with the text of each page."""
    if page.file.src_uri != GALLERY or files.get_file_from_path(PAGE) is None:
        return markdown
    return markdown.replace(MARKER, LINK)
