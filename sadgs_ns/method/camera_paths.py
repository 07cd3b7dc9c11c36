"""The space along the cameras' paths, which stays empty while a run densifies.

Nothing stands where somebody walked with a camera. Yet a faint Gaussian may float there, which a view from beside it
shows as haze over the whole image. Viewers of exported files show it, too, since they draw what is nearer than the
run's near plane. Real surfaces near a path have SfM points.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from scipy.spatial import KDTree
from torch import Tensor

REACH = 1.5
"""Reach of the empty space around a path, in near planes; 2 cost a view 2.6 dB (docs/results.md#exported-files)."""
FEW_VIEWS, REACH_OF_MANY = 60, 1.0
"""Training views up to which it reaches so far, and its reach with more, where 1.5 cost site .2 dB."""
HAZE_ANGLE = 0.1
"""Haze has a longest standard deviation of more than this share of its distance from a path. With 0.2 some stayed."""
SUPPORT = 2.0
"""A Gaussian stands for a surface if a point to start from lies within this many of its standard deviations."""
NEIGHBOURS = 4  # A path leads from each camera to so many of the others, the nearest that look in a similar direction
SIMILAR_DEGREES = 60.0  # Largest angle between the viewing axes of two cameras with a path between them
_CELLS = 32  # Cells on each side of a grid that tells which Gaussians may be near a path
_PAIRS = 2**21  # Pairs of a point and a path that are computed at a time, in arrays of 25 MB


@dataclass(frozen=True)
class CameraPaths:
    """E straight paths between cameras, and the points of surfaces near them."""

    starts: Tensor  # World units. [E, 3]
    ends: Tensor  # World units. [E, 3]
    reach: float  # Distance up to which the space around the paths is empty, in world units
    points: Tensor  # Points of surfaces around the paths. [P, 3]
    corner: Tensor  # Smallest coordinates of a grid around the paths. [3]
    cell: float  # Side of its cells, which are cubes
    near: Tensor  # Which of its cells reach into the empty space. bool [32, 32, 32]

    @staticmethod
    def of(
        viewmats: Tensor,  # [C, 4, 4]
        near_plane: float,
        points: Tensor,  # [P, 3]
    ) -> CameraPaths:
        """Connect neighbouring cameras, given the scene's near plane > 0 and the points that a run starts from."""
        rotations = viewmats[:, :3, :3].double().cpu()
        centres = -(rotations.mT @ viewmats[:, :3, 3:].double().cpu())[..., 0]  # [C, 3]
        distances = torch.cdist(centres, centres)
        unlike = rotations[:, 2] @ rotations[:, 2].T < math.cos(math.radians(SIMILAR_DEGREES))
        distances = distances.masked_fill(unlike, torch.inf).fill_diagonal_(torch.inf)
        nearest = distances.topk(min(NEIGHBOURS, len(centres) - 1), largest=False)
        first = torch.arange(len(centres))[:, None].expand_as(nearest.indices)
        pairs = torch.stack([first, nearest.indices], dim=-1)[nearest.values.isfinite()].sort(dim=1).values
        pairs = torch.cat([torch.arange(len(centres))[:, None].expand(-1, 2), pairs.unique(dim=0)])  # [E, 2]
        starts, ends = centres[pairs].to(points).unbind(dim=1)
        reach = near_plane * (REACH if len(centres) <= FEW_VIEWS else REACH_OF_MANY)
        corner, far = starts.amin(dim=0) - reach, starts.amax(dim=0) + reach
        cell = float((far - corner).max()) / _CELLS
        middles = (torch.arange(_CELLS, device=points.device) + 0.5) * cell
        grid = corner + torch.stack(torch.meshgrid(middles, middles, middles, indexing="ij"), dim=-1)  # [32, 32, 32, 3]
        near = _distances(grid.view(-1, 3), starts, ends).view(grid.shape[:3]) <= reach + cell * math.sqrt(3) / 2
        margin = 2 * SUPPORT * reach  # No other point is near enough to what `haze` looks at.
        around = ((points >= corner - margin) & (points <= far + margin)).all(dim=1)
        return CameraPaths(starts, ends, reach, points[around], corner, cell, near)

    @cached_property
    def surfaces(self) -> KDTree:
        """The points, to be searched for the nearest. Comparing all pairs took 40 % of castle's loop on a GPU."""
        return KDTree(self.points.cpu().numpy())

    @torch.no_grad()
    def haze(
        self,
        means: Tensor,  # [N, 3]
        scales: Tensor,  # [N, 3]
    ) -> Tensor:
        """Tell which Gaussians are haze near a path; those whose centre is not finite are none. bool [N]"""
        cells = ((means - self.corner) / self.cell).nan_to_num(-1.0).clamp(-1, _CELLS).floor().long()  # [N, 3]
        inside = ((cells >= 0) & (cells < _CELLS)).all(dim=1)
        x, y, z = cells.clamp(0, _CELLS - 1).unbind(dim=1)
        found = (inside & self.near[x, y, z]).nonzero()[:, 0]  # [n]
        sizes, distances = scales[found].amax(dim=1), _distances(means[found], self.starts, self.ends)
        large = (distances < self.reach) & (sizes > HAZE_ANGLE * distances)
        found, sizes = found[large], sizes[large].clamp_max(2 * self.reach)
        ways, _ = self.surfaces.query(means[found].cpu().numpy(), workers=-1)
        haze = torch.zeros(len(means), dtype=torch.bool, device=means.device)
        haze[found] = torch.from_numpy(ways).to(sizes) > SUPPORT * sizes
        return haze


def _distances(positions: Tensor, starts: Tensor, ends: Tensor) -> Tensor:
    """Distances of positions [N, 3] from the nearest of the straight paths [E, 3] each. [N]"""
    ways = ends - starts  # [E, 3]
    squares = ways.square().sum(dim=1).clamp_min(torch.finfo(ways.dtype).tiny)
    least = [positions[:0, 0]]
    for part in positions.split(max(_PAIRS // len(starts), 1)):
        away = part[:, None] - starts  # [n, E, 3]
        along = ((away * ways).sum(dim=2) / squares).clamp(0, 1)
        least.append(torch.addcmul(away, along[..., None], ways, value=-1).norm(dim=2).amin(dim=1))
    return torch.cat(least)
