"""Meshes of depth maps that are known exactly: where their surface lies, which side is the front, what is left out."""

from __future__ import annotations

import dataclasses
import io
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.testing import assert_allclose, assert_array_equal
from plyfile import PlyData

from examples.drawn_scene.scene import arc_views, room_surfaces
from helpers.drawn_surfaces import depth_view, face_normals, nearest
from helpers.refusals import refusal
from sadgs_ns.data.coordinates import Similarity
from sadgs_ns.formats import mesh
from sadgs_ns.formats.mesh import Fusion, TriangleMesh

ROOM = room_surfaces()
VOXEL = 0.04
"""Two pixels at the room's distance, as the command derives it."""


@pytest.fixture(scope="module")
def room(open3d: None) -> TriangleMesh:
    """A mesh of 12 views of the room."""
    fusion = Fusion(VOXEL)
    for view in arc_views(12, 160, 120):
        fusion.add(depth_view(ROOM, view))
    return fusion.mesh()


def a_mesh(vertices: np.ndarray, triangles: np.ndarray) -> TriangleMesh:
    """A mesh [V, 3], [F, 3] whose colours are a twentieth of the places."""
    import open3d

    found = open3d.geometry.TriangleMesh(
        open3d.utility.Vector3dVector(vertices.astype(float)), open3d.utility.Vector3iVector(triangles.astype(np.int32))
    )
    found.vertex_colors = open3d.utility.Vector3dVector(vertices / 20)
    return found


def test_the_surface_lies_within_a_tenth_of_a_voxel_in_the_median(room: TriangleMesh):
    distances, which = nearest(ROOM, np.asarray(room.vertices))
    assert np.median(distances) < 0.1 * VOXEL
    assert np.quantile(distances, 0.9) < 0.3 * VOXEL
    assert set(which) >= {index for index, surface in enumerate(ROOM) if "back" not in surface.name and "left" not in
                          surface.name}, "all that the views see has a part"  # fmt: skip


def test_corners_run_counterclockwise_where_cameras_see_them(room: TriangleMesh):
    """The room's corner is at the origin, so that the floor and the walls are seen from the positive side."""
    normals = face_normals(room)
    middles = np.asarray(room.vertices)[np.asarray(room.triangles)].mean(axis=1)
    distances, which = nearest(ROOM, middles)
    for index, axis in ((0, 2), (1, 1), (2, 0)):
        on = normals[(which == index) & (distances < VOXEL)]
        assert (on[:, axis] > 0).mean() > 0.99
    sphere = len(ROOM) - 1
    outward = middles - ROOM[sphere].centre  # type: ignore[union-attr]
    on = (which == sphere) & (distances < VOXEL)
    assert ((normals * outward).sum(axis=1)[on] > 0).mean() > 0.99


def test_vertices_have_the_colours_of_their_surface(room: TriangleMesh):
    points = np.asarray(room.vertices)
    distances, which = nearest(ROOM, points)
    for index in (0, 1, 2, len(ROOM) - 1):
        on = (which == index) & (distances < 0.3 * VOXEL)
        errors = np.abs(ROOM[index].colour(points[on]) - np.asarray(room.vertex_colors)[on])
        assert np.median(errors) < 0.03, "but at edges, over which a voxel averages"


def test_a_reflection_keeps_the_front(room: TriangleMesh):
    mirror = Similarity(2.0, np.diag([1.0, 1, -1]), np.array([0.0, 0, 5]))
    vertices = 2 * np.asarray(room.vertices) * [1, 1, -1] + [0, 0, 5]
    normals = 4 * face_normals(room) * [1, 1, -1]
    moved = mesh.moved(type(room)(room), mirror)
    assert_allclose(moved.vertices, vertices, rtol=1e-6, atol=1e-6)
    assert_allclose(face_normals(moved), normals, atol=1e-6)


@pytest.mark.usefixtures("open3d")
@pytest.mark.parametrize(("times", "others", "shown"), [(1, 0, True), (2, 0, True), (2, 1, False), (3, 1, True)])
def test_a_surface_needs_three_views_or_all_of_fewer(times: int, others: int, shown: bool):
    view = depth_view(ROOM, arc_views(1, 80, 60)[0])
    fusion = Fusion(2 * VOXEL)
    for _ in range(times):
        fusion.add(view)
    for _ in range(others):
        fusion.add(dataclasses.replace(view, depth=np.zeros_like(view.depth)))
    assert (len(fusion.mesh().triangles) > 0) is shown


@pytest.mark.usefixtures("open3d")
def test_nothing_and_what_is_far_behind_make_no_mesh():
    view = depth_view(ROOM, arc_views(1, 80, 60)[0])
    nothing = np.zeros_like(view.depth)
    far = np.full_like(view.depth, 100.0)
    between = np.zeros_like(view.depth)
    between[31, 41] = 2.0  # Open3D looks at every fourth pixel of every fourth row.
    for depth in (nothing, far, between):
        fusion = Fusion(VOXEL)
        fusion.add(dataclasses.replace(view, depth=depth))
        assert len(fusion.mesh().triangles) == len(fusion.mesh().vertices) == 0
        assert fusion.has_room_for([dataclasses.replace(view, depth=depth)])


@pytest.mark.hard_case("a mesh of more voxels than fit in memory", "refused: names the option; nothing is written")
@pytest.mark.usefixtures("open3d")
def test_voxels_that_do_not_fit_are_refused_before_they_take_memory(monkeypatch: pytest.MonkeyPatch):
    view = depth_view(ROOM, arc_views(1, 80, 60)[0])
    monkeypatch.setattr(mesh, "MOST_VOXELS", 50 * 16**3)
    assert Fusion(0.5).has_room_for([view])
    assert not Fusion(0.05).has_room_for([view])
    with refusal(r"^A mesh of voxels of 0\.02 does not fit .*, such as --voxel-size 0\.04\.$"):
        Fusion(0.02).add(view)


@pytest.mark.usefixtures("open3d")
def test_parts_of_less_than_a_hundredth_of_the_largest_are_left_out():
    sides = [11, 1, 2]  # squares of the grids: 242, 2 and 8 triangles
    vertices = []
    triangles = []
    for number, side in enumerate(sides):
        x, y = np.meshgrid(np.arange(side + 1), np.arange(side + 1), indexing="ij")
        first = sum(map(len, vertices)) + (x[:-1, :-1] * (side + 1) + y[:-1, :-1]).ravel()
        corners = [first, first + side + 1, first + 1, first + 1, first + side + 1, first + side + 2]
        triangles.append(np.stack(corners, 1).reshape(-1, 3))
        vertices.append(np.stack([x, y, np.full_like(x, number)], -1).reshape(-1, 3))
    kept = mesh.without_small_parts(a_mesh(np.concatenate(vertices), np.concatenate(triangles)))
    left = np.asarray(kept.vertices)
    assert set(left[:, 2]) == {0, 2}
    assert len(kept.triangles) == 242 + 8
    assert len(left) == 12 * 12 + 3 * 3
    assert (left == 20 * np.asarray(kept.vertex_colors)).all()
    actual = np.linalg.norm(face_normals(kept), axis=1)
    assert_allclose(actual, 1)


@pytest.mark.usefixtures("open3d")
def test_foreign_readers_read_the_file(tmp_path: Path):
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.5]])
    triangles = np.array([[0, 1, 2], [0, 2, 3]])
    path = tmp_path / "a.mesh.ply"
    with path.open("wb") as file:
        mesh.write(file, a_mesh(vertices, triangles))
    read = trimesh.load(path, process=False)
    assert_array_equal(read.vertices, vertices)  # type: ignore[union-attr]
    assert_array_equal(read.faces, triangles)  # type: ignore[union-attr]
    colors = np.rint(255 * vertices / 20)
    actual = read.visual.vertex_colors[:, :3]  # type: ignore[union-attr]
    assert_array_equal(actual, colors)
    assert "fused from rendered depth" in PlyData.read(str(path)).comments[0]
    empty = io.BytesIO()
    mesh.write(empty, a_mesh(vertices[:0], triangles[:0]))
    assert PlyData.read(io.BytesIO(empty.getvalue()))["face"].count == 0


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs Linux")
@pytest.mark.usefixtures("open3d")
def test_a_full_disk_is_noticed():
    with pytest.raises(OSError, match="No space left"), open("/dev/full", "wb") as file:
        mesh.write(file, a_mesh(np.eye(3), np.arange(3)[None]))
