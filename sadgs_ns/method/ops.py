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
State = MutableMapping[str, Any]  # The state of a strategy; its tensors have leading dimension N


def opacities(params: Params) -> Tensor:
    """Return the opacities, without gradient. [N]"""
    return torch.sigmoid(params["opacities"].detach().flatten())


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
    for name in list(params) if names is None else names:
        old, optimizer = params[name], optimizers.get(name)
        state = {} if optimizer is None else optimizer.state.pop(old, {})
        for key, value in state.items():
            if key != "step":
                state[key] = optimizer_fn(key, value)
        params[name] = new = torch.nn.Parameter(param_fn(name, old), requires_grad=old.requires_grad)
        if optimizer is not None:
            optimizer.param_groups[0]["params"], optimizer.state[new] = [new], state


def map_opacities(function: Callable[[Tensor], Tensor], params: Params, optimizers: Optimizers) -> None:
    """Change the opacities (not their logits) and forget their optimizer moments, as gsplat's reset does."""

    def changed(name: str, p: Tensor) -> Tensor:
        return torch.logit(function(torch.sigmoid(p)).clamp(1e-6, 1 - 1e-6))

    update_param_with_optimizer(changed, lambda key, v: torch.zeros_like(v), params, optimizers, names=["opacities"])


def rebalance(world: World, params: Params, optimizers: Optimizers, state: State) -> None:
    """Count the Gaussians of all processes, and even them out if they differ by more than a tenth."""
    world.count(len(params["means"]))
    if not world.is_uneven():
        return
    update_param_with_optimizer(
        lambda name, p: world.rebalance(p.detach()), lambda key, v: world.rebalance(v), params, optimizers
    )
    for key, value in state.items():
        if isinstance(value, Tensor):
            state[key] = world.rebalance(value)
    world.count(len(params["means"]))
