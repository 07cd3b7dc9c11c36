"""Matches of SIFT features by a matrix product of all descriptors of two photos, on a GPU.

COLMAP's index on the CPU takes most of the time of matching. Its criteria decide here, too, and it verifies matches.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
import pycolmap
import torch
from scipy.sparse.csgraph import minimum_spanning_tree
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from sadgs_ns.events import progress
from sadgs_ns.placing.plan import NEIGHBORS

MAX_DISTANCE, MAX_RATIO = 0.7, 0.8
"""Largest angle between matching descriptors in radians, and its largest ratio to the next best's; COLMAP's."""
_LARGEST_FEATURES = 128  # By so many a photo is compared with all others; all of them take up to 4,096 times the work.
_COMPARED_AT_ONCE = 500  # Photos that one is compared with at a time, in some .1 GB
_SAVED_AT_ONCE = 400  # Pairs whose matches are saved and reported together
_KEPT_PHOTOS = 2000  # Photos whose descriptors stay on the device, at 1 MB each


def match_descriptors(one: Tensor, other: Tensor) -> Tensor:
    """Match 512 times the descriptors of two photos, each the other's nearest, near enough, and nearer than the next.

    uint8 [N, 128], [M, 128] → indices in both, int64 [K, 2]
    """
    if not len(one) or not len(other):
        return torch.zeros((0, 2), dtype=torch.int64, device=one.device)
    return torch.stack(_mutual(one / 512, other / 512), dim=1)


def similar_pairs(descriptors: Sequence[Tensor], neighbors: int) -> list[tuple[int, int]]:
    """Pair each photo with those that most of its descriptors match, so that a chain of pairs joins any two.

    Args:
        descriptors: Those of each photo, N on one device, a few of the largest features suffice. uint8 [M, 128]
        neighbors: How many photos each is paired with at least.

    Returns:
        Indices of the photos of each pair, the lower one first, in order.
    """
    padding = torch.zeros((1, 128), dtype=torch.uint8, device=descriptors[0].device)  # No photo may have any.
    counts = _shared(pad_sequence([*descriptors, padding], batch_first=True)[:-1]).cpu().numpy()  # [N, N]
    order = np.argsort(-counts, axis=1, kind="stable")[:, :neighbors]
    chosen = np.zeros_like(counts, dtype=bool)
    np.put_along_axis(chosen, order, True, axis=1)
    chain = minimum_spanning_tree(counts.max() + 1 - counts)  # the best tree that joins all photos
    chosen[chain.nonzero()] = True
    return [(int(i), int(j)) for i, j in np.argwhere(np.triu(chosen | chosen.T, 1))]


def _shared(descriptors: Tensor) -> Tensor:
    """Count the matches between any two photos; padding of zeros matches nothing. uint8 [N, M, 128] → int64 [N, N]"""
    descriptors = descriptors / 512
    counts = torch.zeros((len(descriptors),) * 2, dtype=torch.int64, device=descriptors.device)
    for i in range(len(descriptors)):
        for start in range(i + 1, len(descriptors), _COMPARED_AT_ONCE):
            others = descriptors[start : start + _COMPARED_AT_ONCE]
            photo, _, _ = _mutual(descriptors[i].expand(len(others), -1, -1), others)
            counts[i, start : start + len(others)] = torch.bincount(photo, minlength=len(others))
    return counts + counts.T


def _mutual(one: Tensor, other: Tensor) -> tuple[Tensor, ...]:
    """Return the indices of matches in both, after those in the batch. [..., N, 128], [..., M, 128]"""
    cosines = one @ other.mT  # The sums of products of bytes are exact. [..., N, M]
    nearest = _nearest(cosines)
    back = _nearest(cosines.mT)
    index = torch.arange(one.shape[-2], device=one.device)
    is_mutual = (nearest >= 0) & (back.gather(-1, nearest.clamp_min(0)) == index)
    return *is_mutual.nonzero(as_tuple=True), nearest[is_mutual]


def _nearest(cosines: Tensor) -> Tensor:
    """Return the column that each row's descriptor matches, −1 where it matches none. [..., N, M] → int64 [..., N]"""
    best, columns = cosines.max(dim=-1, keepdim=True)
    cosines.scatter_(-1, columns, -1.0)  # Two passes over the matrix are twice as fast as `topk`.
    next_best = cosines.amax(dim=-1)
    cosines.scatter_(-1, columns, best)
    angle = best[..., 0].clamp_max(1.0).arccos()
    return torch.where((angle <= MAX_DISTANCE) & (angle < MAX_RATIO * next_best.arccos()), columns[..., 0], -1)


def similar_photos(database: Path, device: torch.device | None) -> list[tuple[str, str]]:
    """Pair the photos in COLMAP's database by `similar_pairs` of the largest of their features."""
    with pycolmap.Database.open(database) as opened:
        images = sorted(opened.read_all_images(), key=lambda image: image.name)
        largest: list[Tensor] = []
        for image in images:
            scales = opened.read_keypoints(image.image_id)[:, 2]
            chosen = np.argsort(-scales, kind="stable")[:_LARGEST_FEATURES]
            largest.append(torch.from_numpy(opened.read_descriptors(image.image_id).data[chosen]).to(device))
    return [(images[i].name, images[j].name) for i, j in similar_pairs(largest, NEIGHBORS)]


def write_matches(database: Path, pairs: Sequence[tuple[str, str]], device: torch.device, stage: str) -> None:
    """Match pairs of photos that have no matches in COLMAP's database yet, and write those there, unverified."""
    with pycolmap.Database.open(database) as opened:
        ids = {image.name: image.image_id for image in opened.read_all_images()}

        @lru_cache(_KEPT_PHOTOS)
        def descriptors(image_id: int) -> Tensor:
            return torch.from_numpy(opened.read_descriptors(image_id).data.copy()).to(device)

        for start in range(0, len(pairs), _SAVED_AT_ONCE):
            progress(stage, start, len(pairs))
            with pycolmap.DatabaseTransaction(opened):
                for one, other in ((ids[a], ids[b]) for a, b in pairs[start : start + _SAVED_AT_ONCE]):
                    if not opened.exists_matches(one, other):
                        found = match_descriptors(descriptors(one), descriptors(other))
                        opened.write_matches(one, other, found.cpu().numpy().astype(np.uint32))
