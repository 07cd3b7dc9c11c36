"""The space along the cameras' paths, which training keeps empty.

Nothing stands where somebody walked with a camera. A faint Gaussian that floats there becomes haze over the whole image
of a view beside the path. Viewers of exported files show it, too, because they also draw what is nearer than the run's
near plane. Real surfaces near a path have SfM points, and look small from it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from scipy.spatial import KDTree
from torch import Tensor

from sadgs_ns.geometry.rigid import camera_centres

REACH = 1.5
"""Reach of the empty space around a path, in near planes. 1 left some of room, and 2 cost a view 2.6 dB."""
HAZE_LENGTH = 0.1
"""Haze is longer, in standard deviations, than this share of its distance from a path. .2 left some."""
SUPPORT = 0.4
"""No point to start from lies within this share of the distance: needles among leaves reach points twice as far."""
LONGEST = 20.0
"""Longest path, in near planes or in medians of the distance from a camera to its nearest neighbour."""
_SAME_PLACE = 5e-4
"""Share of the reach within which cameras stand in one place, as the parts of a panorama do, but for rounding."""
_CUBES = 2**12
"""Cubes along each side of a grid, at most; float32 tells them apart."""
_PAIRS = 2**21
"""Pairs of a point and a path that are computed at a time, in arrays of 25 MB."""


@dataclass(frozen=True)
class CameraPaths:
    """E straight paths between cameras, and the points of surfaces near them."""

    starts: Tensor  # World units. [E, 3]
    ends: Tensor  # World units. [E, 3]
    reach: float  # Distance up to which the space around the paths is empty, in world units
    points: Tensor  # Points of surfaces around the paths. [P, 3]

    @staticmethod
    def of(
        viewmats: Tensor,  # [C, 4, 4]
        near_plane: float,
        points: Tensor,  # [P, 3]
    ) -> CameraPaths:
        """Connect neighbouring cameras, given the scene's near plane > 0 and the points that a run starts from."""
        exact = viewmats.double().cpu()
        centres = camera_centres(exact)  # [C, 3]
        reach = REACH * near_plane
        pairs = _connect_neighbours(centres, near_plane, _SAME_PLACE * reach)  # [E, 2]
        starts, ends = centres[pairs].to(points).unbind(dim=1)
        # `haze` looks at no point farther away.
        nearby = _find_paths(points, starts, ends, (1 + SUPPORT) * reach)
        return CameraPaths(starts, ends, reach, points[nearby.counts > 0])

    @cached_property
    def surfaces(self) -> KDTree:
        """A search tree of the points. Comparing all pairs took 40 % of castle's loop on a GPU."""
        # A tree with these options is built soonest.
        return KDTree(self.points.cpu().numpy(), balanced_tree=False, compact_nodes=False)

    @torch.no_grad()
    def haze(
        self,
        means: Tensor,  # [N, 3]
        scales: Tensor,  # [N, 3] standard deviations in world units
    ) -> Tensor:
        """Tell which Gaussians are haze near a path; one whose centre is not finite is not. bool [N]"""
        from_path = self._distances_from_paths(means)
        is_near = from_path < self.reach
        longest_axes = scales.amax(1)
        is_long = longest_axes > HAZE_LENGTH * from_path
        haze = is_near & is_long
        found = haze.nonzero()[:, 0]
        from_path = from_path[found]
        from_surface, _ = self.surfaces.query(means[found].cpu().numpy(), workers=-1)
        from_surface = torch.from_numpy(from_surface).to(means)
        haze[found] = from_surface > SUPPORT * from_path
        return haze

    def _distances_from_paths(self, means: Tensor) -> Tensor:
        """Distances of positions [N, 3] from the nearest path; more than the reach, or infinite, far from all. [N]"""
        from_path = torch.full_like(means[:, 0], torch.inf)
        nearby = _find_paths(means, self.starts, self.ends, self.reach)
        counts = nearby.counts
        candidates = counts.nonzero()[:, 0]
        most = 1
        if len(candidates) > 0:
            most = int(counts.max())
        for part in candidates.split(_PAIRS // most + 1):
            # K pairs of a position and each of its paths.
            indices = part.repeat_interleave(counts[part])  # Of the pairs' positions. [K]
            pairs_before = counts[part].cumsum(dim=0) - counts[part]
            pairs_before = pairs_before.repeat_interleave(counts[part])  # [K]
            pairs = torch.arange(len(indices), device=indices.device)
            number = pairs - pairs_before  # 0 for the first path of a position, and so on
            paths = nearby.paths[nearby.firsts[indices] + number]
            distances = _distances(means[indices], self.starts[paths], self.ends[paths])
            from_path.scatter_reduce_(0, indices, distances, "amin")
        return from_path


def _connect_neighbours(
    centres: Tensor,  # float64 [C, 3]
    near_plane: float,
    same_place: float,  # distance in world units under which two cameras stand in one place
) -> Tensor:
    """Connect each camera with itself, and two cameras if no third one is nearer to both than they are to each other.

    These pairs are the relative neighbourhood graph: G. T. Toussaint, "The relative neighbourhood graph of a finite
    planar set", 1980. Paths longer than `LONGEST` are left out.

    Returns:
        Pairs of different indices of cameras in ascending order, and (i, i) for each camera; none twice. int64 [E, 2]
    """
    # Matrix products would round: cameras near each other would be alike.
    distances = torch.cdist(centres, centres, compute_mode="donot_use_mm_for_euclid_dist")  # [C, C]
    is_elsewhere = distances >= same_place
    to_nearest = distances.masked_fill(~is_elsewhere, torch.inf).amin(dim=1)
    median = float(to_nearest.median())  # Infinite if all cameras stand in one place
    unit = near_plane
    if near_plane < median < math.inf:
        unit = median
    may_be_path = is_elsewhere & (distances < LONGEST * unit)
    open_pairs = may_be_path.triu(diagonal=1).nonzero()  # [K, 2]
    by_distance = distances.argsort(dim=1)  # The cameras from the nearest one of each camera on. [C, C]
    found = [torch.arange(len(centres))[:, None].expand(-1, 2)]
    for rank in range(len(centres)):
        if len(open_pairs) == 0:
            break
        first, second = open_pairs.unbind(dim=1)
        third = by_distance[first, rank]
        lengths = distances[first, second]
        # All cameras that are nearer to the first one than the second one is were looked at.
        is_done = distances[first, third] >= lengths
        found.append(open_pairs[is_done])
        is_apart = distances[second, third] >= lengths
        open_pairs = open_pairs[is_apart & ~is_done]
    return torch.cat(found)


class _NearbyPaths(NamedTuple):
    """The paths that may come near N positions."""

    counts: Tensor  # Number of paths of each position. int64 [N]
    firsts: Tensor  # Where its paths begin in `paths`. int64 [N]
    paths: Tensor  # Indices of paths, those of a position in a row. int64 [K]


def _find_paths(
    positions: Tensor,  # [N, 3]
    starts: Tensor,  # [E, 3]
    ends: Tensor,  # [E, 3]
    reach: float,
) -> _NearbyPaths:
    """List the paths that may come within `reach` of positions; a position that is NaN has none.

    A cube around all paths is halved again and again, without the parts that no path comes so near to.
    """
    lowest = starts.amin(0)
    highest = starts.amax(0)
    corner = lowest - reach
    extents = highest + reach - corner
    side = float(extents.max())
    finest = side / _CUBES
    smallest = max(reach, finest)
    halves = torch.tensor([-0.5, 0.5], device=starts.device)
    octants = torch.cartesian_prod(halves, halves, halves)  # [8, 3]
    # Pairs of a cube, by its middle, and a path.
    middle = corner + side / 2
    middles = middle.expand_as(starts)
    paths = torch.arange(len(starts), device=starts.device)
    while side > smallest and len(paths) <= _PAIRS // 4:
        side /= 2
        middles = (middles[:, None] + side * octants).view(-1, 3)
        paths = paths.repeat_interleave(8)
        distances = _distances(middles, starts[paths], ends[paths])
        is_near = distances <= reach + side  # But for rounding, √3/2 of the side would do.
        middles = middles[is_near]
        paths = paths[is_near]
    listed, order = _cube_numbers(middles, corner, side).sort()
    places = _cube_numbers(positions, corner, side)
    firsts = torch.searchsorted(listed, places)
    ends_of_lists = torch.searchsorted(listed, places, right=True)
    counts = ends_of_lists - firsts
    return _NearbyPaths(counts, firsts, paths[order])


def _cube_numbers(positions: Tensor, corner: Tensor, side: float) -> Tensor:
    """Number the cubes of a grid from `corner` [3] in which positions [N, 3] lie, alike outside the grid. int64 [N]"""
    from_corner = positions - corner
    places = from_corner / side
    places = places.nan_to_num(-1.0)
    x, y, z = places.clamp(-1, _CUBES).floor().long().unbind(dim=1)
    return (x * (_CUBES + 2) + y) * (_CUBES + 2) + z


def _distances(
    positions: Tensor,  # [K, 3]
    starts: Tensor,  # [K, 3]
    ends: Tensor,  # [K, 3]
) -> Tensor:
    """Distance of each position from the straight path that belongs to it, from its start to its end. [K]"""
    paths = ends - starts
    from_starts = positions - starts
    squared_lengths = paths.square().sum(dim=1).clamp_min(torch.finfo(paths.dtype).tiny)
    products = (from_starts * paths).sum(dim=1)
    along = products / squared_lengths
    along = along.clamp(0, 1)  # Nearest place of the path: 0 is its start, and 1 its end.
    from_paths = torch.addcmul(from_starts, along[:, None], paths, value=-1)
    return from_paths.norm(dim=1)
