"""Held-out photos beside views at their own exposure, for runs with gains.

A splat has the median exposure of its training photos, and a held-out photo has an exposure of its own, which the
colours of points tell. Colours of the splat may be above 1: photos that are darker than the median show them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

from torch import Tensor

from sadgs_ns.geometry.point_colors import apply_gains


def view_at_exposure(
    colors: Tensor,  # Without background, not clamped [H, W, 3]
    alpha: Tensor,  # Opacity [H, W, 1]
    gains: Tensor,  # Factors of sRGB's values [3]
    background: Tensor,  # [3]
) -> Tensor:
    """Return a view with the exposure of its photo, on a background. [H, W, 3] in [0, 1]"""
    gained = apply_gains(colors, gains.to(alpha), alpha)
    behind = (1 - alpha) * background
    return (gained + behind).clamp(0.0, 1.0)


def gain_metrics(
    view: Tensor,  # At its photo's exposure, in [0, 1] [H, W, 3]
    photo: Tensor,  # In [0, 1] [H, W, 3]
    measures: Mapping[str, Callable[[Tensor, Tensor], Tensor]],
) -> dict[str, float]:
    """Compare a view with its photo, and return each measure's number by `gain_` and the measure's name.

    A measure takes images [1, 3, H, W]. One that returns NaN, as LPIPS does without its weights, is left out.
    """
    predicted = view.movedim(-1, 0)[None]
    truth = photo.movedim(-1, 0)[None]
    numbers = {}
    for name, measure in measures.items():
        number = float(measure(truth, predicted))
        if not math.isnan(number):
            numbers[f"gain_{name}"] = number
    return numbers
