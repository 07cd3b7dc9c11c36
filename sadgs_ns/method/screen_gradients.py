"""Sums of screen gradients, by which AbsGS lets Gaussians grow (paper, section 3.6; AbsGS)."""

from __future__ import annotations

from collections.abc import Mapping, MutableMapping
from typing import Any

import torch
from torch import Tensor

from sadgs_ns.kernels import use_triton
from sadgs_ns.render.rasterization import visible


def empty_gradients(num_gaussians: int, device: torch.device) -> dict[str, Tensor]:
    """Return sums `grad2d` and `absgrad2d`, and the number of views `grad_count`, all 0. float32 [N] each"""
    zeros = torch.zeros(num_gaussians, device=device)
    return {"grad2d": zeros, "absgrad2d": zeros.clone(), "grad_count": zeros.clone()}


def keep_gradient(
    means2d: Tensor,  # [C, N, 2]
) -> None:
    """Let the backward pass keep the gradient of projected centres.

    They are `means2d` of the info of a rendering with `absgrad`. Compositing by Triton stores the gradient in their
    `grad2d` itself, without the copy that torch's `retain_grad` makes.
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
    half_width = info["width"] / 2.0
    half_height = info["height"] / 2.0
    scales = (half_width * num_views, half_height * num_views)
    if use_triton(means2d):
        from sadgs_ns.kernels import screen_gradients as kernel

        sums = (gradients["grad2d"], gradients["absgrad2d"], gradients["grad_count"])
        kernel.accumulate_gradients(sums, info["radii"], gradient, means2d.absgrad, scales)
        return
    seen = visible(info)  # [C, N]
    gradients["grad2d"] += _sum_of_lengths(gradient, scales, seen)
    gradients["absgrad2d"] += _sum_of_lengths(means2d.absgrad, scales, seen)
    gradients["grad_count"] += seen.sum(0)


def _sum_of_lengths(
    gradient: Tensor,  # [C, N, 2]
    scales: tuple[float, float],  # factors on its x and y
    seen: Tensor,  # bool [C, N]
) -> Tensor:
    """Sum the lengths of scaled gradients over the views that see a Gaussian; NaN counts as 0. [N]"""
    scale_x, scale_y = scales
    lengths = torch.hypot(gradient[..., 0] * scale_x, gradient[..., 1] * scale_y)  # [C, N]
    return torch.where(seen, lengths, 0.0).nansum(0)
