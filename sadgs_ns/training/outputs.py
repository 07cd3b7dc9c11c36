"""The outputs of a model for nerfstudio's programs: some are computed when they are read, and the viewer's differ."""

from __future__ import annotations

import threading
from collections import UserDict
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any

import torch
from nerfstudio.model_components import renderers
from torch import Tensor

from sadgs_ns.training.run.progress import warn


class LazyOutputs(UserDict[str, Any]):
    """Tensors by name, or functions that compute them when they are first read.

    nerfstudio does not tell a model which outputs it needs. Without this, each output would cost `ns-eval` and
    `ns-render` time.

    `unclamped` returns the colours of `rgb` without background, which may be above 1 [H, W, 3]. A photo that is darker
    than the splat's exposure shows such colours. It is no output by name, because `ns-render` writes these as images.
    """

    def __init__(self, values: Mapping[str, Any], unclamped: Callable[[], Tensor]) -> None:
        super().__init__(values)
        self.unclamped = unclamped

    def __getitem__(self, name: str) -> Tensor:
        value: Any = self.data[name]
        if callable(value):
            value = value()
            self.data[name] = value
        return value


def crop_background(background: Tensor) -> Tensor:
    """Return the colour of the crop box that nerfstudio draws now, [3], or else the model's background [3]."""
    if renderers.BACKGROUND_COLOR_OVERRIDE is None:
        return background
    return renderers.BACKGROUND_COLOR_OVERRIDE.to(background)


def rgba_image(
    outputs: Mapping[str, Tensor],  # Of the model, each [H, W, C]
    output_name: str = "rgb",
) -> Tensor:
    """Return a rendering without its background, and how opaque it is, in [0, 1]. [H, W, 4]"""
    alpha = outputs["accumulation"]
    seen = outputs[output_name] - (1 - alpha) * outputs["background"]
    color = torch.where(alpha > 0, seen / alpha, 0.0)
    return torch.cat([color.clamp(0.0, 1.0), alpha], dim=-1)


def in_viewer() -> bool:
    """Tell whether nerfstudio's viewer draws in this thread."""
    from nerfstudio.viewer.render_state_machine import RenderStateMachine  # It imports viser.

    return isinstance(threading.current_thread(), RenderStateMachine)


@lru_cache(maxsize=8)
def warn_once(text: str) -> None:
    """Print a warning, unless it was printed before."""
    warn(text)
