"""Matches of SIFT features by a matrix product of all descriptors of two photos, on a GPU.

COLMAP's index on the CPU takes most of the time of matching. Its criteria decide here, too, and its verification of
matches runs in threads meanwhile.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pycolmap
import torch
from scipy.sparse.csgraph import minimum_spanning_tree
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from sadgs_ns.events import progress
from sadgs_ns.host import num_cores
from sadgs_ns.placing.photos import threads
from sadgs_ns.placing.plan import NEIGHBORS
from sadgs_ns.placing.verification import Verifier

MAX_DISTANCE, MAX_RATIO = 0.7, 0.8
"""Largest angle between matching descriptors in radians, and its largest ratio to the next best's; COLMAP's."""
_LARGEST_FEATURES = 128  # By so many a photo is compared with all others; all of them take up to 4,096 times the work.
_COMPARED_AT_ONCE = 500  # Photos that one is compared with at a time, in some .1 GB
_SAVED_AT_ONCE = 100  # Pairs that are saved and reported together
KEPT_PHOTOS = 2000  # Photos whose descriptors stay on the device, at 1 MB each


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


def count_shared(descriptors: Tensor, others: Sequence[Tensor]) -> list[int]:
    """Count the matches between a photo and each of others. uint8 [M, 128] each"""
    if len(descriptors) == 0:
        return [0] * len(others)
    padding = torch.zeros((1, 128), dtype=torch.uint8, device=descriptors.device)  # No other photo may have any.
    counts: list[int] = []
    for start in range(0, len(others), _COMPARED_AT_ONCE):
        some = pad_sequence([*others[start : start + _COMPARED_AT_ONCE], padding], batch_first=True)[:-1]  # [N, M, 128]
        photo, _, _ = _mutual((descriptors / 512).expand(len(some), -1, -1), some / 512)
        counts += torch.bincount(photo, minlength=len(some)).tolist()
    return counts


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


def similar_photos(
    database: Path, device: torch.device | None, largest: Mapping[int, Tensor] | None = None
) -> list[tuple[str, str]]:
    """Pair the photos in COLMAP's database by `similar_pairs` of the largest of their features.

    `largest` may hold the result of `largest_descriptors` for some images, by their numbers in the database.
    """
    known = largest or {}
    chosen: list[Tensor] = []
    with pycolmap.Database.open(database) as opened:
        images = sorted(opened.read_all_images(), key=lambda image: image.name)
        for image in images:
            if image.image_id in known:
                chosen.append(known[image.image_id])
                continue
            keypoints = opened.read_keypoints(image.image_id)
            descriptors = opened.read_descriptors(image.image_id).data
            chosen.append(largest_descriptors(keypoints, descriptors, device))
    return [(images[i].name, images[j].name) for i, j in similar_pairs(chosen, NEIGHBORS)]


def largest_descriptors(keypoints: np.ndarray, descriptors: np.ndarray, device: torch.device | None) -> Tensor:
    """Return the descriptors of a photo's largest features on a device, by which it is compared with all others.

    float32 [N, 4], uint8 [N, 128] → uint8 [M, 128]
    """
    order = np.argsort(-keypoints[:, 2], kind="stable")[:_LARGEST_FEATURES]
    return torch.from_numpy(descriptors[order]).to(device)


def write_matches(
    database: Path,
    pairs: Sequence[tuple[str, str]],
    device: torch.device,
    stage: str,
    options: pycolmap.TwoViewGeometryOptions,
    matched: dict[tuple[int, int], np.ndarray] | None = None,
    on_device: Mapping[int, Tensor] | None = None,
) -> None:
    """Match pairs of photos, verify the matches in threads meanwhile, and write both to COLMAP's database.

    Pairs that were verified before are skipped, also those that failed, and of pairs that were matched before the
    matches are read. All are written in the order of the pairs.

    Args:
        database: COLMAP's database with the features of all photos.
        pairs: The names of the photos of each pair.
        device: Where descriptors are compared.
        stage: The name under which progress is reported.
        options: Those of the verification, with a seed.
        matched: Matches of some pairs of images that are not in the database yet; they are taken out.
        on_device: Descriptors of some images that are on the device.
    """
    with pycolmap.Database.open(database) as opened, threads(num_cores()) as pool:
        source = _MatchSource(opened, device, matched or {}, on_device or {})
        verifier = Verifier(opened, options, pool)
        waiting: list[tuple[_Matched, Future[pycolmap.TwoViewGeometry]]] = []
        for start in range(0, len(pairs), _SAVED_AT_ONCE):
            lot = []
            for one, other in pairs[start : start + _SAVED_AT_ONCE]:
                if not opened.exists_two_view_geometry(source.ids[one], source.ids[other]):
                    pair = source.match(one, other)
                    lot.append((pair, verifier.submit(pair.first, pair.second, pair.matches)))
            _save(opened, waiting)  # They were verified while this lot was matched.
            progress(stage, start, len(pairs))
            waiting = lot
        _save(opened, waiting)


class _Matched(NamedTuple):
    """A pair of images with its matches."""

    first: int  # The lower number of an image in the database
    second: int
    matches: np.ndarray  # Indices of keypoints in both. uint32 [K, 2]
    is_new: bool  # Whether the matches are not in the database yet


def _save(opened: pycolmap.Database, pairs: Sequence[tuple[_Matched, Future[pycolmap.TwoViewGeometry]]]) -> None:
    """Wait until pairs are verified, and write them in their order."""
    geometries = [geometry.result() for _, geometry in pairs]
    with pycolmap.DatabaseTransaction(opened):
        for (matched, _), geometry in zip(pairs, geometries, strict=True):
            if matched.is_new:
                opened.write_matches(matched.first, matched.second, matched.matches)
            opened.write_two_view_geometry(matched.first, matched.second, geometry)


class _MatchSource:
    """Finds the matches of pairs: in the database, among those that were matched ahead, or by its device."""

    def __init__(
        self,
        opened: pycolmap.Database,
        device: torch.device,
        matched: dict[tuple[int, int], np.ndarray],
        on_device: Mapping[int, Tensor],
    ) -> None:
        self.ids = {image.name: image.image_id for image in opened.read_all_images()}
        self._opened = opened
        self._matched = matched
        self._on_device = on_device

        @lru_cache(max(1, KEPT_PHOTOS - len(on_device)))
        def read(image_id: int) -> Tensor:
            return torch.from_numpy(opened.read_descriptors(image_id).data.copy()).to(device)

        self._read = read

    def match(self, name: str, other_name: str) -> _Matched:
        """Return the matches of two photos."""
        one = self.ids[name]
        other = self.ids[other_name]
        first = min(one, other)
        second = max(one, other)
        if self._opened.exists_matches(first, second):
            return _Matched(first, second, self._opened.read_matches(first, second), is_new=False)
        found = self._matched.pop((one, other), None)
        if found is None:
            found = match_descriptors(self._descriptors(one), self._descriptors(other)).cpu().numpy()
        if one > other:
            found = found[:, ::-1]
        return _Matched(first, second, np.ascontiguousarray(found, np.uint32), is_new=True)

    def _descriptors(self, image_id: int) -> Tensor:
        """Return an image's descriptors on the device. uint8 [N, 128]"""
        if image_id in self._on_device:
            return self._on_device[image_id]
        return self._read(image_id)
