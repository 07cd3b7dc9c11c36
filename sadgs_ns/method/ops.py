"""Change parameters together with the moments of their optimizers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, MutableMapping, Sequence
from typing import Any

import torch
from torch import Tensor

from sadgs_ns.distributed.world import World

Params = MutableMapping[str, torch.nn.Parameter] | torch.nn.ParameterDict
"""gsplat's parameters by name, each with leading dimension N."""
Optimizers = Mapping[str, torch.optim.Optimizer]
"""The optimizers of parameters by their names; a parameter that is not trained may have none."""
State = MutableMapping[str, Any]
"""The state of a strategy; its tensors have leading dimension N."""


def opacities(params: Params) -> Tensor:
    """Return the opacities in [0, 1], without gradient. [N]"""
    logits = params["opacities"].detach().flatten()
    return torch.sigmoid(logits)


@torch.no_grad()
def update_param_with_optimizer(
    param_fn: Callable[[str, Tensor], Tensor],
    optimizer_fn: Callable[[str, Tensor], Tensor],
    params: Params,
    optimizers: Optimizers,
    names: Sequence[str] | None = None,
) -> None:
    """Replace parameters and their optimizers' moments, as gsplat's `duplicate` and `split` do.

    Args:
        param_fn: Makes the new parameter's values from its name and the old one.
        optimizer_fn: Makes a new moment from its key and the old one; `step` stays.
        names: The parameters to change; None changes all.
    """
    if names is None:
        names = list(params)
    for name in names:
        optimizer = optimizers.get(name)
        old = params[name]
        state = {}
        if optimizer is not None:
            state = optimizer.state.pop(old, {})
        for key, value in state.items():
            if key != "step":
                state[key] = optimizer_fn(key, value)
        new = torch.nn.Parameter(param_fn(name, old), requires_grad=old.requires_grad)
        params[name] = new
        if optimizer is not None:
            optimizer.param_groups[0]["params"] = [new]
            optimizer.state[new] = state


def map_opacities(function: Callable[[Tensor], Tensor], params: Params, optimizers: Optimizers) -> None:
    """Change the opacities (not their logits) and forget their optimizer moments, as gsplat's reset does."""

    def param_fn(name: str, p: Tensor) -> Tensor:
        changed = function(torch.sigmoid(p))
        return torch.logit(changed.clamp(1e-6, 1 - 1e-6))

    def optimizer_fn(key: str, v: Tensor) -> Tensor:
        return torch.zeros_like(v)

    update_param_with_optimizer(param_fn, optimizer_fn, params, optimizers, names=["opacities"])


def rebalance(world: World, params: Params, optimizers: Optimizers, state: State) -> None:
    """Count the Gaussians of all processes, and even them out if they differ by more than a tenth."""
    world.count(len(params["means"]))
    if not world.is_uneven():
        return

    def param_fn(name: str, p: Tensor) -> Tensor:
        return world.rebalance(p.detach())

    def optimizer_fn(key: str, v: Tensor) -> Tensor:
        return world.rebalance(v)

    update_param_with_optimizer(param_fn, optimizer_fn, params, optimizers)
    for key, value in state.items():
        if isinstance(value, Tensor):
            state[key] = world.rebalance(value)
    world.count(len(params["means"]))
