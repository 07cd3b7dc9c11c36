"""The space along the cameras' paths, which training keeps empty.

Nothing stands where somebody walked with a camera. A faint Gaussian that floats there becomes haze over the whole image
of a view beside the path. Viewers of exported files show it, too, because they also draw what is nearer than the run's
near plane. Real surfaces near a path have SfM points, and look small from it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from scipy.spatial import KDTree
from torch import Tensor

REACH = 1.5  # Reach of the empty space around a path, in near planes; 1 left some of room, and 2 cost a view 2.6 dB
HAZE_LENGTH = 0.1  # Haze is longer, in standard deviations, than this share of its distance from a path; .2 left some
SUPPORT = 0.4  # And no point to start from lies within this share of it: needles among leaves reach points twice as far
TOO_WIDE = 0.4  # Or its second axis is longer than this share: nobody stands so near a surface with a camera
NEIGHBOURS = 4  # Each camera has paths to this many others: the nearest ones that look in a similar direction
SIMILAR_DEGREES = 60.0  # Largest angle between the viewing axes of two cameras with a path between them
SAME_PLACE = 5e-4  # Share of the reach within which cameras stand in one place, such as the parts of a panorama
LONGEST = 20.0  # Longest path, in near planes or in medians of the distance from a camera to its nearest neighbour
_CUBES = 2**12  # Cubes along each side of a grid, at most; float32 tells them apart
_PAIRS = 2**21  # Pairs of a point and a path that are computed at a time, in arrays of 25 MB


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
        rotations = viewmats[:, :3, :3].double().cpu()
        centres = -(rotations.mT @ viewmats[:, :3, 3:].double().cpu())[..., 0]  # [C, 3]
        reach = REACH * near_plane
        distances = torch.cdist(centres, centres)
        unlike = rotations[:, 2] @ rotations[:, 2].T < math.cos(math.radians(SIMILAR_DEGREES))
        nearest = distances.masked_fill_(unlike | (distances < SAME_PLACE * reach), torch.inf).fill_diagonal_(torch.inf)
        nearest = nearest.topk(min(NEIGHBOURS, len(centres) - 1), largest=False)
        longest = LONGEST * max(near_plane, float(nearest.values[:, :1].median()))
        first = torch.arange(len(centres))[:, None].expand_as(nearest.indices)
        pairs = torch.stack([first, nearest.indices], dim=-1)[nearest.values < longest].sort(dim=1).values
        pairs = torch.cat([torch.arange(len(centres))[:, None].expand(-1, 2), pairs.unique(dim=0)])  # [E, 2]
        starts, ends = centres[pairs].to(points).unbind(dim=1)
        # `haze` looks at no point farther away.
        return CameraPaths(starts, ends, reach, points[_near(points, starts, ends, (1 + SUPPORT) * reach)[0] > 0])

    @cached_property
    def surfaces(self) -> KDTree:
        """A search tree of the points. Comparing all pairs took 40 % of castle's loop on a GPU."""
        return KDTree(self.points.cpu().numpy(), balanced_tree=False, compact_nodes=False)  # is built soonest

    @torch.no_grad()
    def haze(
        self,
        means: Tensor,  # [N, 3]
        scales: Tensor,  # [N, 3]
    ) -> Tensor:
        """Tell which Gaussians are haze near a path; one whose centre is not finite is not. bool [N]"""
        from_path = torch.full_like(means[:, 0], torch.inf)  # [N]
        counts, firsts, listed = _near(means, self.starts, self.ends, self.reach)
        most = int(counts.max()) if len(counts) else 0
        for part in counts.nonzero()[:, 0].split(_PAIRS // max(most, 1) + 1):
            which = part.repeat_interleave(counts[part])  # A Gaussian for each of K pairs. [K]
            before = (counts[part].cumsum(dim=0) - counts[part]).repeat_interleave(counts[part])  # [K]
            paths = listed[firsts[which] + torch.arange(len(which), device=which.device) - before]
            distances = _distances(means[which], self.starts[paths], self.ends[paths])
            from_path.scatter_reduce_(0, which, distances, "amin")
        haze = (from_path < self.reach) & (scales.amax(dim=1) > HAZE_LENGTH * from_path)
        found = haze.nonzero()[:, 0]
        ways, _ = self.surfaces.query(means[found].cpu().numpy(), workers=-1)
        alone = torch.from_numpy(ways).to(means) > SUPPORT * from_path[found]
        haze[found] = alone | (scales[found].median(dim=1).values > TOO_WIDE * from_path[found])
        return haze


def _near(positions: Tensor, starts: Tensor, ends: Tensor, reach: float) -> tuple[Tensor, Tensor, Tensor]:
    """List the paths [E, 3] that may come within `reach` of positions [N, 3]; a position that is NaN has none.

    A cube around all paths is halved again and again, without the parts that no path comes so near to. Return how many
    paths each position has [N], the first of them in the list [N], and the list of paths [K]; int64.
    """
    corner = starts.amin(dim=0) - reach
    side = float((starts.amax(dim=0) + reach - corner).max())
    smallest = max(reach, side / _CUBES)
    halves = torch.tensor([-0.5, 0.5], device=starts.device)
    middles = (corner + side / 2).expand_as(starts)
    paths = torch.arange(len(starts), device=starts.device)
    while side > smallest and len(paths) <= _PAIRS // 4:
        side /= 2
        middles = (middles[:, None] + side * torch.cartesian_prod(halves, halves, halves)).view(-1, 3)
        paths = paths.repeat_interleave(8)
        near = _distances(middles, starts[paths], ends[paths]) <= reach + side  # But for rounding, √3/2 of it would do.
        middles = middles[near]
        paths = paths[near]
    cubes = ((torch.cat([middles, positions]) - corner) / side).nan_to_num(-1.0).clamp(-1, _CUBES).floor().long()
    cubes = (cubes[:, 0] * (_CUBES + 2) + cubes[:, 1]) * (_CUBES + 2) + cubes[:, 2]
    (listed, order) = cubes[: len(paths)].sort()
    places = cubes[len(paths) :]
    firsts = torch.searchsorted(listed, places)
    return torch.searchsorted(listed, places, right=True) - firsts, firsts, paths[order]


def _distances(positions: Tensor, starts: Tensor, ends: Tensor) -> Tensor:
    """Distances of positions from straight paths, all [K, 3]. [K]"""
    ways = ends - starts
    away = positions - starts
    squares = ways.square().sum(dim=1).clamp_min(torch.finfo(ways.dtype).tiny)
    along = ((away * ways).sum(dim=1) / squares).clamp(0, 1)
    return torch.addcmul(away, along[:, None], ways, value=-1).norm(dim=1)
