"""Find Gaussians that a finished model can do without: those that few views see, giants, dust, those outside a box."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from sadgs_ns.errors import InputError
from sadgs_ns.render.rasterization import rasterize
from sadgs_ns.render.types import DEFAULTS, Cameras, Gaussians, RenderOptions

_SEEN = 1 / 255  # A view sees a Gaussian that makes up at least this part of a pixel, the least that is drawn


@dataclass(frozen=True)
class Cleaning:
    """Which Gaussians are taken away; by default none."""

    min_views: int = 0  # Take away Gaussians that fewer training views see; 0 takes none
    max_extent: float | None = None
    """Take away Gaussians whose longest standard deviation is more than this, in world units; None takes none."""
    crop: tuple[float, ...] | None = None
    """Take away Gaussians whose centre is outside this box: lowest x, y and z, then highest, in world units."""
    dust: float = 0.0
    """Take away Gaussians that make up less than this, in pixels, of the image of every training view; 0 takes none."""

    def __post_init__(self) -> None:
        """Raise InputError if a number is negative or not finite, an extent is 0, or the box's corners are reversed."""
        for name, value in (("--min-views", self.min_views), ("--dust", self.dust)):
            if not 0 <= value < math.inf:
                raise InputError(f"{name} {value:g} must be 0, which takes nothing away, or more.")
        if self.max_extent is not None and not 0 < self.max_extent < math.inf:
            raise InputError(
                f"--max-extent {self.max_extent:g} must be more than 0: leave it out to take nothing away."
            )
        if self.crop is not None and not all(
            -math.inf < low < high < math.inf for low, high in zip(self.crop[:3], self.crop[3:], strict=True)
        ):
            box = " ".join(f"{value:g}" for value in self.crop)
            raise InputError(f"--crop {box} is no box: give the lowest x, y and z, then the highest x, y and z.")

    @property
    def needs_views(self) -> bool:
        """Whether `find_remaining` needs the `Visibility` of the Gaussians."""
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
    shapes = [params[name].detach() for name in ("means", "quats", "scales")]
    opacities = params["opacities"].detach().flatten().sigmoid()
    sound = torch.cat([*shapes, opacities[:, None]], dim=1).isfinite().all(dim=1)  # Others cannot be drawn.
    means, quats, scales = (torch.where(sound[:, None], value, 0.0) for value in shapes)
    scales = scales.exp()
    opacities = torch.where(sound, opacities, 0.0)
    views = means.new_zeros(len(means), dtype=torch.int64)
    pixels = means.new_zeros(len(means))
    number = 0
    for viewmat, K, width, height in cameras:
        with torch.enable_grad():
            # An image is a sum of colours times weights, so its derivative by a colour is the weight.
            colors = torch.ones_like(means, requires_grad=True)
            gaussians = Gaussians(means, quats, scales, opacities, colors)
            image, _, _ = rasterize(gaussians, Cameras(viewmat[None], K[None], width, height), drawing)
            (weights,) = torch.autograd.grad(image.sum(), colors)
        views += weights[:, 0] >= _SEEN
        pixels = torch.maximum(pixels, weights[:, 0])
        number += 1
    return Visibility(views, pixels, number)


@torch.no_grad()
def find_remaining(
    params: Mapping[str, Tensor], cleaning: Cleaning, seen: Visibility | None = None
) -> tuple[Tensor, list[str]]:
    """Find which Gaussians stay. `seen` is needed if `cleaning.needs_views`.

    Returns:
        Which stay, bool [N]; and for each option that is set a sentence, with how many it takes of what is left.
    """
    means = params["means"].detach()
    extents = params["scales"].detach().amax(dim=1).exp()
    goes: list[tuple[Tensor, str]] = []
    if cleaning.crop is not None:
        low, high = means.new_tensor(cleaning.crop).view(2, 3)
        goes.append((~((means >= low) & (means <= high)).all(dim=1), "outside the box"))
    if cleaning.max_extent is not None:
        goes.append((extents > cleaning.max_extent, f"longer than {cleaning.max_extent:g}"))
    if cleaning.needs_views:
        assert seen is not None
        few = f"seen by fewer than {cleaning.min_views} of {seen.total} training views"
        dust = f"of less than {cleaning.dust:g} px in every training view"
        goes += [(seen.views < cleaning.min_views, few)] if cleaning.min_views else []
        goes += [(seen.pixels < cleaning.dust, dust)] if cleaning.dust else []
    stays = torch.ones(len(means), dtype=torch.bool, device=means.device)
    sentences = []
    for taken, which in goes:
        number = int((stays & taken).sum())
        stays &= ~taken
        noun, verb = ("Gaussian", "is") if number == 1 else ("Gaussians", "are")
        sentences.append(f"{number:,} {noun} {which} {verb} taken away.")
    return stays, sentences
