"""Matches of SIFT features by a matrix product of all descriptors of two photos, on a GPU.

COLMAP's index on the CPU takes most of the time of matching. Its criteria decide here, too, and its geometric
verification follows.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
import pycolmap
import torch
from torch import Tensor

MAX_DISTANCE, MAX_RATIO = 0.7, 0.8
"""Largest angle between matching descriptors in radians, and its largest ratio to the next best's; COLMAP's."""
_KEPT_PHOTOS = 2000
"""Photos whose descriptors stay on the device, at 1 MB each."""


def match_descriptors(one: Tensor, other: Tensor) -> Tensor:
    """Match 512 times the descriptors of two photos, each the other's nearest, near enough, and nearer than the next.

    uint8 [N, 128], [M, 128] → indices in both, int64 [K, 2]
    """
    if not len(one) or not len(other):
        return torch.zeros((0, 2), dtype=torch.int64, device=one.device)
    cosines = one.float() @ other.float().T / 512**2  # The sums of products of bytes are exact. [N, M]
    nearest, back = _nearest(cosines), _nearest(cosines.T)
    index = torch.arange(len(one), device=one.device)
    mutual = (nearest >= 0) & (back[nearest] == index)
    return torch.stack([index[mutual], nearest[mutual]], dim=1)


def _nearest(cosines: Tensor) -> Tensor:
    """Return the column that each row's descriptor matches, −1 where it matches none. [N, M] → int64 [N]"""
    best, columns = cosines.topk(min(2, cosines.shape[1]), dim=1)
    angles = torch.arccos(best.clamp_max(1.0))
    matches = (angles[:, 0] <= MAX_DISTANCE) & (angles[:, 0] < MAX_RATIO * angles[:, -1] if len(angles.T) > 1 else True)
    return torch.where(matches, columns[:, 0], -1)


def write_matches(database: Path, pairs: Sequence[tuple[str, str]], device: torch.device) -> None:
    """Match pairs of photos that have no matches in COLMAP's database yet, and write those there, unverified."""
    with pycolmap.Database.open(database) as opened:
        ids = {image.name: image.image_id for image in opened.read_all_images()}

        @lru_cache(_KEPT_PHOTOS)
        def descriptors(image_id: int) -> Tensor:
            return torch.from_numpy(opened.read_descriptors(image_id).data.copy()).to(device)

        with pycolmap.DatabaseTransaction(opened):
            for one, other in ((ids[a], ids[b]) for a, b in pairs):
                if not opened.exists_matches(one, other):
                    found = match_descriptors(descriptors(one), descriptors(other))
                    opened.write_matches(one, other, found.cpu().numpy().astype(np.uint32))
