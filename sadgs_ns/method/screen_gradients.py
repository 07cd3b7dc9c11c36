"""Sums of screen gradients, by which AbsGS lets Gaussians grow (paper, section 3.6; AbsGS)."""

from __future__ import annotations

from collections.abc import Mapping, MutableMapping
from typing import Any

import torch
from torch import Tensor

from sadgs_ns.kernels import use_triton
from sadgs_ns.render.rasterization import visible


def empty_gradients(num_gaussians: int, device: torch.device) -> dict[str, Tensor]:
    """Sums `grad2d`, `absgrad2d` and the number of views `grad_count` that they run over, each float32 [N]."""
    zeros = torch.zeros(num_gaussians, device=device)
    return {"grad2d": zeros, "absgrad2d": zeros.clone(), "grad_count": zeros.clone()}


def keep_gradient(
    means2d: Tensor,  # [C, N, 2]
) -> None:
    """Let the backward pass keep the gradient of projected centres, given `info` of a call with `absgrad`.

    Our compositing keeps it by itself, without the copy that torch makes.
    """
    if not hasattr(means2d, "grad2d"):
        means2d.retain_grad()


@torch.no_grad()
def accumulate_gradients(gradients: MutableMapping[str, Tensor], info: Mapping[str, Any], num_views: int) -> None:
    """Add the screen-space gradients of one backward pass to those of `empty_gradients`, in place.

    Gradients are normalised as in 3DGS: by half the image size, so that 1 is the gradient per half image, and by the
    number of views, since the loss is their mean. One that is NaN adds nothing. `info` is gsplat's unpacked meta, whose
    `means2d` has its `absgrad` and what `keep_gradient` kept.
    """
    means2d = info["means2d"]
    gradient = getattr(means2d, "grad2d", None)
    if gradient is None:
        gradient = means2d.grad
    # Python numbers: a tensor made of them here would make the host wait for its copy to the device.
    scale_x, scale_y = info["width"] / 2.0 * num_views, info["height"] / 2.0 * num_views
    if use_triton(means2d):
        from sadgs_ns.kernels import screen_gradients as kernel

        sums = gradients["grad2d"], gradients["absgrad2d"], gradients["grad_count"]
        kernel.accumulate_gradients(sums, info["radii"], gradient, means2d.absgrad, (scale_x, scale_y))
        return
    seen = visible(info)  # [C, N]
    for key, value in (("grad2d", gradient), ("absgrad2d", means2d.absgrad)):
        norm = torch.hypot(value[..., 0] * scale_x, value[..., 1] * scale_y)  # [C, N]
        gradients[key] += torch.where(seen, norm, 0.0).nansum(0)
    gradients["grad_count"] += seen.sum(0)
