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

NUMBER = 150_000  # Most points that are drawn
MIN_CONFIDENCE = 0.5  # Confidence of a depth from which its pixel is drawn
AGREEING_CONFIDENCE = 0.1  # Confidence from which a depth counts when views are asked whether they agree
AGREEING_VIEWS = 2  # Views, its own among them, that must agree with a point's depth
DEPTH_TOLERANCE = 0.02  # Largest relative difference of depths that agree
SCALE = 0.5  # Largest standard deviation of a point, in wavelengths: its η is 1/2
_DRAWN = 4  # Points that are drawn for each one that is wanted, because many do not stay


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
    """
    device = maps[0].depth.device
    viewmats = viewmats.to(device)
    generator = torch.Generator(device).manual_seed(seed)
    views = list(zip(maps, viewmats, strict=True))
    candidates = [_candidates(*view, wavelength(i)) for i, view in enumerate(views)]
    means, weights, scales = (torch.cat(values) for values in zip(*candidates, strict=True))
    # The largest of log weight plus Gumbel noise are a draw without replacement.
    noise = torch.rand(len(means), generator=generator, device=device).clamp(1e-12, 1 - 1e-7)
    keys = weights.log() - (-noise.log()).log()
    drawn = keys.topk(min(len(means), _DRAWN * number)).indices
    means = means[drawn]
    scales = scales[drawn]
    agreeing = torch.zeros(len(means), device=device)
    colors = torch.zeros_like(means)
    for i, (m, viewmat) in enumerate(views):
        depths, places = _places(means, viewmat, m)  # [Q], [Q, 2]
        inside = (depths > 0) & ((places >= 0) & (places < 1)).all(dim=1)
        known = _read(m.depth[..., None], places)[:, 0]
        agrees = inside & (_read(m.confidence[..., None], places)[:, 0] >= AGREEING_CONFIDENCE)
        agrees &= (known - depths).abs() < DEPTH_TOLERANCE * depths
        colors += torch.where(agrees[:, None], _read(image(i), places), 0.0)
        agreeing += agrees
    chance = torch.rand(len(means), generator=generator, device=device)
    stays = (agreeing >= AGREEING_VIEWS) & (chance < AGREEING_VIEWS / agreeing.clamp_min(1))
    chosen = stays.nonzero()[:, 0]
    chosen = chosen[torch.randperm(len(chosen), generator=generator, device=device)[:number]]
    return DensePoints(means[chosen], colors[chosen] / agreeing[chosen, None], scales[chosen])


def _candidates(depths: DepthMap, viewmat: Tensor, wavelength: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Points of a view's confident pixels [Q, 3], their weights [Q], and half their wavelengths in world units [Q]."""
    rows, columns = (depths.confidence >= MIN_CONFIDENCE).nonzero(as_tuple=True)
    height, width = depths.depth.shape
    pixels = torch.stack([columns, rows], dim=1) + 0.5  # [Q, 2]
    size = pixels.new_tensor([width, height])
    reduced = width / wavelength.shape[1]
    local = reduced * _read(wavelength.to(pixels)[..., None], pixels / size)[:, 0]  # Λ in px of the depth map
    known = local.isfinite()
    local = local[known].clamp_min(1.0)
    depth = depths.depth[rows, columns][known]
    rays = (pixels[known] - depths.K[:2, 2]) / depths.K.diagonal()[:2]
    in_camera = torch.cat([rays * depth[:, None], depth[:, None]], dim=1)
    return (in_camera - viewmat[:3, 3]) @ viewmat[:3, :3], local**-2, SCALE * local * depth / depths.K[0, 0]


def _places(points: Tensor, viewmat: Tensor, depths: DepthMap) -> tuple[Tensor, Tensor]:
    """Depths of points [Q, 3] in a view [Q], and their places as shares of its width and height [Q, 2]."""
    in_camera = points @ viewmat[:3, :3].T + viewmat[:3, 3]
    depth = in_camera[:, 2]
    size = points.new_tensor([depths.depth.shape[1], depths.depth.shape[0]])
    pixels = in_camera[:, :2] / depth[:, None] * depths.K.diagonal()[:2] + depths.K[:2, 2]
    return depth, pixels / size


def _read(values: Tensor, places: Tensor) -> Tensor:
    """The values [H, W, D] of the pixels at places given as shares of width and height [Q, 2]. [Q, D]"""
    height, width = values.shape[:2]
    columns, rows = (places * places.new_tensor([width, height])).nan_to_num(0.0).clamp(-1, 1e6).long().unbind(1)
    return values[rows.clamp(0, height - 1), columns.clamp(0, width - 1)]
