"""AbsGS densification: clone on the mean gradient, split on the absolute one (paper, section 3.6; AbsGS)."""

from __future__ import annotations

import math
from collections.abc import Mapping, MutableMapping
from typing import Any

import torch
import torch.nn.functional as F
from gsplat.strategy.ops import duplicate, split
from torch import Tensor

from sadgs_ns.distributed.ranking import limit_growth
from sadgs_ns.distributed.world import World
from sadgs_ns.kernels import use_triton
from sadgs_ns.method.ops import Params
from sadgs_ns.method.split import grid_split
from sadgs_ns.render.rasterization import visible

_OTHER_AXES = 0.8
"""Of a Gaussian whose longest axis is halved: how long the others stay (docs/results.md#splits-and-rates)."""


def empty_gradients(num_gaussians: int, device: torch.device) -> dict[str, Tensor]:
    """Sums `grad2d`, `absgrad2d` and the number of views `grad_count` that they run over, each float32 [N]."""
    zeros = torch.zeros(num_gaussians, device=device)
    return {"grad2d": zeros, "absgrad2d": zeros.clone(), "grad_count": zeros.clone()}


def keep_gradient(means2d: Tensor) -> None:
    """Have the backward pass keep the gradient of projected centres for `accumulate_gradients`.

    Our compositing keeps it by itself, without the copy that torch makes.

    Args:
        means2d: Of gsplat's meta, from a call with `absgrad`. [C, N, 2]
    """
    if not hasattr(means2d, "grad2d"):
        means2d.retain_grad()


@torch.no_grad()
def accumulate_gradients(gradients: MutableMapping[str, Tensor], info: Mapping[str, Any], num_views: int) -> None:
    """Add the screen-space gradients of one backward pass, in place.

    Gradients are normalised as in 3DGS: by half the image size, so that 1 is the gradient per half image, and by the
    number of views, since the loss is a mean over views. One that is NaN adds nothing.

    Args:
        gradients: As made by `empty_gradients`.
        info: gsplat's meta, unpacked, whose `means2d` [C, N, 2] kept its `absgrad`, and its gradient as `keep_gradient`
            made it or in `grad`.
        num_views: Views that the loss is a mean of.
    """
    means2d = info["means2d"]
    gradient = getattr(means2d, "grad2d", None)
    if gradient is None:
        gradient = means2d.grad
    # Python numbers: a tensor made of them here would make the host wait for its copy to the device.
    scale_x, scale_y = info["width"] / 2.0 * num_views, info["height"] / 2.0 * num_views
    if use_triton(means2d):
        from sadgs_ns.kernels import absgs as kernel

        sums = gradients["grad2d"], gradients["absgrad2d"], gradients["grad_count"]
        kernel.accumulate_gradients(sums, info["radii"], gradient, means2d.absgrad, (scale_x, scale_y))
        return
    seen = visible(info)  # [C, N]
    for key, value in (("grad2d", gradient), ("absgrad2d", means2d.absgrad)):
        norm = torch.hypot(value[..., 0] * scale_x, value[..., 1] * scale_y)  # [C, N]
        gradients[key] += torch.where(seen, norm, 0.0).nansum(0)
    gradients["grad_count"] += seen.sum(0)


@torch.no_grad()
def grow(
    params: Params,
    optimizers: MutableMapping[str, torch.optim.Optimizer],
    state: MutableMapping[str, Any],
    *,
    clone_threshold: float,
    split_threshold: float,
    size_threshold: float,
    budget: float,
    long_axis: bool = False,
    world: World,
) -> tuple[int, int]:
    """Clone small Gaussians by their mean gradient, split large ones in two by their absolute gradient.

    Args:
        params: gsplat's parameters.
        optimizers: One per parameter.
        state: The strategy's state with the sums of `empty_gradients`.
        clone_threshold: Normalised mean gradient at which a small Gaussian is cloned; AbsGS uses 2e-4.
        split_threshold: Normalised mean absolute gradient at which a large one is split; AbsGS uses 4e-4.
        size_threshold: Largest scale in world units at which a Gaussian counts as small.
        budget: Gaussians that may be added in all, the steepest gradients first.
        long_axis: Halve the longest axis of a large one as `grid_split` does, and take a fifth off the others, instead
            of drawing the places of two that are 1.6 times as small on all axes, as 3DGS does.
        world: The processes that share the budget.

    Returns:
        Numbers of clones and of splits.
    """
    count = state["grad_count"].clamp_min(1)
    is_small = params["scales"].exp().amax(dim=-1) <= size_threshold
    clone_ratio = state["grad2d"] / count / clone_threshold
    split_ratio = state["absgrad2d"] / count / split_threshold
    steepness = torch.where(is_small, clone_ratio, split_ratio)  # ≥ 1 grows
    grows = (steepness >= 1) & steepness.isfinite()  # a sum that overflowed says nothing
    chosen = limit_growth(world, grows.long(), steepness, budget)
    is_clone, is_split = chosen & is_small, chosen & ~is_small
    n_clone, n_split = int(is_clone.sum()), int(is_split.sum())
    if n_clone > 0:
        duplicate(params, optimizers, state, is_clone)  # type: ignore[arg-type]
        _forget_last(state, n_clone)
    if n_split > 0:
        is_split = torch.cat([is_split, is_split.new_zeros(n_clone)])  # clones are not split
        if long_axis:
            halved = F.one_hot(params["scales"].argmax(dim=-1), 3) * is_split[:, None]  # [N, 3]
            # The other axes are shortened on the parents, which the next line replaces by their children.
            params["scales"].data += math.log(_OTHER_AXES) * (is_split[:, None].long() - halved)
            grid_split(params, optimizers, state, 1 + halved)
        else:
            split(params, optimizers, state, is_split)  # type: ignore[arg-type]
            _forget_last(state, 2 * n_split)
    return n_clone, n_split


def _forget_last(state: MutableMapping[str, Any], num_children: int) -> None:
    """Empty the rows of the newest Gaussians, which gsplat's operations append as copies of their parents' rows."""
    for value in state.values():
        if isinstance(value, Tensor):
            value[-num_children:] = 0
