"""A triangle mesh that Open3D fuses from depth maps, with truncated signed distances in sparse blocks of voxels.

Curless and Levoy, "A Volumetric Method for Building Complex Models from Range Images" (1996): each voxel keeps the mean
of its signed distances to the surfaces that views see, and the mesh is where that mean is 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from sadgs_ns.data.coordinates import Similarity
from sadgs_ns.errors import InputError, reason
from sadgs_ns.programs import OPENGL, OPENGL_PACKAGES, load_libusb

TriangleMesh = Any
"""`open3d.geometry.TriangleMesh`; open3d cannot be imported everywhere. It has `vertices` in world units [V, 3], their
`vertex_colors` in [0, 1] [V, 3], and `triangles`, with corners counterclockwise for a camera that sees them [F, 3]."""
MOST_VOXELS = 60_000_000  # Most voxels of a mesh; while their number doubles, each takes 71 bytes, 4.3 GB in all
PIXELS_PER_VOXEL = 2.0  # Edge of a voxel if none is given, in pixels of the median depth
_TRUNCATION = 4.0  # Voxels behind a surface that count as near it; thinner walls have no two sides
_WIDEST_PIXEL = 4.0  # Width in voxels, at their depth, above which pixels are left out: they are far behind the rest
_RESOLUTION = 16  # Voxels along the edge of a block
_BLOCKS = 1000  # Blocks with room at first, 82 MB; Open3D doubles that if it must
_VIEWS = 3  # A surface needs so many views, or all where there are fewer
_SMALLEST_SHARE = 0.01  # Connected components with fewer triangles than this share of the largest one's are left out


@dataclass(frozen=True)
class DepthView:
    """The image of a pinhole camera."""

    depth: NDArray[np.float32]  # Along the viewing axis, in world units; 0 without a surface. [H, W]
    color: NDArray[np.float32]  # In [0, 1]. [H, W, 3]
    K: NDArray[np.float64]  # Intrinsics in px; pixel centres lie at half-integers. [3, 3]
    viewmat: NDArray[np.float64]  # World to camera, OpenCV axes (x right, y down, z forward). [4, 4]

    @property
    def focal(self) -> float:
        """Focal length in px, the geometric mean of both axes'."""
        return float(np.sqrt(self.K[0, 0] * self.K[1, 1]))


class Fusion:
    """Voxels into which depth maps are fused, on the CPU; raises as `load_open3d`.

    `voxel_size` is the length of a voxel's edge in world units.
    """

    def __init__(self, voxel_size: float) -> None:
        open3d = load_open3d()
        self.voxel_size = voxel_size
        self._views = 0
        self._core = open3d.core
        self._image = open3d.t.geometry.Image
        names = ("tsdf", "weight", "color")
        types = (open3d.core.float32,) * 3
        shapes = ((1,), (1,), (3,))
        self._grid = open3d.t.geometry.VoxelBlockGrid(names, types, shapes, voxel_size, _RESOLUTION, _BLOCKS)

    def _blocks(self, view: DepthView) -> tuple[Any, dict[str, Any]] | None:
        """Return the blocks near the surfaces in a view, int32 [B, 3], and the view as arguments of Open3D.

        None if there are no such blocks. Open3D finds them by every fourth pixel of every fourth row.
        """
        tensor = self._core.Tensor
        camera = {
            "intrinsic": tensor(view.K),
            "extrinsic": tensor(view.viewmat),
            "depth_scale": 1.0,
            "depth_max": _WIDEST_PIXEL * self.voxel_size * view.focal,
            "trunc_voxel_multiplier": _TRUNCATION,
        }
        depth = self._image(tensor(view.depth[..., None]))
        try:
            blocks = self._grid.compute_unique_block_coordinates(depth, **camera)
        except RuntimeError as error:
            if "No block is touched" in str(error):
                return None
            raise
        return blocks, {"depth": depth, **camera}

    def has_room_for(self, views: Sequence[DepthView]) -> bool:
        """Return whether these views need at most a quarter of `MOST_VOXELS`; the rest is for other views."""
        blocks_of_views = []
        for view in views:
            found = self._blocks(view)
            if found is not None:
                blocks, _ = found
                blocks_of_views.append(blocks.numpy())
        if not blocks_of_views:
            return True
        distinct = np.unique(np.concatenate(blocks_of_views), axis=0)
        return 4 * len(distinct) * _RESOLUTION**3 <= MOST_VOXELS

    def add(self, view: DepthView) -> None:
        """Fuse a view; raise InputError if that takes more than `MOST_VOXELS`."""
        self._views += 1
        found = self._blocks(view)
        if found is None:
            return
        blocks, camera = found
        stored_blocks = self._grid.hashmap()
        num_known = 0
        if stored_blocks.size():
            _, is_known = stored_blocks.find(blocks)
            num_known = is_known.numpy().sum()
        num_blocks = stored_blocks.size() + len(blocks) - num_known
        if num_blocks * _RESOLUTION**3 > MOST_VOXELS:
            problem = f"A mesh of voxels of {self.voxel_size:.3g} does not fit in memory"
            raise InputError(f"{problem}: give a larger one, such as --voxel-size {2 * self.voxel_size:.2g}.")
        color = self._image(self._core.Tensor(view.color))
        self._grid.integrate(blocks, camera.pop("depth"), color, **camera)

    def mesh(self) -> TriangleMesh:
        """Return the surface, `without_small_parts`; it has no triangles if the views showed none."""
        found = load_open3d().geometry.TriangleMesh()
        if self._grid.hashmap().size():
            # Open3D wants more views than the threshold says.
            threshold = min(_VIEWS, self._views) - 0.5
            extracted = self._grid.extract_triangle_mesh(weight_threshold=threshold)
            if len(extracted.triangle):
                found = extracted.to_legacy()
        return without_small_parts(found)


def without_small_parts(mesh: TriangleMesh) -> TriangleMesh:
    """Remove connected components with less than a hundredth of the largest one's triangles, and return the mesh."""
    parts, sizes, _ = map(np.asarray, mesh.cluster_connected_triangles())
    is_small = sizes < _SMALLEST_SHARE * sizes.max(initial=0)
    mesh.remove_triangles_by_mask(is_small[parts])
    return mesh.remove_unreferenced_vertices()


def moved(mesh: TriangleMesh, similarity: Similarity) -> TriangleMesh:
    """Move a mesh to another frame, and return it. A reflection reverses the order of the triangles' corners."""
    transform = np.eye(4)
    transform[:3] = np.c_[similarity.scale * similarity.orthogonal, similarity.translation]
    if np.linalg.det(similarity.orthogonal) < 0:
        reversed_corners = np.asarray(mesh.triangles)[:, ::-1]
        mesh.triangles = type(mesh.triangles)(reversed_corners)
    return mesh.transform(transform)


def load_open3d() -> Any:
    """Import open3d, which takes a second; raise InputError if that fails."""
    load_libusb()
    try:
        import open3d
    except (ImportError, OSError) as error:
        problem = f"A mesh is made by open3d, which cannot be imported ({reason(error)})"
        remedy = "install open3d and libusb-package with pip"
        if any(library in str(error) for library in OPENGL):
            remedy = f"install {OPENGL_PACKAGES}"
        raise InputError(f"{problem}: {remedy}.") from error
    return open3d


def write(file: IO[bytes], mesh: TriangleMesh) -> None:
    """Write a mesh as binary little-endian PLY, with colours. Open3D's own writer takes a full disk for success."""
    vertices = np.empty(len(mesh.vertices), [("position", "<f4", 3), ("color", "u1", 3)])
    vertices["position"] = mesh.vertices
    colors = np.asarray(mesh.vertex_colors).clip(0, 1)
    vertices["color"] = np.rint(255 * colors)
    faces = np.empty(len(mesh.triangles), [("corners", "u1"), ("indices", "<i4", 3)])
    faces["corners"] = 3
    faces["indices"] = mesh.triangles
    lines = ["ply", "format binary_little_endian 1.0", "comment sadgs_ns: fused from rendered depth"]
    lines.append(f"element vertex {len(vertices)}")
    lines += [f"property float {axis}" for axis in "xyz"]
    lines += [f"property uchar {channel}" for channel in ("red", "green", "blue")]
    lines.append(f"element face {len(faces)}")
    lines.append("property list uchar int vertex_indices")
    lines.append("end_header\n")
    file.write("\n".join(lines).encode())
    file.write(vertices.tobytes())
    file.write(faces.tobytes())
