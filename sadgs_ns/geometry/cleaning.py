"""Find Gaussians that a finished model can do without: those that few views see, giants, dust, those outside a box."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from sadgs_ns.render.rasterization import rasterize
from sadgs_ns.render.types import DEFAULTS, Cameras, Gaussians, RenderOptions

_SEEN = 1 / 255
"""A view sees a Gaussian that makes up at least this part of a pixel, the least that is drawn."""


@dataclass(frozen=True)
class Cleaning:
    """Which Gaussians are taken away; by default none."""

    min_views: int = 0
    """Take away Gaussians that fewer training views see; 0 takes none."""
    max_extent: float | None = None
    """Take away Gaussians whose longest standard deviation is more than this, in world units, > 0; None takes none."""
    crop: tuple[float, ...] | None = None
    """Take away Gaussians whose centre is outside this box: lowest x, y and z, then highest, in world units."""
    dust: float = 0.0
    """Take away Gaussians that make up less than this, in px, of the image of every training view; 0 takes none."""

    @property
    def needs_views(self) -> bool:
        """Whether `choose_remaining` needs the `Visibility` of the Gaussians."""
        return self.min_views > 0 or self.dust > 0


@dataclass(frozen=True)
class Visibility:
    """How much of N Gaussians the training views see."""

    views: Tensor  # Number of views that see each. int64 [N]
    pixels: Tensor  # Pixels that each makes up in the view where it makes up most. [N]
    total: int  # Number of views


def measure_visibility(
    params: Mapping[str, Tensor], cameras: Iterable[tuple[Tensor, Tensor, int, int]], drawing: RenderOptions = DEFAULTS
) -> Visibility:
    """Measure how many pixels Gaussians make up in training views: opacity × area, less the part that others hide.

    Args:
        params: `means`, `quats`, log `scales`, logit `opacities`.
        cameras: World-to-camera matrix [4, 4], intrinsics in px [3, 3], width and height in px of each view.
        drawing: How Gaussians are drawn; their colours do not matter.
    """
    gaussians = _drawable_gaussians(params)
    views = torch.zeros_like(gaussians.opacities, dtype=torch.int64)
    pixels = torch.zeros_like(gaussians.opacities)
    number = 0
    for viewmat, K, width, height in cameras:
        camera = Cameras(viewmat[None], K[None], width, height)
        weights = _drawn_pixels(gaussians, camera, drawing)
        views += weights >= _SEEN
        pixels = torch.maximum(pixels, weights)
        number += 1
    return Visibility(views, pixels, number)


def _drawable_gaussians(params: Mapping[str, Tensor]) -> Gaussians:
    """Return N white Gaussians; those with a value that is not finite, which cannot be drawn, have an opacity of 0."""
    means = params["means"].detach()
    quats = params["quats"].detach()
    log_scales = params["scales"].detach()
    opacities = params["opacities"].detach().flatten().sigmoid()
    values = torch.cat([means, quats, log_scales, opacities[:, None]], dim=1)
    sound = values.isfinite().all(dim=1)  # [N]
    means = torch.where(sound[:, None], means, 0.0)
    quats = torch.where(sound[:, None], quats, 0.0)
    log_scales = torch.where(sound[:, None], log_scales, 0.0)
    opacities = torch.where(sound, opacities, 0.0)
    return Gaussians(means, quats, log_scales.exp(), opacities, torch.ones_like(means))


def _drawn_pixels(gaussians: Gaussians, camera: Cameras, drawing: RenderOptions) -> Tensor:
    """Measure how many pixels each of N Gaussians makes up in the image of one camera. [N]

    An image is a sum of colours times weights, so its derivative by a colour is the weight.
    """
    with torch.enable_grad():
        colors = torch.ones_like(gaussians.means, requires_grad=True)
        image, _, _ = rasterize(gaussians._replace(colors=colors), camera, drawing)
        (weights,) = torch.autograd.grad(image.sum(), colors)
    return weights[:, 0]


@dataclass(frozen=True)
class Remaining:
    """The Gaussians that a cleaning leaves of N."""

    stays: Tensor  # Which Gaussians stay. bool [N]
    num_removed: dict[str, int]
    """How many Gaussians each option that is set takes away, by the names of `Cleaning`'s fields.

    A Gaussian counts for the first option that takes it away.
    """
    num_views: int  # Number of training views that were asked; 0 if none had to be


@torch.no_grad()
def choose_remaining(params: Mapping[str, Tensor], cleaning: Cleaning, seen: Visibility | None = None) -> Remaining:
    """Find which Gaussians stay, one option of the cleaning after the other.

    Args:
        params: `means` and log `scales`.
        cleaning: What is taken away.
        seen: What training views see of the Gaussians. It is needed if `cleaning.needs_views`.
    """
    means = params["means"].detach()
    extents = params["scales"].detach().amax(dim=1).exp()  # Longest standard deviations. [N]
    goes: dict[str, Tensor] = {}  # What each option would take of all Gaussians, in the order of the options
    if cleaning.crop is not None:
        low, high = means.new_tensor(cleaning.crop).view(2, 3)
        is_inside = means >= low  # [N, 3]
        is_inside &= means <= high
        goes["crop"] = ~is_inside.all(dim=1)
    if cleaning.max_extent is not None:
        goes["max_extent"] = extents > cleaning.max_extent
    num_views = 0
    if cleaning.needs_views:
        assert seen is not None
        num_views = seen.total
        if cleaning.min_views > 0:
            goes["min_views"] = seen.views < cleaning.min_views
        if cleaning.dust > 0:
            goes["dust"] = seen.pixels < cleaning.dust
    stays = torch.ones(len(means), dtype=torch.bool, device=means.device)
    num_removed = {}
    for option, taken in goes.items():
        num_removed[option] = int((stays & taken).sum())
        stays &= ~taken
    return Remaining(stays, num_removed, num_views)
