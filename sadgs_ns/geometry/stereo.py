"""Depth maps of the training views by plane-sweep stereo, before training.

Each view is compared with a few neighbours, which see the same points from other directions. A hypothesis is an inverse
depth: it says where a pixel lies in a neighbour. The windows around both places are compared by their zero-mean
normalised cross-correlation (NCC), which ignores exposure. The coarsest level tests the view's whole range of depths,
each finer level a few around the best so far. In the end, a depth counts only where neighbours agree with it.

Pixels move evenly with inverse depth, and planes are linear in it. A picture spans [−1, 1]², as for `grid_sample`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from sadgs_ns.geometry.near_plane import depths_in_views

WORKING_SIDE = 800  # Longest side in px at which depth is computed; larger images are reduced: time grows with the area
LEVELS = 3  # Levels of the image pyramid. Each has half the sides of the one before
WINDOW = 5  # Side in px, odd, of the windows that are compared
SMOOTHING = 5  # Side in px, odd, of the box over which scores are averaged; plain pixels follow their neighbours
HYPOTHESES = 128  # Most intervals of inverse depth on the coarsest level. Time and memory grow with them
NEIGHBOURS = 4  # Neighbours per view. Time grows with them; with fewer, occlusions leave holes
NOISE = 0.004  # Standard deviation of grey values in [0, 1], a step of 8 bits, below which the correlation fades to 0
SCORES = (0.5, 0.8)  # Correlations at which confidence begins and is full. Lower ones add few pixels
AGREEING = 3  # Neighbours that agree with a depth of full confidence, or all if there are fewer
DEPTH_TOLERANCE = 0.01  # Largest relative difference between two views' depths that agree
PIXEL_TOLERANCE = 1.0
"""Depths agree if a pixel's own takes it to a neighbour, and the neighbour's takes it back to within this many px."""

_POINTS = 2000  # Most SfM points that are used. Neighbours and ranges are sums and quantiles, which need no more
_TRIPLES = 2**22  # Triples of two views and a point that are computed at a time, in arrays of 32 to 100 MB
_BEST_ANGLES = (5.0, 15.0)  # Degrees between two cameras' rays, between which depth is accurate and windows look alike
_WIDEST_ANGLE = 35.0  # Degrees from which on windows look too different to be compared
_SHARE = 0.02  # A neighbour is usable if its weight is at least this share of the points that the view sees
_TINY = 1e-6  # Keeps quotients finite. A point behind a camera is projected far outside its picture


@dataclass(frozen=True)
class DepthMap:
    """Depth of one view."""

    depth: Tensor  # Along the viewing axis, in world units; 0 where it is unknown. [h, w]
    confidence: Tensor  # In [0, 1]; 0 where the depth is unknown. [h, w]
    K: Tensor  # Intrinsics in px at this size; the centre of the first pixel is (0.5, 0.5). [3, 3]


@dataclass(frozen=True)
class _View:
    """A view at working size, and its geometry relative to its neighbours."""

    levels: list[Tensor]
    """Grey value around 0, and 1 where it is valid; both are 0 elsewhere. From fine to coarse. Each [2, h, w]"""
    neighbours: list[int]
    to: Tensor  # (x, y, 1, inverse depth) → homogeneous place in each neighbour, as `_project` uses it. [N, 3, 4]
    back: Tensor  # The same from each neighbour to this view. [N, 3, 4]
    inverse: tuple[float, float]  # Smallest and largest inverse depth
    step: float
    """Inverse depth that moves a pixel by about 1 px at working size in the neighbour with the longest baseline."""


@torch.no_grad()
def depth_maps(
    images: Callable[[int], Tensor],
    viewmats: Tensor,
    Ks: Tensor,
    points: Tensor,
    *,
    masks: Sequence[Tensor | None] | None = None,
    device: torch.device | str,
) -> list[DepthMap]:
    """Compute a depth map with confidence for each view of a capture. Nothing is random.

    Args:
        images: Returns a view's image, which may lie anywhere and have any size. uint8, or floating point in [0, 1].
            RGB is multiplied by alpha; pixels with an alpha under 0.5 are masked. [H, W, 3 or 4]
        viewmats, Ks: As `render.types.Cameras`, of the images; the centre of the first pixel is (0.5, 0.5).
        points: Points on surfaces, in world units, which tell what the views see, and how far away it is. [P, 3]
        masks: Valid pixels of each view, or None for all; others get no depth, and are not compared. Each bool [H, W]
        device: Where to compute. The results lie there.

    Returns:
        A map for each view, whose longest side is at most WORKING_SIDE px; empty if it has no usable neighbour.
    """
    count = len(viewmats)
    device = torch.device(device)
    masks = [None] * count if masks is None else masks
    # In float64, since positions may be far from the origin, and on the host, which needs the numbers.
    viewmats = viewmats.to("cpu", torch.float64)
    Ks = Ks.to("cpu", torch.float64, copy=True)
    pyramids = []
    sizes = torch.zeros((count, 2), dtype=torch.float64)
    for v in range(count):
        image = images(v)
        pyramids.append(_pyramid(image, masks[v], device))
        sizes[v] = torch.tensor(pyramids[v][0].shape[:0:-1])
        Ks[v, :2] *= (sizes[v] / torch.tensor([image.shape[1], image.shape[0]]))[:, None]
    views = _views(pyramids, viewmats, Ks, sizes, points.to(device))
    placed = Ks.to(device, torch.float32)
    solved = [_solve(view, views) for view in views]
    maps = []
    for view, K, (inverse, score) in zip(views, placed, solved, strict=True):
        confidence = _confidence(view, inverse, score, [solved[n][0] for n in view.neighbours])
        maps.append(DepthMap(torch.where(confidence > 0, 1 / inverse, 0.0), confidence, K))
    return maps


@torch.no_grad()
def choose_neighbours(
    viewmats: Tensor,  # [V, 4, 4]
    Ks: Tensor,  # [V, 3, 3]
    sizes: Tensor,  # [V, 2]
    points: Tensor,  # [P, 3]
    count: int = NEIGHBOURS,
) -> Tensor:
    """Choose the views with which each view is compared, given float64 arguments of `depths_in_views`.

    Two views gain from every point that both see: less if the angle between their rays is too small or wide, or if one
    sees the point larger. A view counts less if one that is chosen already lies in the same direction.

    Returns:
        Indices of views, the best first, and −1 where there are fewer; on the device of the points. int64 [V, count]
    """
    depths = depths_in_views(points, viewmats, Ks, sizes)
    seen = depths.isfinite()
    centres = viewmats.inverse()[:, :3, 3]  # [V, 3]
    rays = F.normalize(points - centres[:, None], dim=2)  # [V, P, 3]
    scales = Ks[:, :1, 0] / torch.where(seen, depths, 1.0)  # px per world unit. [V, P]
    weights = []
    for part in torch.arange(len(seen), device=seen.device).split(max(_TRIPLES // max(seen.numel(), 1), 1)):
        angles = (rays[part, None] * rays).sum(dim=3).clamp(-1, 1).acos().rad2deg()  # [v, V, P]
        weight = (angles / _BEST_ANGLES[0]).clamp_max(1)
        weight *= ((_WIDEST_ANGLE - angles) / (_WIDEST_ANGLE - _BEST_ANGLES[1])).clamp(0, 1)
        ratios = scales[part, None] / scales
        weights.append((weight * torch.minimum(ratios, 1 / ratios) * (seen[part, None] & seen)).sum(dim=2))
    weight = torch.cat(weights)  # [V, V]
    weight = torch.where(weight < _SHARE * seen.sum(dim=1, keepdim=True), 0.0, weight).fill_diagonal_(0)
    directions = F.normalize(centres - centres[:, None], dim=2)  # From each view to each. [V, V, 3]
    chosen = torch.full((len(seen), count), -1, device=seen.device)
    for i in range(min(count, len(seen))):
        value, best = weight.max(dim=1)  # [V]
        chosen[:, i] = torch.where(value > 0, best, -1)
        direction = directions.gather(1, best[:, None, None].expand(-1, 1, 3))  # [V, 1, 3]
        weight = weight * (1 - 0.5 * (directions * direction).sum(dim=2).clamp_min(0))
        weight.scatter_(1, best[:, None], 0)
    return chosen


def _pyramid(image: Tensor, mask: Tensor | None, device: torch.device) -> list[Tensor]:
    """Reduce an image [H, W, 3 or 4] and its mask, bool [H, W], to `_View.levels`."""
    scale = 1 / 255 if image.dtype == torch.uint8 else 1.0
    image = image.to(device).to(torch.float32) * scale
    grey = image[..., :3].mean(dim=2)  # [H, W]
    valid = image.new_ones(image.shape[:2], dtype=torch.bool)  # [H, W]
    if image.shape[2] == 4:
        grey = grey * image[..., 3]
        valid = image[..., 3] >= 0.5
    if mask is not None:
        valid = valid & mask.to(device)
    # Grey values lie around 0, so that float32 loses little in their moments.
    level = torch.stack([torch.where(valid, grey - 0.5, 0.0), valid.to(grey)])[None]  # [1, 2, H, W]
    # The coarsest level's stride divides the sides, so that a level's pixels are exact quarters of the next one's.
    stride = 2 ** (LEVELS - 1)
    factor = min(1.0, WORKING_SIDE / max(level.shape[2:])) / stride
    size = [stride * max(round(side * factor), 1) for side in level.shape[2:]]
    if size != list(level.shape[2:]):
        level = _mean(F.interpolate(level, size, mode="bilinear", align_corners=False, antialias=True))
    levels = [level]
    for _ in range(LEVELS - 1):
        levels.append(_mean(F.avg_pool2d(levels[-1], 2)))
    return [level[0] for level in levels]


def _mean(sums: Tensor) -> Tensor:
    """Mean of valid grey values, from weighted sums of `_View.levels`; half of the weight is enough. [1, 2, h, w]"""
    valid = (sums[:, 1:] >= 0.5).to(sums)
    return torch.cat([sums[:, :1] / sums[:, 1:].clamp_min(0.5) * valid, valid], dim=1)


def _views(pyramids: list[list[Tensor]], viewmats: Tensor, Ks: Tensor, sizes: Tensor, points: Tensor) -> list[_View]:
    """Find neighbours and ranges of depth. Arguments as `choose_neighbours`; float64; only points on the device."""
    points = points[:: math.ceil(max(len(points), 1) / _POINTS)].to(torch.float64)
    placed = viewmats.to(points.device), Ks.to(points.device), sizes.to(points.device)
    neighbours = choose_neighbours(*placed, points).tolist()
    depths = depths_in_views(points, *placed)
    # No quantile is known of nothing.
    depths = F.pad(torch.where(depths.isfinite(), depths, torch.nan), (0, 1), value=torch.nan)
    ranges = depths.nanquantile(depths.new_tensor([0.005, 0.99]), dim=1).T.tolist()
    cameras = torch.eye(4, dtype=torch.float64).repeat(len(Ks), 1, 1)  # In a camera's axes → [−1, 1]². [V, 4, 4]
    cameras[:, :2, :3] = Ks[:, :2] * (2 / sizes[:, :, None])
    cameras[:, :2, 2] -= 1
    projections = cameras @ viewmats  # [V, 4, 4]
    inverses = projections.inverse()
    centres = viewmats.inverse()[:, :3, 3]
    views = []
    for v, levels in enumerate(pyramids):
        near = [n for n in neighbours[v] if n >= 0]
        to = projections[near] @ inverses[v]  # [N, 4, 4]
        back = projections[v] @ inverses[near]  # [N, 4, 4]
        to, back = (matrices[:, :3].to(points.device, torch.float32) for matrices in (to, back))
        inverse = 0.5 / ranges[v][1], 1.5 / ranges[v][0]  # Surfaces without points may lie nearer and farther.
        motions = Ks[near, 0, 0] * (centres[near] - centres[v]).norm(dim=1)  # px per inverse depth. [N]
        views.append(_View(levels, near, to, back, inverse, 1 / max(motions.tolist(), default=1.0)))
    return views


def _solve(view: _View, views: list[_View]) -> tuple[Tensor, Tensor]:
    """Inverse depth of a view, 0 where it is unknown, and its score. Each [h, w]"""
    if not view.neighbours:
        return torch.zeros_like(view.levels[0][0]), torch.zeros_like(view.levels[0][0])
    smallest, largest = view.inverse
    count = min(max(math.ceil((largest - smallest) / (view.step * 2 ** (LEVELS - 1))), 8), HYPOTHESES)
    step = (largest - smallest) / count
    hypotheses = smallest + step * torch.arange(count + 1, device=view.to.device)[:, None, None]  # [D, 1, 1]
    peak, score = _peak(_scores(view, views, LEVELS - 1, hypotheses))
    inverse = smallest + step * peak  # [h, w]
    around = torch.arange(-2, 3, device=view.to.device)[:, None, None]  # [5, 1, 1]
    for level in reversed(range(LEVELS - 1)):
        inverse = F.interpolate(inverse[None, None], scale_factor=2, mode="bilinear", align_corners=False)[0, 0]
        step /= 2  # Pixels are half as large, and the five hypotheses reach as far as the last step.
        peak, score = _peak(_scores(view, views, level, inverse + step * around))
        inverse = inverse + step * (peak - 2)
    known = (score > SCORES[0]) & (inverse > 0) & (view.levels[0][1] > 0)
    return torch.where(known, inverse, 0.0), score


def _scores(view: _View, views: list[_View], level: int, inverse: Tensor) -> Tensor:
    """Smoothed mean of the two best correlations with neighbours: a pixel may be hidden in the others.

    The inverse depths are those of each pixel [D, h, w], or of all [D, 1, 1]. The scores lie in [−1, 1]. [D, h, w]
    """
    pairs = zip(view.neighbours, view.to, strict=True)
    image = view.levels[level]
    best, *others = (_correlation(image, views[n].levels[level], matrix, inverse) for n, matrix in pairs)
    second = torch.full_like(best, -1.0)
    for score in others:
        second = torch.maximum(second, torch.minimum(best, score))
        best = torch.maximum(best, score)
    scores = torch.where(second > -1, 0.5 * (best + second), best)
    return F.avg_pool2d(scores, SMOOTHING, 1, SMOOTHING // 2, count_include_pad=False)


def _correlation(image: Tensor, neighbour: Tensor, matrix: Tensor, inverse: Tensor) -> Tensor:
    """NCC of the windows around pixels and around their places in a neighbour, over what is valid in both. [D, h, w]

    The arguments are a level of a view [2, h, w], the same level of its neighbour [2, H, W], `_View.to` [3, 4], and
    inverse depths [D, h, w] or [D, 1, 1]. If less than half a window is valid, it is −1, as for the worst match.
    """
    places = _project(matrix, *_pixels(image), inverse)[0].movedim(0, -1)  # [D, h, w, 2]
    sampled = F.grid_sample(neighbour.expand(len(places), -1, -1, -1), places, align_corners=False)  # [D, 2, h, w]
    value = image[0]
    other = sampled[:, 0]
    # The weight, both values and their products share two passes of the box filter.
    moments = sampled.new_empty((6, *other.shape))
    weight = torch.mul(image[1], sampled[:, 1] > 0.999, out=moments[0])
    torch.mul(weight, value, out=moments[1])
    torch.mul(weight, other, out=moments[2])
    torch.mul(moments[1], value, out=moments[3])
    torch.mul(moments[2], other, out=moments[4])
    torch.mul(moments[1], other, out=moments[5])
    moments = F.avg_pool2d(moments, (1, WINDOW), 1, (0, WINDOW // 2))
    weight, *moments = F.avg_pool2d(moments, (WINDOW, 1), 1, (WINDOW // 2, 0))
    mean, other_mean, square, other_square, product = (moment / weight for moment in moments)
    variance = torch.addcmul(square, mean, mean, value=-1).add_(NOISE**2)
    other_variance = torch.addcmul(other_square, other_mean, other_mean, value=-1).add_(NOISE**2)
    covariance = torch.addcmul(product, mean, other_mean, value=-1)
    return covariance.div_(variance.mul_(other_variance).sqrt_()).masked_fill_(weight <= 0.5, -1.0)


def _pixels(image: Tensor) -> tuple[Tensor, Tensor]:
    """Places of the pixels of a picture [..., h, w]: x [1, w] and y [h, 1]."""
    y, x = ((2 * torch.arange(side, device=image.device) + 1) / side - 1 for side in image.shape[-2:])
    return x[None], y[:, None]


def _project(matrix: Tensor, x: Tensor, y: Tensor, inverse: Tensor) -> tuple[Tensor, Tensor]:
    """Project points into another view by `_View.to` or `_View.back` [3, 4].

    Their places x and y broadcast to [h, w], and their inverse depths are [D, h, w] or [D, 1, 1]. The results are their
    places in the other view [2, D, h, w], and their depths there times their inverse depths here [D, h, w].
    """
    a, b, c, shift = matrix[:, :, None, None].unbind(1)  # Each [3, 1, 1]
    # No matrix product, since TF32 would round it to 10 bits.
    moved = torch.addcmul((a * x + b * y + c)[:, None], shift[:, None], inverse)  # [3, D, h, w]
    depth = moved[2].clamp_min(_TINY)
    return moved[:2] / depth, depth


def _peak(scores: Tensor) -> tuple[Tensor, Tensor]:
    """Index of the best score among [D, h, w], refined by the parabola through it and those beside; and the score."""
    score, index = scores.max(dim=0, keepdim=True)
    before = scores.gather(0, (index - 1).clamp_min(0))
    after = scores.gather(0, (index + 1).clamp_max(len(scores) - 1))
    offset = 0.5 * (after - before) / (2 * score - before - after).clamp_min(_TINY)
    offset = torch.where((index > 0) & (index < len(scores) - 1), offset, 0.0)
    return (index + offset)[0], score[0]


def _confidence(view: _View, inverse: Tensor, score: Tensor, others: list[Tensor]) -> Tensor:
    """Confidence in a view's inverse depths [h, w] by their score [h, w] and the neighbours' inverse depths. [h, w]"""
    x, y = _pixels(inverse)
    agreeing = torch.zeros_like(inverse)
    for to, back, other in zip(view.to, view.back, others, strict=True):
        places, depth = _project(to, x, y, inverse[None])  # [2, 1, h, w], [1, h, w]
        # The nearest pixel's depth is read, since a mean of two surfaces is none.
        found = F.grid_sample(other[None, None], places.movedim(0, -1), mode="nearest", align_corners=False)[0]
        returned, _ = _project(back, places[0, 0], places[1, 0], found)
        x_error = (returned[0] - x) * (0.5 * x.numel())  # px. [1, h, w]
        y_error = (returned[1] - y) * (0.5 * y.numel())  # px. [1, h, w]
        near = torch.hypot(x_error, y_error) < PIXEL_TOLERANCE
        agreeing += (near & ((found * depth / inverse - 1).abs() < DEPTH_TOLERANCE))[0]
    most = min(len(others), AGREEING)
    enough = (agreeing >= (2 if most > 2 else 1)) & (inverse > 0)
    confidence = ((score - SCORES[0]) / (SCORES[1] - SCORES[0])).clamp(0, 1) * (agreeing / max(most, 1)).clamp_max(1)
    return torch.where(enough, confidence, 0.0)
