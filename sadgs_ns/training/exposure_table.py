"""The gains of a run's training photos, as the model and its checkpoints hold them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

from sadgs_ns.geometry.point_colors import OFFSET, srgb_gains


@dataclass(frozen=True)
class ExposureTable:
    """Gains of V training photos, and the colours of P points at the median gain. It never changes in a run."""

    names: list[str]  # Of the photos, by `photo_names`
    stops: Tensor  # log₂ of the gains of linear light. float64 [V, 3]
    points: Tensor  # log₂ of linear light; NaN where it is unknown. float32 [P, 3]

    @classmethod
    def of(cls, state: Mapping[str, Any] | None) -> ExposureTable | None:
        """Make a table of its `state_dict`; None if a checkpoint has none."""
        if state is None:
            return None
        return cls(list(state["names"]), state["stops"].cpu(), state["points"].cpu())

    def state_dict(self) -> dict[str, Any]:
        """Return what a checkpoint holds."""
        return asdict(self)

    def gains(self) -> Tensor:
        """Return the factors of sRGB's values by `srgb_gains`. [V, 3]"""
        return srgb_gains(self.stops)

    def color_maps(self) -> Tensor:
        """Return the gains as `render.rasterization.project` takes them, with the offsets of `apply_gains`.

        float32 [V, 2, 3]
        """
        gains = self.gains()
        offsets = OFFSET * (gains - 1)
        return torch.stack([gains, offsets], dim=1).float()
