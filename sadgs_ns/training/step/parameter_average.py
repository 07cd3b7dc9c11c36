"""The mean of the Gaussians' parameters over a run's last iterations, which is less noisy than the last one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from sadgs_ns.method.ops import Params


class RunningMean:
    """The mean of parameters over iterations (Polyak and Juditsky).

    Each step renders few views, so the parameters keep moving around those that are best for all views; their mean is
    closer. Parameters are averaged as they are optimized, such as log scales and logits of opacities.
    """

    def __init__(self) -> None:
        self.count = 0  # Number of iterations in the mean
        self.means: dict[str, Tensor] = {}  # Means by the parameters' names, of the parameters' shapes

    @torch.no_grad()
    def add(self, params: Params) -> None:
        """Add an iteration's parameters to the mean; their shapes must not change."""
        self.count += 1
        if self.count == 1:
            self.means = {name: parameter.detach().clone() for name, parameter in params.items()}
            return
        # One launch for all parameters; each of their means is computed as lerp_ does it.
        torch._foreach_lerp_(list(self.means.values()), [params[name] for name in self.means], 1 / self.count)  # type: ignore[attr-defined]

    @torch.no_grad()
    def move_to(self, params: Params) -> None:
        """Write the mean into the parameters and forget it."""
        for name, mean in self.means.items():
            params[name].copy_(mean)
        self.clear()

    def clear(self) -> None:
        """Forget what was added."""
        self.count = 0
        self.means = {}

    def state_dict(self) -> dict[str, Any]:
        """Return the state for a checkpoint, without copying its tensors."""
        return {"count": self.count, "means": dict(self.means)}

    def load_state_dict(self, state: Mapping[str, Any], device: torch.device) -> None:
        """Restore the result of `state_dict`."""
        self.count = state["count"]
        self.means = {name: mean.to(device) for name, mean in state["means"].items()}
