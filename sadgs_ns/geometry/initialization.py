"""The Gaussians that training starts from: SfM points and the faces of their bounding box (paper, section 3.6)."""

from __future__ import annotations

import math

import torch
from scipy.spatial import KDTree
from torch import Tensor

FACE_GRID = 16
"""Points along each side of a face (released code)."""
FACES_SHARE = 0.01
"""Share of the most starting points of `most_starting_points` that may lie on the faces. On a CPU a step draws three
times as long with all of them on images of 0.01 megapixels."""
LEAST_POINTS = 1000
"""Starting points that images of any size may have, without those on the faces."""
FACE_OPACITY = 0.05
"""Initial opacity of the points on the faces (released code)."""
POINT_OPACITY = 0.1
"""Initial opacity of SfM points (3DGS)."""
FACE_GREY = 0.5
"""Colour of the points on the faces in [0, 1] (released code)."""


def bounding_box_points(
    points: Tensor,  # [P, 3]
    grid: int = FACE_GRID,
) -> tuple[Tensor, float]:
    """Make regular grids on the six faces of the axis-aligned bounding box of points (paper, section 3.6).

    Returns:
        6·grid² points [6·grid², 3], and the spacing that their scale starts from, mean box extent / grid, world units.
        Where the box is flat, faces coincide and every place has one point; a box without extent has no points.
    """
    low = points.amin(0)
    high = points.amax(0)
    extents = high - low
    if (low == high).all():
        return points[:0], 1.0
    cells = torch.arange(grid, device=points.device, dtype=points.dtype)
    ticks = (cells + 0.5) / grid  # Cell centres in (0, 1)
    square = torch.cartesian_prod(ticks, ticks)  # [grid², 2]
    faces = []
    for axis in range(3):
        for side in (0.0, 1.0):
            on_side = torch.full_like(square[:, :1], side)
            face = torch.cat([square[:, :axis], on_side, square[:, axis:]], dim=1)  # In the unit cube. [grid², 3]
            faces.append(low + face * extents)
    placed = torch.cat(faces)
    if (low == high).any():
        placed = placed.unique(dim=0)
    spacing = float(extents.mean()) / grid
    return placed, spacing


def most_starting_points(pixels: int, per_pixel: float) -> float:
    """Return how many points training may start from, given all training images' pixels; infinity if 0 a pixel."""
    if per_pixel == 0:
        return math.inf
    return max(per_pixel * pixels, LEAST_POINTS)


def face_grid(pixels: int, per_pixel: float) -> int:
    """Return how many points lie along each side of a face, from 2 to `FACE_GRID`.

    There are fewer for images of few pixels: points on the faces are large, and such images hardly show them.

    Args:
        pixels: Number of pixels of all training images together.
        per_pixel: Largest number of starting points for each of these pixels; 0 is no limit.
    """
    if per_pixel == 0:
        return FACE_GRID
    most_points = FACES_SHARE * per_pixel * pixels
    points_per_face = int(most_points / 6)
    grid = math.isqrt(points_per_face)
    return min(max(grid, 2), FACE_GRID)


def neighbour_scales(
    points: Tensor,  # [P, 3]
) -> Tensor:
    """The initial scale of points, > 0: the mean distance to the 3 nearest neighbours, as in splatfacto. [P]

    3DGS takes the root of the mean square of these distances, which is larger.
    It is at least a millionth of the cloud's extent, so as to have a logarithm.

    Raises:
        ValueError: If there is no point.
    """
    if len(points) == 0:
        raise ValueError("There are no points to start from: give SfM points, or set pipeline.model.random-init True.")
    low = points.amin(0)
    high = points.amax(0)
    diagonal = high - low
    extent = float(diagonal.norm())
    if extent == 0:
        extent = 1.0
    num_others = len(points) - 1
    num_neighbours = min(3, num_others)
    if num_neighbours < 1:
        return torch.full_like(points[:, 0], 0.01 * extent)
    array = points.detach().cpu().numpy()
    tree = KDTree(array)  # scikit-learn's takes half a second to import.
    distances, _ = tree.query(array, num_neighbours + 1, workers=-1)  # The nearest is the point itself.
    scales = torch.from_numpy(distances[:, 1:].mean(1)).to(points)
    return scales.clamp_min(1e-6 * extent)


def starting_points(
    points: Tensor,  # [P, 3]
    colors: Tensor,  # [P, 3]
    *,
    faces: bool,
    opacity: float = POINT_OPACITY,
    grid: int = FACE_GRID,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the points that training starts from, with the scale and opacity of each.

    Args:
        points: In world units. [P, 3]
        colors: In [0, 1]. [P, 3]
        faces: Whether `bounding_box_points` are added.
        opacity: Of the given points.
        grid: Points along each side of a face.

    Returns:
        Points and colours, [N, 3] each, and scales in world units, > 0, and opacities, [N] each.

    Raises:
        ValueError: If there is no point.
    """
    scales = neighbour_scales(points)
    opacities = torch.full((len(points),), opacity)
    if not faces:
        return points, colors, scales, opacities
    added, spacing = bounding_box_points(points, grid)
    grey = torch.full_like(added, FACE_GREY)
    spacings = torch.full((len(added),), spacing)
    faint = torch.full((len(added),), FACE_OPACITY)
    return (
        torch.cat([points, added]),
        torch.cat([colors, grey]),
        torch.cat([scales, spacings]),
        torch.cat([opacities, faint]),
    )
