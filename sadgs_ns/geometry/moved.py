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
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from scipy import ndimage
from torch import Tensor

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
STRONG, WEAK = 10.0, 4.0
"""Multiples of the capture's spread beyond the median: a region has `STRONG` pixels, and reaches as far as `WEAK`."""
LEAST_EXCESS = 0.1
"""Excess of colours in [0, 1] that `STRONG` pixels have at least: less may be the light."""
SMALLEST_SHARE = 0.003
"""Smallest share of a photo's pixels that the `STRONG` pixels of a region cover."""
DILATION = 2
"""Pixels by which regions are dilated, as edges are blurred and things throw contact shadows."""
_SAMPLES = 200_000  # Pixels of all views of which median and spread are taken
_POINTS = 1000  # Points on surfaces that tell which views see the same things
_FEWEST_PIXELS = 4  # Of a region in the smallest photos
_CROSS = ndimage.generate_binary_structure(2, 1)  # A pixel and the four beside it
_TINY = 1e-6


@dataclass(frozen=True)
class SmallView:
    """A training view at working size."""

    difference: Tensor  # Between photo and rendering, of `difference`. [h, w]
    depth: Tensor  # Of what is drawn, along the viewing axis in world units; 0 where nothing is. [h, w]
    valid: Tensor  # False where a mask hides the photo. bool [h, w]
    viewmat: Tensor  # World to camera. [4, 4]
    K: Tensor  # Intrinsics in px at this size. [3, 3]


@dataclass(frozen=True)
class Spread:
    """Median and spread of the excess in a capture."""

    median: float
    deviation: float  # A standard deviation, from the median of absolute deviations

    @property
    def strong(self) -> float:
        """Excess of pixels that are a region's reason."""
        return max(self.median + STRONG * self.deviation, LEAST_EXCESS)

    @property
    def weak(self) -> float:
        """Excess up to which a region reaches."""
        return max(self.median + WEAK * self.deviation, LEAST_EXCESS * WEAK / STRONG)


def working_size(
    size: tuple[int, int],  # Height and width of a photo in px
) -> tuple[int, int]:
    """Height and width in px at which a photo is compared."""
    factor = min(1.0, WORKING_SIDE / max(size))
    height, width = size
    return max(round(factor * height), 1), max(round(factor * width), 1)


def difference(
    photo: Tensor,  # In [0, 1] [3, h, w]
    drawn: Tensor,  # In [0, 1], with the photo's gain [3, h, w]
    valid: Tensor,  # bool [h, w]
) -> Tensor:
    """Difference between a small photo and its rendering, 0 where the photo is hidden. [h, w]

    It is the distance of smoothed colours, at the shift of a pixel at most where they are closest, so that edges that
    lie a little beside their place do not count; and its mean over a window.
    """
    weight = valid.to(photo)[None]  # [1, h, w]
    photo = _smoothed(photo, weight, 3)
    drawn = _smoothed(drawn, weight, 3)
    height, width = valid.shape
    padded = F.pad(drawn[None], (SHIFT, SHIFT, SHIFT, SHIFT), mode="replicate")
    shifted = F.unfold(padded, 2 * SHIFT + 1).view(3, -1, height, width)
    least = (photo[:, None] - shifted).square().mean(dim=0).amin(dim=0).sqrt()  # [h, w]
    return _smoothed(least[None], weight, WINDOW)[0] * weight[0]


def _smoothed(
    image: Tensor,  # [C, h, w]
    weight: Tensor,  # [1, h, w]
    side: int,  # px, odd
) -> Tensor:
    """Weighted mean of an image over windows; 0 where a window has no weight. [C, h, w]"""
    both = torch.cat([image * weight, weight])[None]
    sums = F.avg_pool2d(both, side, 1, side // 2, count_include_pad=False)[0]
    return sums[:-1] / sums[-1:].clamp_min(_TINY)


def surface_points(views: Sequence[SmallView]) -> Tensor:
    """Return points of what the views draw, evenly over views and pixels, in world space. float64 [P, 3]"""
    of_each = max(_POINTS // len(views), 2)
    points = []
    for view in views:
        pixels = view.depth.numel()
        every = max(pixels // of_each, 1)
        chosen = torch.arange(every // 2, pixels, every, device=view.depth.device)
        depth = view.depth.flatten()[chosen].double()
        width = view.depth.shape[1]
        x = chosen % width + 0.5
        y = torch.div(chosen, width, rounding_mode="floor") + 0.5
        K = view.K.double()
        rays = torch.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], torch.ones_like(depth)])  # [3, P]
        to_world = view.viewmat.double().inverse()
        places = to_world[:3, :3] @ (rays * depth) + to_world[:3, 3:]
        points.append(places.T[depth > 0])
    return torch.cat(points)


def excess(view: SmallView, others: Sequence[SmallView]) -> Tensor:
    """Difference of a view beyond those of its neighbours; NaN where too few of them see the point. [h, w]

    A neighbour that sees a point, or looks through its place at something behind it, tells the point's difference. One
    in which something nearer hides the point tells nothing.
    """
    unknown = torch.full_like(view.difference, math.nan)
    if len(others) < FEWEST_SEEING:
        return unknown
    told = _carried(view, others)  # NaN where one tells nothing. [N, h, w]
    enough = told.isfinite().sum(dim=0) >= FEWEST_SEEING
    enough &= view.valid
    return torch.where(enough, view.difference - _upper(told), unknown)


def _upper(
    values: Tensor,  # NaN where unknown [N, h, w]
) -> Tensor:
    """Return the quantile `CONFIRMING` of known values, the higher of two; it has no meaning where none is. [h, w]"""
    known = values.isfinite()
    count = known.sum(dim=0)  # [h, w]
    ordered = torch.where(known, values, math.inf).sort(dim=0).values
    rank = (CONFIRMING * (count - 1)).ceil().long().clamp_min(0)
    return ordered.gather(0, rank[None])[0]


def _carried(view: SmallView, others: Sequence[SmallView]) -> Tensor:
    """Return the differences of other views at the points of a view, NaN where they tell nothing. [N, h, w]"""
    height, width = view.depth.shape
    device = view.depth.device
    x = torch.arange(width, device=device) + 0.5
    y = torch.arange(height, device=device)[:, None] + 0.5
    ray_x = (x - view.K[0, 2]) / view.K[0, 0]
    ray_y = (y - view.K[1, 2]) / view.K[1, 1]
    viewmats = torch.stack([other.viewmat for other in others]).double()
    Ks = torch.stack([other.K for other in others])
    to = (viewmats @ view.viewmat.double().inverse()).float()[:, :3, :, None, None]  # [N, 3, 4, 1, 1]
    # No matrix product, since TF32 would round it to 10 bits.
    turned = to[:, :, 0] * ray_x + to[:, :, 1] * ray_y + to[:, :, 2]  # [N, 3, h, w]
    point = turned * view.depth + to[:, :, 3]
    depth = point[:, 2].clamp_min(_TINY)  # [N, h, w]
    focal = Ks.diagonal(dim1=1, dim2=2)[:, :2, None, None]  # [N, 2, 1, 1]
    place = focal * point[:, :2] / depth[:, None] + Ks[:, :2, 2, None, None]  # px. [N, 2, h, w]
    found = _read(others, place)  # [N, 3, h, w]
    told, drawn, sees = found.unbind(dim=1)
    # Where nothing is drawn, nothing hides the point.
    known = (depth < HIDDEN_DEPTH * drawn) | (drawn == 0)
    known &= (sees > 0) & (point[:, 2] > 0) & (view.depth > 0)
    return torch.where(known, told, math.nan)


def _read(
    views: Sequence[SmallView],
    places: Tensor,  # In each view, in px [N, 2, h, w]
) -> Tensor:
    """Return the difference, the depth and 1 where the photo is valid, of each view at places in it. [N, 3, h, w]

    All are 0 outside of the picture. The greatest difference near the place counts, since depth is not exact.
    """
    found = []
    for view, place in zip(views, places, strict=True):
        height, width = view.depth.shape
        grid = torch.stack([place[0] * (2 / width) - 1, place[1] * (2 / height) - 1], dim=-1)
        near = F.max_pool2d(view.difference[None], WINDOW, 1, WINDOW // 2)
        planes = torch.stack([near[0], view.depth, view.valid.to(near)])[None]
        found.append(F.grid_sample(planes, grid[None], mode="nearest", align_corners=False)[0])
    return torch.stack(found)


def spread(
    excesses: Sequence[Tensor],  # Of all views; NaN where unknown [h, w]
) -> Spread:
    """Return median and spread of the excess over all views; both are 0 where nothing could be compared."""
    total = sum(values.numel() for values in excesses)
    every = math.ceil(total / _SAMPLES)
    sampled = torch.cat([values.flatten()[::every] for values in excesses])
    sampled = sampled[sampled.isfinite()]
    if not len(sampled):
        return Spread(0.0, 0.0)
    median = sampled.median()
    deviation = 1.4826 * (sampled - median).abs().median()
    return Spread(float(median), float(deviation))


def region(
    view: SmallView,
    values: Tensor,  # Excess of the view; NaN where unknown [h, w]
    limits: Spread,
) -> NDArray[np.bool_] | None:
    """Return where something moved in a view; None if nothing did. bool [h, w]

    A region is of connected pixels beyond the weak limit of which enough are beyond the strong one. Where the excess is
    unknown, as before the sky, which has no depth, a region goes on over pixels that differ from the rendering by the
    strong limit more than most of the view. It is dilated, and has no holes.
    """
    known = values.isfinite()
    excess = torch.where(known, values, -math.inf)
    strong = excess > limits.strong
    smallest = max(SMALLEST_SHARE * strong.numel(), _FEWEST_PIXELS)
    if int(strong.sum()) < smallest:
        return None
    usual = view.difference.median()
    weak = excess > limits.weak
    weak |= ~known & (view.difference > usual + limits.strong)
    opened: Any = ndimage.binary_opening(weak.cpu().numpy(), _CROSS)
    labels, number = _components(opened)
    counts = np.bincount(labels[strong.cpu().numpy()], minlength=number + 1)
    is_region = counts >= smallest
    is_region[0] = False  # Pixels that opening has removed
    if not is_region.any():
        return None
    return _filled(_dilated(is_region[labels]))


def _components(pixels: NDArray[np.bool_]) -> tuple[NDArray[np.int32], int]:
    """Number connected pixels from 1, 0 elsewhere [h, w], and return how many components there are."""
    found: Any = ndimage.label(pixels)
    labels, number = found
    return labels, number


def _dilated(pixels: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Let a region grow by `DILATION`. [h, w]"""
    grown: Any = ndimage.binary_dilation(pixels, _CROSS, DILATION)
    return grown


def _filled(pixels: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Fill the holes of a region, which do not reach the picture's border. [h, w]"""
    labels, number = _components(~pixels)
    is_hole = np.ones(number + 1, np.bool_)
    for border in (labels[0], labels[-1], labels[:, 0], labels[:, -1]):
        is_hole[border] = False
    is_hole[0] = False
    return pixels | is_hole[labels]
