"""What meshes of the drawn room are compared with: its depth maps, and the distance from its surfaces."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from examples.drawn_scene.drawing import Sphere, Surface, View, trace
from sadgs_ns.formats.mesh import DepthView, TriangleMesh

Array = NDArray[np.float64]


def depth_view(surfaces: Sequence[Surface], view: View) -> DepthView:
    """What a view sees, without noise."""
    rays = view.rays()
    index, depth = trace(surfaces, view.position, rays)
    points = view.position + np.where(np.isfinite(depth), depth, 0)[:, None] * rays
    colors = np.zeros((len(rays), 3))
    for i, surface in enumerate(surfaces):
        colors[index == i] = surface.colour(points[index == i])
    K = np.array([[view.focal, 0, view.width / 2], [0, view.focal, view.height / 2], [0, 0, 1]])
    viewmat = np.eye(4)
    viewmat[:3, :3] = view.rotation
    viewmat[:3, 3] = view.translation
    size = view.height, view.width
    depth = np.where(np.isfinite(depth), depth, 0).reshape(size).astype(np.float32)
    return DepthView(depth, colors.reshape(*size, 3).astype(np.float32), K, viewmat)


def nearest(surfaces: Sequence[Surface], points: Array) -> tuple[Array, Array]:
    """Distance of points [P, 3] from the nearest surface, and that surface's index. [P] each"""
    distances = []
    for surface in surfaces:
        if isinstance(surface, Sphere):
            distances.append(np.abs(np.linalg.norm(points - surface.centre, axis=1) - surface.radius))
            continue
        rest = points - surface.corner
        for edge in (surface.edge_u, surface.edge_v):
            rest = rest - np.clip(rest @ edge / (edge @ edge), 0, 1)[:, None] * edge
        distances.append(np.linalg.norm(rest, axis=1))
    return np.min(distances, axis=0), np.argmin(distances, axis=0)


def face_normals(mesh: TriangleMesh) -> Array:
    """Normals of the triangles, as long as twice their area, on the side where corners run counterclockwise. [F, 3]"""
    a, b, c = (np.asarray(mesh.vertices)[corner] for corner in np.asarray(mesh.triangles).T)
    return np.cross(b - a, c - a)
