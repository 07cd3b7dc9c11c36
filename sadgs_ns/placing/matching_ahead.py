"""Matches photos on a GPU while the features of others are still being found on the processor.

What is matched here in vain costs the GPU alone, which has nothing else to do meanwhile.
"""

from __future__ import annotations

import bisect
import contextlib
import queue
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from sadgs_ns.events import span
from sadgs_ns.placing.plan import NEIGHBORS

if TYPE_CHECKING:
    import torch
    from torch import Tensor

_MOST_WAITING = 256  # Photos that may wait for the GPU, at 1 MB each; others are matched later.


@dataclass(frozen=True)
class PhotoFeatures:
    """The features of a photo, and its number in COLMAP's database."""

    name: str
    image_id: int
    keypoints: np.ndarray  # float32 [N, 4]
    descriptors: np.ndarray  # uint8 [N, 128]


Partners = Callable[[PhotoFeatures, "Mapping[int, Tensor]"], list[tuple[int, int]]]
"""Is called with each photo and the largest descriptors of this and all before it; returns pairs of their numbers."""


class MatchingAhead:
    """A context in which a thread matches each pair of photos as soon as both have features.

    Without a GPU it does nothing. Call `stop` before its results are read. Leaving the context drops them.

    Attributes:
        matches: Matches of pairs of images, by their numbers in the order of the pair. uint32 [K, 2]
        descriptors: Descriptors of images on the GPU. uint8 [N, 128]
        largest: Those of the largest features, as `matching.largest_descriptors` returns them.
    """

    def __init__(self, gpu: Future[torch.device | None], partners: Partners) -> None:
        """Begin the thread, which waits for photos.

        Args:
            gpu: The GPU if there is one.
            partners: Finds with which photos each is to be matched.
        """
        self.matches: dict[tuple[int, int], np.ndarray] = {}
        self.descriptors: dict[int, Tensor] = {}
        self.largest: dict[int, Tensor] = {}
        self._partners = partners
        self._photos: queue.Queue[PhotoFeatures | None] = queue.Queue(_MOST_WAITING)
        self._stopped = False
        self._pool = ThreadPoolExecutor(1)
        self._work = self._pool.submit(self._run, gpu)

    def __enter__(self) -> MatchingAhead:
        return self

    def __exit__(self, *error: object) -> None:
        self._end()
        for found in (self.matches, self.descriptors, self.largest):
            found.clear()  # The memory is needed elsewhere.

    def add(self, photo: PhotoFeatures) -> None:
        """Let a photo be matched with those before it, unless too many wait."""
        if not self._work.done():
            self._put(photo)

    def stop(self) -> None:
        """End the thread when the present pair is matched, and raise what it raised."""
        self._end()
        self._work.result()

    def _end(self) -> None:
        self._stopped = True
        self._put(None)  # The thread may wait for a photo.
        self._pool.shutdown()

    def _put(self, photo: PhotoFeatures | None) -> None:
        with contextlib.suppress(queue.Full):
            self._photos.put_nowait(photo)

    def _run(self, gpu: Future[torch.device | None]) -> None:
        device = gpu.result()
        if device is not None:
            with span("matches ahead"):
                self._match(device)
        self._photos = queue.Queue(_MOST_WAITING)  # Photos that still wait are not kept in memory.

    def _match(self, device: torch.device) -> None:
        """Match photos until no more come, or `stop` is called."""
        import torch

        from sadgs_ns.placing.matching import KEPT_PHOTOS, largest_descriptors, match_descriptors

        while len(self.descriptors) < KEPT_PHOTOS:
            photo = self._photos.get()
            if photo is None or self._stopped:
                return
            self.descriptors[photo.image_id] = torch.from_numpy(photo.descriptors).to(device)
            self.largest[photo.image_id] = largest_descriptors(photo.keypoints, photo.descriptors, device)
            for one, other in self._partners(photo, self.largest):
                if self._stopped:
                    return
                found = match_descriptors(self.descriptors[one], self.descriptors[other])
                self.matches[one, other] = found.cpu().numpy().astype(np.uint32)


class PlannedPartners:
    """Finds the partners of photos among pairs that are known before their features are."""

    def __init__(self, pairs: Sequence[tuple[str, str]]) -> None:
        self._pairs: dict[str, list[tuple[str, str]]] = defaultdict(list)
        for pair in pairs:
            for name in pair:
                self._pairs[name].append(pair)
        self._ids: dict[str, int] = {}

    def __call__(self, photo: PhotoFeatures, largest: Mapping[int, Tensor]) -> list[tuple[int, int]]:
        """Return the pairs of a photo and those before it."""
        self._ids[photo.name] = photo.image_id
        found = []
        for one, other in self._pairs[photo.name]:
            if one in self._ids and other in self._ids:
                found.append((self._ids[one], self._ids[other]))
        return found


class AlikePartners:
    """Guesses the partners of photos that are to be paired with those that look most alike.

    The most similar photos of one among all are among its most similar ones of any part, so that all that are chosen
    in the end are found here, but for the few that join parts of a capture.
    """

    def __init__(self, rigs: Sequence[Sequence[str]]) -> None:
        self._panoramas = {view: views[0] for views in rigs for view in views}
        self._photos: list[PhotoFeatures] = []
        self._nearest: list[list[int]] = []  # Of each photo, its matches with its nearest ones, the fewest first

    def __call__(self, photo: PhotoFeatures, largest: Mapping[int, Tensor]) -> list[tuple[int, int]]:
        """Return the pairs of a photo and those before it, the most similar ones first."""
        from sadgs_ns.placing.matching import count_shared

        counts: list[int] = []
        if self._photos:
            earlier = [largest[other.image_id] for other in self._photos]
            counts = count_shared(largest[photo.image_id], earlier)
        chosen = []
        for place in sorted(range(len(counts)), key=lambda i: -counts[i]):
            count = counts[place]
            is_near = len(chosen) < NEIGHBORS or count >= _least_of_nearest(self._nearest[place])
            if is_near and not self._is_same_panorama(photo, self._photos[place]):
                chosen.append(self._ordered(self._photos[place], photo))
        for place, count in enumerate(counts):
            bisect.insort(self._nearest[place], count)
            del self._nearest[place][:-NEIGHBORS]
        self._photos.append(photo)
        self._nearest.append(sorted(counts)[-NEIGHBORS:])
        return chosen

    def _is_same_panorama(self, one: PhotoFeatures, other: PhotoFeatures) -> bool:
        return self._panoramas.get(one.name, one.name) == self._panoramas.get(other.name, other.name)

    @staticmethod
    def _ordered(one: PhotoFeatures, other: PhotoFeatures) -> tuple[int, int]:
        """Return two images in the order of their names, as `matching.similar_photos` pairs them."""
        if one.name < other.name:
            return one.image_id, other.image_id
        return other.image_id, one.image_id


def _least_of_nearest(nearest: Sequence[int]) -> int:
    """Return how many matches the last of a photo's neighbours has, 0 as long as it has too few neighbours."""
    if len(nearest) < NEIGHBORS:
        return 0
    return nearest[0]
