"""A drawn room corner with gratings and checkers of known wavelength, written as a COLMAP dataset."""

from __future__ import annotations

import json
import os
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import tyro
from numpy.typing import NDArray
from PIL import Image
from tyro.conf import Positional

from examples.drawn_scene.drawing import Array, Rectangle, Sphere, Surface, View, render, visible

EVAL_INTERVAL = 8
"""Every 8th view is held out, as nerfstudio's colmap parser does with `--eval-mode interval --eval-interval 8`."""
SPARSE_FOLDER = Path("sparse/0")
"""Where the COLMAP model lies inside the scene's folder."""

_DESCRIPTION_NAME = "scene.json"
_FORMAT = "sadgs_ns demo scene"


@dataclass(frozen=True)
class SceneDescription:
    """What was drawn: surfaces with their true wavelengths, views, and the points that initialise the Gaussians."""

    surfaces: tuple[Surface, ...]
    """Everything visible."""
    views: tuple[View, ...]
    """In file name order; every 8th, from the first, is held out."""
    points: Array
    """SfM-like points near the surfaces, world units. [P, 3]"""
    colours: NDArray[np.uint8]
    """Colours of the points. [P, 3]"""
    tracks: NDArray[np.bool_] = field(repr=False)
    """Which view sees which point. [P, V]"""

    @property
    def wavelengths(self) -> dict[str, float]:
        """Wavelength of each textured surface in world units, by the surface's name."""
        wavelengths = {}
        for surface in self.surfaces:
            if isinstance(surface, Rectangle) and surface.texture != "plain":
                wavelengths[surface.name] = surface.wavelength
        return wavelengths


def _box(name: str, centre: tuple[float, float], size: tuple[float, float, float], turn: float, *texture) -> list:
    """Five faces of a box that stands on the floor at x and y, turned about the vertical, in rad.

    The size is along the box's own axes, and `texture` the last fields of `Rectangle`, from `dark`.
    """
    cosine = np.cos(turn)
    sine = np.sin(turn)
    x = np.array([cosine, sine, 0.0]) * size[0]
    y = np.array([-sine, cosine, 0.0]) * size[1]
    z = np.array([0.0, 0.0, size[2]])
    foot = np.array([*centre, 0.0])
    low = foot - 0.5 * (x + y)
    faces = [
        ("front", low, x, z),
        ("left", low, y, z),
        ("back", low + y, x, z),
        ("right", low + x, y, z),
        ("top", low + z, x, y),
    ]
    return [Rectangle(f"{name} {side}", corner, u, v, *texture) for side, corner, u, v in faces]


def room_surfaces() -> tuple[Surface, ...]:
    """The room corner: a floor, two walls, two boxes and a plain sphere. World units; the room is 3 wide, 2.2 high."""
    x, y, z = np.diag([3.0, 3.0, 2.2])
    origin = np.zeros(3)
    floor = Rectangle("floor", origin, x, y, (0.25, 0.2, 0.15), (0.85, 0.8, 0.7), "checker", 0.5, 0.4)
    fine_wall = Rectangle("fine wall", origin, x, z, (0.15, 0.25, 0.45), (0.75, 0.85, 0.95), "grating", 0.15)
    coarse_wall = Rectangle("coarse wall", origin, y, z, (0.5, 0.2, 0.15), (0.95, 0.75, 0.5), "grating", 0.35, 1.0)
    tall_texture = ((0.1, 0.3, 0.1), (0.7, 0.9, 0.5), "grating", 0.2, np.pi / 2)
    tall_box = _box("tall box", (0.65, 1.35), (0.5, 0.5, 1.1), 0.4, *tall_texture)
    faint_texture = ((0.5, 0.42, 0.55), (0.62, 0.54, 0.67), "grating", 0.14, 0.6)
    faint_box = _box("faint box", (1.5, 0.6), (0.7, 0.5, 0.5), -0.3, *faint_texture)
    sphere = Sphere("sphere", np.array([1.45, 1.5, 0.3]), 0.3, (0.9, 0.5, 0.3))
    return (floor, fine_wall, coarse_wall, *tall_box, *faint_box, sphere)


_STEPS = np.array([0.8191725134, 0.6710436067, 0.5497004779])
"""Of a low-discrepancy sequence of three numbers."""


def arc_views(count: int, width: int, height: int) -> tuple[View, ...]:
    """Cameras spread over a patch of a sphere about the room's middle, all looking at it.

    The positions follow a low-discrepancy sequence that starts in the patch's middle, so the held-out views lie between
    training views, whatever their number.
    """
    target = np.array([0.85, 0.85, 0.55])
    views = []
    for index in range(count):
        place = 0.5 + index * _STEPS
        across, up, away = place % 1.0
        azimuth = np.radians(14 + 62 * across)
        elevation = np.radians(12 + 33 * up)
        level = np.cos(elevation)
        x = level * np.cos(azimuth)
        y = level * np.sin(azimuth)
        z = np.sin(elevation)
        outward = np.array([x, y, z])
        right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
        rotation = np.stack([right, np.cross(-outward, right), -outward])
        distance = 2.3 + 0.6 * away
        position = target + distance * outward
        translation = -rotation @ position
        views.append(View(f"{index:03d}.png", rotation, translation, 0.8 * width, width, height))
    return tuple(views)


def describe_scene(
    width: int = 160, height: int = 120, views: int = 40, points: int = 800, seed: int = 0
) -> SceneDescription:
    """Lay out the scene without drawing it; arguments are those of `write_scene`.

    Each point is seen by at least 2 views and lies 0.004 world units (one standard deviation per axis) off its surface,
    as after a structure-from-motion run. Raises ValueError if a number is too small.
    """
    numbers = {"width": (width, 16), "height": (height, 16), "views": (views, 9), "points": (points, 10)}
    for name, (value, least) in numbers.items():
        if value < least:
            raise ValueError(f"the demo scene's {name} is {value}; give at least {least}")
    rng = np.random.default_rng(seed)
    surfaces = room_surfaces()
    cameras = arc_views(views, width, height)
    area = np.array([surface.area for surface in surfaces])
    counts = rng.multinomial(6 * points, area / area.sum())  # enough to drop hidden and unseen places
    samples = []
    sample_colours = []
    for surface, count in zip(surfaces, counts, strict=True):
        on_surface = surface.sample(count, rng)
        samples.append(on_surface)
        sample_colours.append(surface.colour(on_surface))
    exact = np.concatenate(samples)  # [P, 3]
    colours = np.concatenate(sample_colours)  # [P, 3]
    tracks = np.stack([visible(surfaces, view, exact) for view in cameras], -1)  # [P, V]
    seen = np.flatnonzero(tracks.sum(1) >= 2)
    kept = np.sort(rng.permutation(seen)[:points])
    noisy = exact[kept] + 0.004 * rng.normal(size=(len(kept), 3))
    colours_8_bit = np.rint(255 * colours[kept]).astype(np.uint8)
    return SceneDescription(surfaces, cameras, noisy, colours_8_bit, tracks[kept])


def _write_colmap(scene: SceneDescription, folder: Path) -> None:
    """Write cameras, poses, points and their tracks as a binary COLMAP model."""
    # Imported late: nerfstudio takes seconds, and the geometry above needs none of it.
    from nerfstudio.data.utils import colmap_parsing_utils as colmap

    first = scene.views[0]
    middle_x = 0.5 * first.width
    middle_y = 0.5 * first.height
    intrinsics = np.array([first.focal, first.focal, middle_x, middle_y])
    cameras = {1: colmap.Camera(1, "PINHOLE", first.width, first.height, intrinsics)}
    # A point's place in a view's list of keypoints is its rank among the points which that view sees.
    rank = scene.tracks.cumsum(0) - 1  # [P, V]
    images = {}
    for index, view in enumerate(scene.views):
        seen = np.flatnonzero(scene.tracks[:, index])
        pixels, _ = view.project(scene.points[seen])
        quaternion = colmap.rotmat2qvec(view.rotation)
        number = index + 1
        images[number] = colmap.Image(number, quaternion, view.translation, 1, view.name, pixels, seen + 1)
    points = {}
    for index, (position, colour) in enumerate(zip(scene.points, scene.colours, strict=True)):
        seen = np.flatnonzero(scene.tracks[index])
        keypoints = rank[index, seen]
        number = index + 1
        points[number] = colmap.Point3D(number, position, colour, 0.5, seen + 1, keypoints)
    folder.mkdir(parents=True)
    colmap.write_model(cameras, images, points, str(folder))


def _refuse_foreign(folder: Path) -> None:
    """Raise unless `folder` is absent, empty, or an earlier demo scene."""
    if folder.is_file():
        raise FileExistsError(f"{folder} is a file; name a new or empty folder for the demo scene")
    description = folder / _DESCRIPTION_NAME
    known = description.is_file() and _FORMAT.encode() in description.read_bytes()
    if known or not folder.exists():
        return
    if any(folder.iterdir()):
        raise FileExistsError(f"{folder} holds files that are not a demo scene; name a new or empty folder")


def write_scene(
    folder: Positional[Path], width: int = 160, height: int = 120, views: int = 40, points: int = 800, seed: int = 0
) -> SceneDescription:
    """Draw the scene and write it as a COLMAP dataset: `images/*.png`, `sparse/0/*.bin` and `scene.json`.

    Everything is written beside the folder first and then renamed, so an interrupted run leaves no half scene.

    Args:
        folder: Created, with its parents; an earlier demo scene there is replaced.
        width: Of the images, in px, at least 16.
        height: Of the images, in px, at least 16.
        views: Training and held-out views together, at least 9.
        points: Number of initial points, at least 10.
        seed: Of the points' positions and noise; surfaces and cameras do not depend on it.

    Raises:
        ValueError: If a number is too small.
        FileExistsError: If `folder` is a file or holds anything but a demo scene.
    """
    folder = Path(folder).absolute()
    _refuse_foreign(folder)
    scene = describe_scene(width, height, views, points, seed)
    partial = folder.with_name(f".{folder.name}.{os.getpid()}.partial")
    try:
        images = partial / "images"
        images.mkdir(parents=True)
        for view in scene.views:
            image = Image.fromarray(render(scene.surfaces, view))
            image.save(images / view.name)
        _write_colmap(scene, partial / SPARSE_FOLDER)
        description = {"format": _FORMAT, "wavelengths": scene.wavelengths}
        text = json.dumps(description, indent=2)
        (partial / _DESCRIPTION_NAME).write_text(f"{text}\n")
        if folder.exists():
            shutil.rmtree(folder)
        partial.rename(folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    return scene


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit status."""
    try:
        scene = tyro.cli(write_scene, prog="python -m examples.drawn_scene.scene", args=arguments)
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    print(f"{len(scene.views)} views, {len(scene.points)} points; wavelengths in world units:")
    for name, wavelength in scene.wavelengths.items():
        print(f"  {name:16s} {wavelength:g}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
