"""What one photo shows and the others deny, such as people and cars that moved while photos were taken.

Each view is drawn with the Gaussians of a run and compared with its photo, both of them small. A static thing that is
not learned yet differs in all views that see it; what moved differs in its own view alone. So the differences of other
views are carried over by the drawn depth, and what remains is the *excess* of a view. Where that is far above the
capture's own spread over a coherent region, something moved.

Nothing here knows people or cars, and nothing is learned beforehand.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from sadgs_ns.geometry.rigid import inverse_rigid

WORKING_SIDE = 400
"""Longest side in px at which views are compared, a quarter of a photo of 1,600 px. Larger photos are reduced to it."""
NEIGHBOURS = 6
"""Views with which each view is compared."""
FEWEST_SEEING = 2
"""Other views that must see a point to deny what stands before it."""
CONFIRMING = 0.5
"""Quantile of the other views' differences that counts. The upper quartile spares what only some of them learned."""
HIDDEN_DEPTH = 1.15
"""Depth of a point, relative to what another view draws there, from which the point counts as hidden in that view."""
SHIFT = 1
"""Largest shift in px, in x and in y, at which a rendering's pixel still counts as the photo's."""
WINDOW = 5
"""Side in px, odd, of the window over which differences are averaged."""
WIDE = 25
"""Side in px, odd, of the window whose mean is no structure."""
STRUCTURAL_SHARE = 0.25
"""Share of a region's `STRONG` pixels that differ by `LEAST_EXCESS` in structure, too. On disturbed copies of castle
and fox at a quarter of their size it was .31 or more where things were, and 0 to .19 where the light was another."""
STRONG, WEAK = 10.0, 4.0
"""Multiples of the capture's spread beyond the median: a region has `STRONG` pixels, and reaches as far as `WEAK`."""
LEAST_EXCESS = 0.1
"""Excess of colours in [0, 1] that `STRONG` pixels have at least: less may be the light."""
SMALLEST_SHARE = 0.003
"""Smallest share of a photo's pixels that the `STRONG` pixels of a region cover."""
DILATION = 1
"""Pixels, at least 1, by which regions are dilated, as edges are blurred and things throw shadows. The windows of the
differences reach beyond outlines, too."""
_SAMPLES = 200_000  # Pixels of all views of which median and spread are taken
_POINTS = 1000  # Points on surfaces that tell which views see the same things
_PIXELS_TOGETHER = 2**23  # Pixels that are compared at a time with those of neighbours, in arrays of 100 MB
_MARKED_TOGETHER = 2**23  # Pixels that are marked at a time
_FEWEST_PIXELS = 4  # Of a region in the smallest photos
_CROSS = np.array([[0, 1, 0], [1, 1, 1], [0, 1, 0]], np.uint8)  # A pixel and the four beside it
_STRONG, _WEAK, _STRUCTURAL = 1, 2, 4  # Bits of `_marks`
_TINY = 1e-6


@dataclass(frozen=True)
class SmallView:
    """A training view at working size."""

    difference: Tensor  # Between photo and rendering, of `difference`. [h, w]
    structure: Tensor  # The same without what changes slowly, of `structure`. [h, w]
    depth: Tensor  # Of what is drawn, along the viewing axis in world units; 0 where nothing is. [h, w]
    valid: Tensor  # False where a mask hides the photo. bool [h, w]
    viewmat: Tensor  # World to camera. [4, 4]
    K: Tensor  # Intrinsics in px at this size. [3, 3]

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in px."""
        height, width = self.depth.shape
        return height, width


@dataclass(frozen=True)
class Spread:
    """Median and spread of the excess in a capture."""

    median: float
    deviation: float  # A standard deviation, from the median of absolute deviations

    @property
    def strong(self) -> float:
        """Excess from which pixels are strong."""
        return max(self.median + STRONG * self.deviation, LEAST_EXCESS)

    @property
    def weak(self) -> float:
        """Excess from which pixels are weak."""
        return max(self.median + WEAK * self.deviation, LEAST_EXCESS * WEAK / STRONG)


def working_size(
    size: tuple[int, int],  # Height and width of a photo in px
) -> tuple[int, int]:
    """Height and width in px at which a photo is compared."""
    factor = min(1.0, WORKING_SIDE / max(size))
    height, width = size
    return max(round(factor * height), 1), max(round(factor * width), 1)


def difference(
    photos: Tensor,  # In [0, 1] [V, 3, h, w]
    drawn: Tensor,  # In [0, 1], with the photos' gains [V, 3, h, w]
    valid: Tensor,  # bool [V, h, w]
) -> Tensor:
    """Differences between small photos and their renderings, 0 where a photo is hidden. [V, h, w]

    A pixel's difference is the distance of the smoothed colours, at the closest of the shifts by `SHIFT` px at most, so
    that edges that lie a little beside their place do not count. The result is its mean over a window.
    """
    weight = valid.to(photos)[:, None]  # [V, 1, h, w]
    photos = _smoothed(photos, weight, 3)
    drawn = _smoothed(drawn, weight, 3)
    num_views, height, width = valid.shape
    padded = F.pad(drawn, (SHIFT, SHIFT, SHIFT, SHIFT), mode="replicate")
    shifted = F.unfold(padded, 2 * SHIFT + 1).view(num_views, 3, -1, height, width)
    squares = (photos[:, :, None] - shifted).square().mean(dim=1)  # At each shift. [V, shifts, h, w]
    least = squares.amin(dim=1, keepdim=True).sqrt()
    return (_smoothed(least, weight, WINDOW) * weight)[:, 0]


def structure(
    photos: Tensor,  # In [0, 1] [V, 3, h, w]
    drawn: Tensor,  # In [0, 1], with the photos' gains [V, 3, h, w]
    valid: Tensor,  # bool [V, h, w]
) -> Tensor:
    """Differences between small photos and their renderings, each without its mean over a wide window. [V, h, w]

    A shadow with soft edges, or light that changes, is in the means. Things have outlines.
    """
    weight = valid.to(photos)[:, None]
    return difference(photos - _smoothed(photos, weight, WIDE), drawn - _smoothed(drawn, weight, WIDE), valid)


def _smoothed(
    images: Tensor,  # [V, C, h, w]
    weight: Tensor,  # [V, 1, h, w]
    side: int,  # px, odd
) -> Tensor:
    """Weighted means of images over windows; 0 where a window has no weight. [V, C, h, w]"""
    weighted = torch.cat([images * weight, weight], dim=1)  # [V, C + 1, h, w]
    of_columns = F.avg_pool2d(weighted, (side, 1), 1, (side // 2, 0), count_include_pad=False)
    means = F.avg_pool2d(of_columns, (1, side), 1, (0, side // 2), count_include_pad=False)
    return means[:, :-1] / means[:, -1:].clamp_min(_TINY)


@dataclass(frozen=True)
class Group:
    """Views of one size: their places among all views, and what `SmallView` has, stacked."""

    members: list[int]
    difference: Tensor  # [V, h, w]
    structure: Tensor  # [V, h, w]
    depth: Tensor  # [V, h, w]
    valid: Tensor  # bool [V, h, w]
    viewmat: Tensor  # [V, 4, 4]
    K: Tensor  # [V, 3, 3]

    @property
    def size(self) -> tuple[int, int]:
        """Height and width in px."""
        height, width = self.depth.shape[1:]
        return height, width

    @cached_property
    def place_of(self) -> dict[int, int]:
        """Places in the group, by places among all views."""
        return {index: place for place, index in enumerate(self.members)}

    @cached_property
    def planes(self) -> Tensor:
        """What other views read: the greatest difference near each pixel, the depth, and 1 where valid. [V, 3, h, w]"""
        nearby = F.max_pool2d(self.difference[:, None], WINDOW, 1, WINDOW // 2)[:, 0]
        return torch.stack([nearby, self.depth, self.valid.to(nearby)], dim=1)

    def view(self, place: int) -> SmallView:
        """Return one of the views, which shares the group's memory."""
        parts = (self.difference, self.structure, self.depth, self.valid, self.viewmat, self.K)
        return SmallView(*[part[place] for part in parts])


def grouped(views: Sequence[SmallView]) -> list[Group]:
    """Stack the views of each size, which are then computed together: a view alone is too little work for a GPU."""
    members: dict[tuple[int, ...], list[int]] = {}
    for index, view in enumerate(views):
        members.setdefault(tuple(view.depth.shape), []).append(index)
    groups = []
    for indices in members.values():
        stacked = {}
        for name in ("difference", "structure", "depth", "valid", "viewmat", "K"):
            stacked[name] = torch.stack([getattr(views[index], name) for index in indices])
        groups.append(Group(indices, **stacked))
    return groups


def surface_points(groups: Sequence[Group]) -> Tensor:
    """Return points on the drawn surfaces, evenly over views and pixels, in world space. float64 [P, 3]"""
    num_views = sum(len(group.members) for group in groups)
    points_per_view = max(_POINTS // num_views, 2)
    points = []
    for group in groups:
        height, width = group.size
        step = max(height * width // points_per_view, 1)
        chosen = torch.arange(step // 2, height * width, step, device=group.depth.device)
        depth = group.depth.flatten(1)[:, chosen].double()  # [V, P]
        columns = chosen % width
        rows = torch.div(chosen, width, rounding_mode="floor")
        ray_x, ray_y = _rays(columns, rows, group.K.double())  # [V, P] each
        in_camera = torch.stack([ray_x * depth, ray_y * depth, depth], dim=1)  # [V, 3, P]
        to_world = inverse_rigid(group.viewmat.double())
        in_world = to_world[:, :3, :3] @ in_camera + to_world[:, :3, 3:]  # [V, 3, P]
        points.append(in_world.mT[depth > 0])
    return torch.cat(points)


def excesses(groups: Sequence[Group], neighbours: Sequence[Sequence[int]]) -> list[Tensor]:
    """Subtract neighbours' differences from those of views; NaN where too few of them see the point. [h, w] each

    A neighbour counts if it sees the point, or looks through its place at something behind it. One in which something
    nearer hides the point does not count.

    Args:
        groups: All views.
        neighbours: Of each view, the places of its neighbours among all views, at most `NEIGHBOURS`.

    Returns:
        One for each view, in the order of all views.
    """
    found: dict[int, Tensor] = {}
    for group in groups:
        height, width = group.size
        together = max(_PIXELS_TOGETHER // (NEIGHBOURS * height * width), 1)
        for start in range(0, len(group.members), together):
            part = slice(start, start + together)
            indices = group.members[part]
            carried = _carried(group, part, [neighbours[index] for index in indices], groups)
            known = carried.isfinite().sum(dim=1) >= FEWEST_SEEING
            known &= group.valid[part]
            excess = group.difference[part] - _upper(carried)
            excess = torch.where(known, excess, math.nan)
            for index, values in zip(indices, excess, strict=True):
                found[index] = values
    return [found[index] for index in range(len(neighbours))]


def _upper(
    values: Tensor,  # NaN where unknown [V, N, h, w]
) -> Tensor:
    """Return the quantile `CONFIRMING` of known values, the higher of two; no meaning where none is. [V, h, w]"""
    known = values.isfinite()
    count = known.sum(dim=1, keepdim=True)  # [V, 1, h, w]
    ordered = torch.where(known, values, math.inf).sort(dim=1).values
    rank = (CONFIRMING * (count - 1)).ceil().long().clamp_min(0)
    return ordered.gather(1, rank)[:, 0]


def _carried(
    group: Group,
    part: slice,  # V views of the group
    neighbours: Sequence[Sequence[int]],  # Of each of them, its neighbours' places among all views
    groups: Sequence[Group],  # All views
) -> Tensor:
    """Return the differences of neighbours at the points of views. [V, NEIGHBOURS, h, w]

    NaN where a neighbour does not count, and in place of those that a view has fewer than `NEIGHBOURS`.
    """
    points = _points_in_camera(group, part)  # [V, 3, h, w]
    depth = group.depth[part]
    to_world = inverse_rigid(group.viewmat[part].double())
    height, width = group.size
    carried = torch.full((len(depth), NEIGHBOURS, height, width), math.nan, device=depth.device)
    for other in groups:
        views, slots, members = _pairs(neighbours, other)
        if not views:
            continue
        from_view = other.viewmat[members].double() @ to_world[views]  # [pairs, 4, 4]
        to_picture = _onto_picture(other)[members] @ from_view[:, :3]
        point = _transformed(to_picture.float(), points, views)  # [pairs, 3, h, w]
        point_depth = point[:, 2]
        places = point[:, :2] / point_depth.clamp_min(_TINY)[:, None]  # [pairs, 2, h, w]
        grid = places.movedim(1, -1)
        value, drawn, sees = F.grid_sample(other.planes[members], grid, mode="nearest", align_corners=False).unbind(1)
        # Where nothing is drawn, nothing hides the point.
        known = (point_depth < HIDDEN_DEPTH * drawn) | (drawn == 0)
        known &= sees > 0
        known &= point_depth > 0
        known &= depth[views] > 0
        carried[views, slots] = value.masked_fill(~known, math.nan)
    return carried


def _points_in_camera(
    group: Group,
    part: slice,  # V views of the group
) -> Tensor:
    """Return the drawn points of views in the axes of their cameras. [V, 3, h, w]"""
    height, width = group.size
    depth = group.depth[part]
    columns = torch.arange(width, device=depth.device)
    rows = torch.arange(height, device=depth.device)
    ray_x, ray_y = _rays(columns, rows, group.K[part])  # [V, w] and [V, h]
    return torch.stack([ray_x[:, None] * depth, ray_y[:, :, None] * depth, depth], dim=1)


def _rays(
    columns: Tensor,  # Of pixels, from 0 [X]
    rows: Tensor,  # Of pixels, from 0 [Y]
    K: Tensor,  # Intrinsics of views in px [V, 3, 3]
) -> tuple[Tensor, Tensor]:
    """Return x and y at depth 1 of the rays through pixels' centres, in the axes of the cameras. [V, X] and [V, Y]"""
    x = columns + 0.5
    y = rows + 0.5
    ray_x = (x - K[:, 0, 2, None]) / K[:, 0, 0, None]
    ray_y = (y - K[:, 1, 2, None]) / K[:, 1, 1, None]
    return ray_x, ray_y


def _onto_picture(group: Group) -> Tensor:
    """Return matrices from the axes of cameras to homogeneous places in their pictures, whose borders are at −1 and 1.

    Returns:
        float64 [V, 3, 3]
    """
    height, width = group.size
    to_borders = torch.tensor([[2 / width, 0, -1], [0, 2 / height, -1], [0, 0, 1]], dtype=torch.float64)
    return to_borders.to(group.K.device) @ group.K.double()


def _transformed(
    matrices: Tensor,  # [pairs, 3, 4]
    points: Tensor,  # [V, 3, h, w]
    views: Sequence[int],  # Of each pair its view
) -> Tensor:
    """Transform the points of each pair's view by the pair's matrix. [pairs, 3, h, w]

    This is no matrix product, since TF32 would round it to 10 bits.
    """
    columns = matrices[..., None, None].unbind(2)  # Four of [pairs, 3, 1, 1]
    transformed = columns[3]
    for axis in range(3):
        transformed = torch.addcmul(transformed, columns[axis], points[views, axis, None])
    return transformed


def _pairs(neighbours: Sequence[Sequence[int]], other: Group) -> tuple[list[int], list[int], list[int]]:
    """List the pairs of a view and a neighbour of it in a group, given the neighbours of each view.

    Returns:
        Of each pair the view, the neighbour's place among the view's, and its place in the group.
    """
    views = []
    slots = []
    members = []
    for view, row in enumerate(neighbours):
        for slot, index in enumerate(row):
            if index in other.place_of:
                views.append(view)
                slots.append(slot)
                members.append(other.place_of[index])
    return views, slots, members


def spread(
    excesses: Sequence[Tensor],  # Of all views; NaN where unknown [h, w]
) -> Spread:
    """Return median and spread of the excess over all views; both are 0 where nothing could be compared."""
    total = sum(values.numel() for values in excesses)
    step = math.ceil(total / _SAMPLES)
    sampled = torch.cat([values.flatten()[::step] for values in excesses])
    sampled = sampled[sampled.isfinite()]
    if not len(sampled):
        return Spread(0.0, 0.0)
    median = sampled.median()
    deviation = 1.4826 * (sampled - median).abs().median()
    return Spread(float(median), float(deviation))


def regions(
    groups: Sequence[Group],  # All views
    excesses: Sequence[Tensor],  # Of all views in their order; NaN where unknown [h, w]
    limits: Spread,
    threads: int = 1,
) -> dict[int, NDArray[np.bool_]]:
    """Return where something moved, of the views in which something did. By view, bool [h, w]

    A region consists of connected weak pixels. Enough of them are strong, and enough of the strong ones differ in
    structure, not in brightness alone. It is dilated, and its holes are filled. Threads search views side by side.
    """
    chosen = _candidates(excesses, limits)
    found = {}
    with ThreadPoolExecutor(threads) as pool:
        for group in groups:
            height, width = group.size
            places = [place for place, index in enumerate(group.members) if index in chosen]
            together = max(_MARKED_TOGETHER // (height * width), 1)
            for start in range(0, len(places), together):
                part = places[start : start + together]
                indices = [group.members[place] for place in part]
                values = torch.stack([excesses[index] for index in indices])
                marks = _marks(group, part, values, limits).cpu().numpy()
                for index, region in zip(indices, pool.map(_region, marks), strict=True):
                    if region is not None:
                        found[index] = region
    return dict(sorted(found.items()))


def _candidates(excesses: Sequence[Tensor], limits: Spread) -> set[int]:
    """Return the views that have enough strong pixels for a region.

    They are counted together, since a GPU waits wherever a number is read.
    """
    if not len(excesses):
        return set()
    counts = torch.stack([(values > limits.strong).sum() for values in excesses]).tolist()
    chosen = set()
    for index, values in enumerate(excesses):
        if counts[index] >= _smallest(values.numel()):
            chosen.add(index)
    return chosen


def _smallest(num_pixels: int) -> float:
    """Return the least number of strong pixels of a region, in a photo of this many pixels."""
    return max(SMALLEST_SHARE * num_pixels, _FEWEST_PIXELS)


def _marks(
    group: Group,
    places: Sequence[int],  # V views of the group
    values: Tensor,  # Their excesses; NaN where unknown [V, h, w]
    limits: Spread,
) -> Tensor:
    """Mark which pixels are strong, which are weak, and which strong ones differ in structure: a bit each.

    The excess is unknown before the sky, for example, which has no depth. There a pixel is weak if its difference is
    above the view's median by more than the strong limit, so that a region also extends over such pixels.

    Returns:
        uint8 [V, h, w]
    """
    difference = group.difference[places]
    known = values.isfinite()
    strong = known & (values > limits.strong)
    median = difference.flatten(1).median(dim=1).values[:, None, None]
    weak_if_unknown = difference > median + limits.strong
    weak = torch.where(known, values > limits.weak, weak_if_unknown)
    structural = strong & (group.structure[places] > LEAST_EXCESS)
    return _STRONG * strong.byte() + _WEAK * weak.byte() + _STRUCTURAL * structural.byte()


def _region(
    marks: NDArray[np.uint8],  # What `_marks` returned, of one view [h, w]
) -> NDArray[np.bool_] | None:
    """Return where something moved in a view; None if nothing did. [h, w]"""
    weak = (marks & _WEAK) > 0
    labels, number = _components(_opened(weak.view(np.uint8)))
    counts = np.bincount(labels[(marks & _STRONG) > 0], minlength=number)
    structural_counts = np.bincount(labels[(marks & _STRUCTURAL) > 0], minlength=number)
    is_region = (counts >= _smallest(marks.size)) & (structural_counts >= STRUCTURAL_SHARE * counts)
    is_region[0] = False  # Pixels that opening has removed
    if not is_region.any():
        return None
    return _filled(_dilated(is_region[labels].view(np.uint8)))


def _components(
    pixels: NDArray[np.uint8],  # 0 or 1 [h, w]
) -> tuple[NDArray[np.int32], int]:
    """Number connected pixels of 1 from 1, 0 elsewhere [h, w]; return how many numbers there are, 0 included."""
    found: Any = cv2.connectedComponents(pixels, connectivity=4, ltype=cv2.CV_32S)
    number, labels = found
    return labels, number


def _opened(
    pixels: NDArray[np.uint8],  # 0 or 1 [h, w]
) -> NDArray[np.uint8]:
    """Take away what is thinner than the cross. [h, w]"""
    outside = (0.0,)
    opened: Any = cv2.morphologyEx(pixels, cv2.MORPH_OPEN, _CROSS, borderType=cv2.BORDER_CONSTANT, borderValue=outside)
    return opened


def _dilated(
    pixels: NDArray[np.uint8],  # 0 or 1 [h, w]
) -> NDArray[np.uint8]:
    """Let a region grow by `DILATION`. [h, w]"""
    grown: Any = cv2.dilate(pixels, _CROSS, iterations=DILATION)
    return grown


def _filled(
    pixels: NDArray[np.uint8],  # 0 or 1 [h, w]
) -> NDArray[np.bool_]:
    """Fill the holes of a region, which do not reach the picture's border. [h, w]"""
    labels, number = _components((pixels == 0).view(np.uint8))
    is_hole = np.ones(number, np.bool_)
    for border in (labels[0], labels[-1], labels[:, 0], labels[:, -1]):
        is_hole[border] = False
    is_hole[0] = False
    return (pixels > 0) | is_hole[labels]
