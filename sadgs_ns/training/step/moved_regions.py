"""The pixels of training photos that a run leaves out because something moved there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor


class MovedRegions:
    """Regions of training photos that count as little as what masks hide.

    They are small pictures on the device of training, and become a part of the masks when photos are drawn. Photos
    without a region stay as they are.
    """

    def __init__(self) -> None:
        self._regions: dict[int, Tensor] = {}  # By view, 1 where something moved. uint8 [h, w]

    def __len__(self) -> int:
        """Number of photos that have a region."""
        return len(self._regions)

    @property
    def views(self) -> list[int]:
        """Indices of the photos that have a region, in their order."""
        return sorted(self._regions)

    def replace(self, regions: Mapping[int, Tensor]) -> list[int]:
        """Replace all regions by others, uint8 [h, w] on the device of training; return the photos that change."""
        changed = []
        for view in sorted(self._regions.keys() | regions.keys()):
            before = self._regions.get(view)
            after = regions.get(view)
            if before is None or after is None or not torch.equal(before.to(after.device), after):
                changed.append(view)
        self._regions = dict(regions)
        return changed

    def masked(self, view: int, data: Mapping[str, Any]) -> Mapping[str, Any]:
        """Return a photo's data with its region hidden: False in `mask`, bool [H, W, 1], besides what that hid before.

        `data` itself is returned if the photo has no region, or if it has no `image`, as of a view that only other
        processes composite.
        """
        if view not in self._regions or "image" not in data:
            return data
        image = data["image"]
        hidden = self.hidden(view, image.shape[:2])
        mask = ~hidden[:, :, None].to(image.device)
        if "mask" in data:
            mask &= data["mask"].to(image.device)
        return {**data, "mask": mask}

    def hidden(self, view: int, size: Sequence[int]) -> Tensor:
        """Return the region of a photo at a size in px (H, W). bool [H, W]"""
        if view not in self._regions:
            return torch.zeros(tuple(size), dtype=torch.bool)
        region = self._regions[view].float()
        enlarged = F.interpolate(region[None, None], tuple(size), mode="nearest-exact")
        return enlarged[0, 0] > 0

    def share(self, view: int) -> float:
        """Return the share of a photo's pixels in its region."""
        if view not in self._regions:
            return 0.0
        return float(self._regions[view].float().mean())

    def state_dict(self, names: Sequence[str]) -> dict[str, Tensor]:
        """Return the regions by the photos' names, for a checkpoint."""
        return {names[view]: region.cpu() for view, region in self._regions.items()}

    def load_state_dict(self, state: Mapping[str, Tensor], names: Sequence[str], device: torch.device) -> None:
        """Restore regions of photos that have the same names."""
        self._regions = {}
        for view, name in enumerate(names):
            if name in state:
                self._regions[view] = state[name].to(device)
