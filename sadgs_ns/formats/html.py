"""One HTML file that opens without a network: PlayCanvas's SuperSplat viewer, with the Gaussians as SOG inside.

A program for Node.js makes the page of a single Gaussian (`page_writer`). The page's content is then replaced, because
SOG is written here in a fraction of that program's time.
"""

from __future__ import annotations

import base64
import io
import json
import math
import re
import tempfile
from html import escape
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from sadgs_ns.data.coordinates import Similarity
from sadgs_ns.errors import InputError
from sadgs_ns.formats import page_writer, ply, sog
from sadgs_ns.formats.gaussians import DEFAULTS, Context, Gaussians, Start

_BOOTSTRAP = re.compile(rb'(<script type="application/json" id="sse-bootstrap">)(.*?)(</script>)', re.DOTALL)
"""The page's settings and content."""
_TITLE = re.compile(rb"<title>.*?</title>")
_TO_VIEWER = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # From z up to the viewer's frame, in which y is up
_TO_CONTENT = np.array([[-1.0, 0, 0], [0, 0, -1], [0, -1, 0]])  # From z up to the content's frame, turned half round


def write(file: IO[bytes], gaussians: Gaussians, context: Context) -> None:
    """Write a page of at least one Gaussian, in a frame in which z is up; it opens at the context's start.

    The viewer's settings hold where the camera begins and what it looks at, and no limits of where it may go: how near
    and far the mouse takes it is fixed in the viewer.

    Raise InputError if Node.js or its package cannot be run.
    """
    assert context.start is not None
    page = _page()
    settings = _settings(context.start)
    to_content = Similarity(1.0, _TO_CONTENT, np.zeros(3))
    content = io.BytesIO()
    sog.write(content, gaussians.moved(to_content), context)
    encoded = base64.b64encode(content.getvalue()).decode()

    def fill(found: re.Match[bytes]) -> bytes:
        bootstrap = json.loads(found[2])
        bootstrap["settings"] |= settings
        bootstrap["contentUrl"] = f"data:application/octet-stream;base64,{encoded}"
        return found[1] + json.dumps(bootstrap).encode() + found[3]

    page, number = _BOOTSTRAP.subn(fill, page)
    if number != 1:
        problem = "PlayCanvas's splat-transform made a page of another kind than this version knows"
        raise InputError(f"{problem}: choose another format.")
    if context.title:
        title = f"<title>{escape(context.title)}</title>".encode()
        page = _TITLE.sub(lambda _: title, page, count=1)
    file.write(page)


def _settings(start: Start) -> dict[str, Any]:
    """Return the viewer's settings for a start, and for colours as they were trained."""
    position = (_TO_VIEWER @ start.position).tolist()
    target = (_TO_VIEWER @ start.target).tolist()
    camera = {"position": position, "target": target, "fov": start.degrees}
    values = {"position": position, "target": target, "fov": [start.degrees]}
    # Without a track, here of one position, the viewer begins with a flight of its own.
    track = {
        "name": "start",
        "duration": 1,
        "frameRate": 1,
        "loopMode": "none",
        "interpolation": "step",
        "smoothness": 0,
        "keyframes": {"times": [0], "values": values},
    }
    return {
        "cameras": [{"initial": camera}],
        "animTracks": [track],
        "startMode": "animTrack",
        "tonemapping": "none",
    }


def _page() -> bytes:
    """Return the page of a single Gaussian."""
    with tempfile.TemporaryDirectory() as folder:
        points = Path(folder) / "point.ply"
        page = points.with_suffix(".html")
        with points.open("wb") as file:
            ply.write(file, _single_gaussian(), DEFAULTS)
        page_writer.write_page(points, page)
        return page.read_bytes()


def _single_gaussian() -> Gaussians:
    zeros = np.zeros((1, 3), np.float32)
    return Gaussians(
        means=zeros,
        scales=zeros - 5,
        quats=np.eye(1, 4, dtype=np.float32),
        opacities=zeros[:, 0],
        features_dc=zeros,
        features_rest=np.zeros((1, 0, 3), np.float32),
    )


def middle_camera(positions: NDArray[np.float64]) -> int:
    """Return which of the cameras at positions [C, 3] stands nearest to their middle, away from the capture's edge."""
    from_middle = np.linalg.norm(positions - positions.mean(axis=0), axis=1)
    return int(from_middle.argmin())


def start_at(camera_to_world: NDArray[np.float64], side: int, focal: float, means: NDArray[np.float32]) -> Start:
    """Return the start at a camera, with a target as deep as the middle of its view.

    The pose [3, 4] has OpenGL axes and the frame of the positions [N, 3]; `side`, the longer one, and `focal` are px.
    """
    position = camera_to_world[:, 3]
    forward = -camera_to_world[:, 2]
    depths = (means - position) @ forward  # [N]
    across = np.linalg.norm(means - position - depths[:, None] * forward, axis=1)  # [N]
    middle_depths = depths[across < 0.2 * depths]
    distance = 1.0
    if len(middle_depths):
        distance = np.median(middle_depths)
    target = position + forward * distance
    angle = 2 * math.atan(side / (2 * focal))
    return Start(tuple(position.tolist()), tuple(target.tolist()), math.degrees(angle))
