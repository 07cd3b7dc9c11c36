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

from sadgs_ns.geometry.rigid import camera_centres
from sadgs_ns.geometry.stereo_neighbours import choose_neighbours
from sadgs_ns.geometry.view_depths import depths_in_views

WORKING_SIDE = 800
"""Longest side in px at which depth is computed; larger images are reduced: time grows with the area."""
LEVELS = 3
"""Levels of the image pyramid. Each has half the sides of the one before."""
WINDOW = 5
"""Side in px, odd, of the windows that are compared."""
SMOOTHING = 5
"""Side in px, odd, of the box over which scores are averaged; plain pixels follow their neighbours."""
HYPOTHESES = 128
"""Most intervals of inverse depth on the coarsest level. Time and memory grow with them."""
NOISE = 0.004
"""Standard deviation of grey values in [0, 1], a step of 8 bits, below which the correlation fades to 0."""
SCORES = (0.5, 0.8)
"""Correlations at which confidence begins and is full. Lower ones add few pixels."""
AGREEING = 3
"""Neighbours that agree with a depth of full confidence, or all if there are fewer."""
DEPTH_TOLERANCE = 0.01
"""Largest relative difference between two views' depths that agree."""
PIXEL_TOLERANCE = 1.0
"""Depths agree if a pixel's own takes it to a neighbour, and the neighbour's takes it back to within this many px."""

_POINTS = 2000
"""Most SfM points that are used. Neighbours and ranges are sums and quantiles, which need no more."""
_TINY = 1e-6
"""Keeps quotients finite. A point behind a camera is projected far outside its picture."""


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
    to_neighbours: Tensor
    """(x, y, 1, inverse depth) → homogeneous place in each neighbour, as `_project` uses it. [N, 3, 4]"""
    from_neighbours: Tensor  # The same from each neighbour to this view. [N, 3, 4]
    inverse_depths: tuple[float, float]  # The smallest and the largest that are tried
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
    num_views = len(viewmats)
    device = torch.device(device)
    if masks is None:
        masks = [None] * num_views
    # In float64, since positions may be far from the origin, and on the host, which needs the numbers.
    viewmats = viewmats.to("cpu", torch.float64)
    Ks = Ks.to("cpu", torch.float64, copy=True)
    pyramids = []
    sizes = torch.zeros((num_views, 2), dtype=torch.float64)  # Widths and heights at working size
    for v in range(num_views):
        image = images(v)
        height, width = image.shape[:2]
        pyramid = _pyramid(image, masks[v], device)
        pyramids.append(pyramid)
        sizes[v] = torch.tensor(pyramid[0].shape[:0:-1])
        reduction = sizes[v] / torch.tensor([width, height])
        Ks[v, :2] *= reduction[:, None]
    views = _views(pyramids, viewmats, Ks, sizes, points.to(device))
    solved = [_solve(view, views) for view in views]
    maps = []
    for view, K, (inverse, score) in zip(views, Ks.to(device, torch.float32), solved, strict=True):
        of_neighbours = [solved[n][0] for n in view.neighbours]
        confidence = _confidence(view, inverse, score, of_neighbours)
        depth = torch.where(confidence > 0, 1 / inverse, 0.0)
        maps.append(DepthMap(depth, confidence, K))
    return maps


# --- preparing the views ---


def _pyramid(
    image: Tensor,  # [H, W, 3 or 4]
    mask: Tensor | None,  # bool [H, W]
    device: torch.device,
) -> list[Tensor]:
    """Reduce an image and its mask to `_View.levels`."""
    level = _grey_and_valid(image, mask, device)
    size = _working_size(level.shape[2:])
    if size != list(level.shape[2:]):
        resized = F.interpolate(level, size, mode="bilinear", align_corners=False, antialias=True)
        level = _mean(resized)
    levels = [level]
    for _ in range(LEVELS - 1):
        halved = F.avg_pool2d(levels[-1], 2)
        levels.append(_mean(halved))
    return [level[0] for level in levels]


def _grey_and_valid(image: Tensor, mask: Tensor | None, device: torch.device) -> Tensor:
    """Return grey values and 1 where they are valid, as in `_View.levels`, at full size. [1, 2, H, W]"""
    scale = 1.0
    if image.dtype == torch.uint8:
        scale = 1 / 255
    image = image.to(device).to(torch.float32) * scale
    grey = image[..., :3].mean(dim=2)  # [H, W]
    valid = image.new_ones(image.shape[:2], dtype=torch.bool)
    if image.shape[2] == 4:
        alpha = image[..., 3]
        grey = grey * alpha
        valid = alpha >= 0.5
    if mask is not None:
        valid = valid & mask.to(device)
    # Grey values lie around 0, so that float32 loses little in their moments.
    around_0 = torch.where(valid, grey - 0.5, 0.0)
    return torch.stack([around_0, valid.to(grey)])[None]


def _working_size(size: Sequence[int]) -> list[int]:
    """Height and width at which depth is computed, given those of an image.

    The coarsest level's stride divides them, so that a level's pixels are exact quarters of the next one's.
    """
    stride = 2 ** (LEVELS - 1)
    reduction = WORKING_SIDE / max(size)
    reduction = min(1.0, reduction)
    factor = reduction / stride  # Sides of the coarsest level, relative to the image's
    return [stride * max(round(side * factor), 1) for side in size]


def _mean(
    sums: Tensor,  # [1, 2, h, w]
) -> Tensor:
    """Mean of valid grey values, from weighted sums of `_View.levels`; half of the weight is enough. [1, 2, h, w]"""
    grey = sums[:, :1]
    weight = sums[:, 1:]
    is_valid = weight >= 0.5
    valid = is_valid.to(sums)
    divisor = weight.clamp_min(0.5)
    mean = grey / divisor * valid
    return torch.cat([mean, valid], dim=1)


def _views(pyramids: list[list[Tensor]], viewmats: Tensor, Ks: Tensor, sizes: Tensor, points: Tensor) -> list[_View]:
    """Find the neighbours of each view and its range of depths, given the arguments of `choose_neighbours`.

    The cameras are float64 on the host. The points tell by their device where the matrices of the results lie.
    """
    device = points.device
    point_step = math.ceil(max(len(points), 1) / _POINTS)
    points = points[::point_step].to(torch.float64)
    cameras = (viewmats.to(device), Ks.to(device), sizes.to(device))
    neighbours = choose_neighbours(*cameras, points).tolist()
    depth_ranges = _depth_ranges(depths_in_views(points, *cameras))
    projections = _projections(viewmats, Ks, sizes)
    inverses = projections.inverse()
    centres = camera_centres(viewmats)  # [V, 3]
    views = []
    for v, levels in enumerate(pyramids):
        chosen = [n for n in neighbours[v] if n >= 0]
        to_neighbours = projections[chosen] @ inverses[v]  # [N, 4, 4]
        from_neighbours = projections[v] @ inverses[chosen]
        to_neighbours = to_neighbours[:, :3].to(device, torch.float32)
        from_neighbours = from_neighbours[:, :3].to(device, torch.float32)
        nearest, farthest = depth_ranges[v]
        inverse_depths = (0.5 / farthest, 1.5 / nearest)  # Surfaces without points may lie nearer and farther.
        baselines = (centres[chosen] - centres[v]).norm(dim=1)
        motions = Ks[chosen, 0, 0] * baselines  # px per inverse depth. [N]
        step = 1 / max(motions.tolist(), default=1.0)
        views.append(_View(levels, chosen, to_neighbours, from_neighbours, inverse_depths, step))
    return views


def _depth_ranges(
    depths: Tensor,  # infinite outside the images [V, P]
) -> list[list[float]]:
    """Depths of the nearest and farthest points of each view, without the outermost; NaN if it sees none. [V][2]"""
    known = torch.where(depths.isfinite(), depths, torch.nan)
    # torch raises an error for the quantile of no points.
    known = F.pad(known, (0, 1), value=torch.nan)
    shares = depths.new_tensor([0.005, 0.99])
    return known.nanquantile(shares, dim=1).T.tolist()


def _projections(viewmats: Tensor, Ks: Tensor, sizes: Tensor) -> Tensor:
    """Matrices from world space to homogeneous places in pictures that span [−1, 1]². float64 [V, 4, 4]"""
    cameras = torch.eye(4, dtype=torch.float64).repeat(len(Ks), 1, 1)  # In a camera's axes → [−1, 1]². [V, 4, 4]
    cameras[:, :2, :3] = Ks[:, :2] * (2 / sizes[:, :, None])
    cameras[:, :2, 2] -= 1
    return cameras @ viewmats


# --- the sweep ---


def _solve(view: _View, views: list[_View]) -> tuple[Tensor, Tensor]:
    """Inverse depth of a view, 0 where it is unknown, and its score. Each [h, w]"""
    finest_valid = view.levels[0][1]
    if not view.neighbours:
        return torch.zeros_like(finest_valid), torch.zeros_like(finest_valid)
    device = view.to_neighbours.device
    smallest, largest = view.inverse_depths
    # A step moves a pixel of the coarsest level by about 1 px.
    wanted = math.ceil((largest - smallest) / (view.step * 2 ** (LEVELS - 1)))
    count = max(wanted, 8)
    count = min(count, HYPOTHESES)
    step = (largest - smallest) / count
    numbers = torch.arange(count + 1, device=device)[:, None, None]  # [D, 1, 1]
    peak, score = _peak(_scores(view, views, LEVELS - 1, smallest + step * numbers))
    inverse = smallest + step * peak  # [h, w]
    around = torch.arange(-2, 3, device=device)[:, None, None]  # [5, 1, 1]
    for level in reversed(range(LEVELS - 1)):
        enlarged = F.interpolate(inverse[None, None], scale_factor=2, mode="bilinear", align_corners=False)
        inverse = enlarged[0, 0]
        step /= 2  # Pixels are half as large, and the five hypotheses reach as far as the last step.
        peak, score = _peak(_scores(view, views, level, inverse + step * around))
        correction = step * (peak - 2)
        inverse = inverse + correction
    known = score > SCORES[0]
    known &= inverse > 0
    known &= finest_valid > 0
    return torch.where(known, inverse, 0.0), score


def _scores(
    view: _View,
    views: list[_View],
    level: int,
    inverse: Tensor,  # inverse depths of each pixel [D, h, w], or of all [D, 1, 1]
) -> Tensor:
    """Smoothed mean of the two best correlations with neighbours, in [−1, 1]. [D, h, w]

    Only two count, because a pixel may be hidden in the others.
    """
    image = view.levels[level]
    correlations = []
    for n, matrix in zip(view.neighbours, view.to_neighbours, strict=True):
        correlations.append(_correlation(image, views[n].levels[level], matrix, inverse))
    best = correlations[0]
    second = torch.full_like(best, -1.0)
    for score in correlations[1:]:
        second = torch.maximum(second, torch.minimum(best, score))
        best = torch.maximum(best, score)
    scores = torch.where(second > -1, 0.5 * (best + second), best)
    return F.avg_pool2d(scores, SMOOTHING, 1, SMOOTHING // 2, count_include_pad=False)


def _correlation(
    image: Tensor,  # a level of a view [2, h, w]
    neighbour: Tensor,  # the same level of its neighbour [2, H, W]
    matrix: Tensor,  # of `_View.to_neighbours` [3, 4]
    inverse: Tensor,  # inverse depths [D, h, w] or [D, 1, 1]
) -> Tensor:
    """NCC of the windows around pixels and around their places in a neighbour, over what is valid in both. [D, h, w]

    If less than half a window is valid, it is −1, as for the worst match.
    """
    x, y = _pixels(image)
    places = _project(matrix, x, y, inverse)[0]  # Memory for the depths, which are large, is free again.
    grid = places.movedim(0, -1)  # [D, h, w, 2]
    sampled = F.grid_sample(neighbour.expand(len(grid), -1, -1, -1), grid, align_corners=False)  # [D, 2, h, w]
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
    deviations = variance.mul_(other_variance).sqrt_()
    return covariance.div_(deviations).masked_fill_(weight <= 0.5, -1.0)


def _pixels(
    image: Tensor,  # [..., h, w]
) -> tuple[Tensor, Tensor]:
    """Places of the pixels of a picture: x [1, w] and y [h, 1], in [−1, 1]."""
    height, width = image.shape[-2:]
    x = (2 * torch.arange(width, device=image.device) + 1) / width - 1
    y = (2 * torch.arange(height, device=image.device) + 1) / height - 1
    return x[None], y[:, None]


def _project(matrix: Tensor, x: Tensor, y: Tensor, inverse: Tensor) -> tuple[Tensor, Tensor]:
    """Project points into another view by a matrix of `_View.to_neighbours` or `from_neighbours` [3, 4].

    Their places x and y broadcast to [h, w], and their inverse depths are [D, h, w] or [D, 1, 1]. The results are their
    places in the other view [2, D, h, w], and their depths there times their inverse depths here [D, h, w].
    """
    a, b, c, shift = matrix[:, :, None, None].unbind(1)  # Each [3, 1, 1]
    # No matrix product, since TF32 would round it to 10 bits.
    at_infinity = a * x + b * y + c  # [3, h, w]
    moved = torch.addcmul(at_infinity[:, None], shift[:, None], inverse)  # [3, D, h, w]
    depth = moved[2].clamp_min(_TINY)
    return moved[:2] / depth, depth


def _peak(
    scores: Tensor,  # [D, h, w]
) -> tuple[Tensor, Tensor]:
    """Index of the best score, refined by the parabola through it and those beside; and the score. Each [h, w]"""
    last = len(scores) - 1
    score, index = scores.max(dim=0, keepdim=True)
    before = scores.gather(0, (index - 1).clamp_min(0))
    after = scores.gather(0, (index + 1).clamp_max(last))
    curvature = (2 * score - before - after).clamp_min(_TINY)
    slope = 0.5 * (after - before)
    offset = slope / curvature
    is_inside = index > 0
    is_inside &= index < last
    offset = torch.where(is_inside, offset, 0.0)
    return (index + offset)[0], score[0]


# --- what is trusted ---


def _confidence(
    view: _View,
    inverse: Tensor,  # the view's inverse depths [h, w]
    score: Tensor,  # [h, w]
    others: list[Tensor],  # the neighbours' inverse depths [h, w]
) -> Tensor:
    """Confidence in a view's inverse depths, in [0, 1]: by their score, and by how many neighbours agree. [h, w]"""
    agreeing = torch.zeros_like(inverse)
    for to, back, other in zip(view.to_neighbours, view.from_neighbours, others, strict=True):
        agreeing += _agrees(inverse, other, to, back)
    num_neighbours = len(others)
    most = min(num_neighbours, AGREEING)
    needed = 1
    if most > 2:
        needed = 2
    enough = agreeing >= needed
    enough &= inverse > 0
    low, high = SCORES
    by_score = ((score - low) / (high - low)).clamp(0, 1)
    by_neighbours = agreeing / max(most, 1)
    by_neighbours = by_neighbours.clamp_max(1)
    confidence = by_score * by_neighbours
    return torch.where(enough, confidence, 0.0)


def _agrees(
    inverse: Tensor,  # inverse depths of a view [h, w]
    other: Tensor,  # inverse depths of its neighbour [H, W]
    to: Tensor,  # [3, 4]
    back: Tensor,  # [3, 4]
) -> Tensor:
    """Tell for each pixel of a view whether a neighbour's depth agrees with its own. bool [h, w]"""
    x, y = _pixels(inverse)
    places, depth = _project(to, x, y, inverse[None])  # [2, 1, h, w], [1, h, w]
    # The nearest pixel's depth is read, since a mean of two surfaces is none.
    grid = places.movedim(0, -1)
    found = F.grid_sample(other[None, None], grid, mode="nearest", align_corners=False)[0]  # [1, h, w]
    returned, _ = _project(back, places[0, 0], places[1, 0], found)
    x_error = (returned[0] - x) * (0.5 * x.numel())  # px. [1, h, w]
    y_error = (returned[1] - y) * (0.5 * y.numel())
    returns = torch.hypot(x_error, y_error) < PIXEL_TOLERANCE
    is_as_deep = (found * depth / inverse - 1).abs() < DEPTH_TOLERANCE
    return (returns & is_as_deep)[0]
