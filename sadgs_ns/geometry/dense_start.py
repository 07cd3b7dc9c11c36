"""Points to start from, drawn from stereo depth as densely as the local wavelength asks for.

η asks for Gaussians no longer than the wavelength Λ, so for 1/Λ² of them on a surface. A pixel with a confident depth
is drawn with this weight. A point stays if enough views agree with its depth, and less often the more of them there
are, because each of them draws points of the same surface.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from sadgs_ns.geometry.stereo import DepthMap

NUMBER = 150_000
"""Most points that are drawn."""
MIN_CONFIDENCE = 0.5
"""Confidence of a depth from which its pixel is drawn."""
AGREEING_CONFIDENCE = 0.1
"""Confidence from which a depth counts when views are asked whether they agree."""
AGREEING_VIEWS = 2
"""Views, its own among them, that must agree with a point's depth."""
DEPTH_TOLERANCE = 0.02
"""Largest relative difference of depths that agree."""
SCALE = 0.5
"""Largest standard deviation of a point, in wavelengths: its η is 1/2."""
_DRAWN = 4
"""Points that are drawn for each one that is wanted, because many do not stay."""


class DensePoints(NamedTuple):
    """N points on surfaces."""

    means: Tensor  # World units. [N, 3]
    colors: Tensor  # Mean over the views that agree, in [0, 1]. [N, 3]
    scales: Tensor  # Half a wavelength, but at least half a pixel of the depth map, in world units. [N]


@torch.no_grad()
def dense_points(
    maps: Sequence[DepthMap],
    viewmats: Tensor,
    image: Callable[[int], Tensor],
    wavelength: Callable[[int], Tensor],
    number: int = NUMBER,
    seed: int = 0,
) -> DensePoints:
    """Draw at most `number` points from the depth maps of views, in random order; none if no depth is confident.

    The same arguments give the same points, whatever the state of torch's generators.

    Args:
        maps: Of the views, on one device.
        viewmats: World to camera. [V, 4, 4]
        image: Returns the image of a view in [0, 1], of any size. [H, W, 3]
        wavelength: Returns Λ of a view's image in px of that image; NaN where it is unknown. [H, W]
        number: Most points, > 0.
        seed: Of the random numbers.
    """
    device = maps[0].depth.device
    viewmats = viewmats.to(device)
    generator = torch.Generator(device).manual_seed(seed)
    views = list(zip(maps, viewmats, strict=True))
    candidates = [_candidates(depths, viewmat, wavelength(i)) for i, (depths, viewmat) in enumerate(views)]
    means, weights, scales = (torch.cat(values) for values in zip(*candidates, strict=True))
    drawn = _draw(weights, min(len(means), _DRAWN * number), generator)
    means = means[drawn]
    scales = scales[drawn]
    agreeing = torch.zeros(len(means), device=device)  # Number of views that agree with each point. [Q]
    colors = torch.zeros_like(means)  # Sum of these views' colours. [Q, 3]
    for i, (depths, viewmat) in enumerate(views):
        places, agrees = _compare(means, viewmat, depths)
        colors += torch.where(agrees[:, None], _read(image(i), places), 0.0)
        agreeing += agrees
    chance = torch.rand(len(means), generator=generator, device=device)
    enough = agreeing >= AGREEING_VIEWS
    # Every view that agrees draws points of the same surface.
    share = AGREEING_VIEWS / agreeing.clamp_min(1)
    stays = enough & (chance < share)
    chosen = stays.nonzero()[:, 0]
    order = torch.randperm(len(chosen), generator=generator, device=device)
    chosen = chosen[order[:number]]
    mean_colors = colors[chosen] / agreeing[chosen, None]
    return DensePoints(means[chosen], mean_colors, scales[chosen])


def _draw(
    weights: Tensor,  # [Q], > 0
    number: int,
    generator: torch.Generator,
) -> Tensor:
    """Draw without replacement, with these weights: the largest of log weight plus Gumbel noise. int64 [number]"""
    noise = torch.rand(len(weights), generator=generator, device=weights.device)
    noise = noise.clamp(1e-12, 1 - 1e-7)
    keys = weights.log() - (-noise.log()).log()
    return keys.topk(number).indices


def _candidates(
    depths: DepthMap,
    viewmat: Tensor,  # [4, 4]
    wavelength: Tensor,  # in px of the image [H, W]
) -> tuple[Tensor, Tensor, Tensor]:
    """Points of a view's confident pixels [Q, 3], their weights [Q], and half their wavelengths in world units [Q]."""
    is_confident = depths.confidence >= MIN_CONFIDENCE
    rows, columns = is_confident.nonzero(as_tuple=True)
    height, width = depths.depth.shape
    pixels = torch.stack([columns, rows], dim=1) + 0.5  # [Q, 2]
    places = pixels / pixels.new_tensor([width, height])
    in_image = _read(wavelength.to(pixels)[..., None], places)[:, 0]
    reduced = width / wavelength.shape[1]
    local = reduced * in_image  # Λ in px of the depth map. [Q]
    known = local.isfinite()
    local = local[known].clamp_min(1.0)
    depth = depths.depth[rows, columns][known]
    focal = depths.K.diagonal()[:2]
    centre = depths.K[:2, 2]
    from_centre = pixels[known] - centre
    rays = from_centre / focal
    in_camera = torch.cat([rays * depth[:, None], depth[:, None]], dim=1)
    means = (in_camera - viewmat[:3, 3]) @ viewmat[:3, :3]
    scales = SCALE * local * depth / depths.K[0, 0]
    return means, local**-2, scales


def _compare(
    points: Tensor,  # [Q, 3]
    viewmat: Tensor,  # [4, 4]
    depths: DepthMap,
) -> tuple[Tensor, Tensor]:
    """Find where points lie in a view, and whether its depths there agree with theirs.

    Returns:
        Their places as shares of the view's width and height [Q, 2], and whether they agree, bool [Q].
    """
    depth, places = _project(points, viewmat, depths)
    in_image = places >= 0
    in_image &= places < 1
    inside = (depth > 0) & in_image.all(dim=1)
    known = _read(depths.depth[..., None], places)[:, 0]
    confidence = _read(depths.confidence[..., None], places)[:, 0]
    difference = known - depth
    is_confident = confidence >= AGREEING_CONFIDENCE
    is_as_deep = difference.abs() < DEPTH_TOLERANCE * depth
    agrees = inside & is_confident & is_as_deep
    return places, agrees


def _project(points: Tensor, viewmat: Tensor, depths: DepthMap) -> tuple[Tensor, Tensor]:
    """Return the depths of points [Q, 3] in a view [Q], and their places as shares of its width and height [Q, 2]."""
    in_camera = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    depth = in_camera[:, 2]
    height, width = depths.depth.shape
    focal = depths.K.diagonal()[:2]
    centre = depths.K[:2, 2]
    pixels = in_camera[:, :2] / depth[:, None] * focal + centre
    return depth, pixels / points.new_tensor([width, height])


def _read(
    values: Tensor,  # [H, W, D]
    places: Tensor,  # shares of width and height [Q, 2]
) -> Tensor:
    """Return the value of the pixel at each place; outside the picture, that of the nearest border pixel. [Q, D]"""
    height, width = values.shape[:2]
    pixels = places * places.new_tensor([width, height])
    pixels = pixels.nan_to_num(0.0).clamp(-1, 1e6).long()  # Larger numbers would overflow integers.
    columns, rows = pixels.unbind(1)
    rows = rows.clamp(0, height - 1)
    columns = columns.clamp(0, width - 1)
    return values[rows, columns]
