"""The colours that a capture's points have in its photos."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.data.datasets.base_dataset import InputDataset
from numpy.typing import NDArray
from torch import Tensor

from sadgs_ns.data.tracks import points_seen
from sadgs_ns.geometry.exposure import Observations
from sadgs_ns.geometry.point_colors import observe_points
from sadgs_ns.render.rasterization import viewmats_from_camera_to_world
from sadgs_ns.training.step.images import LazyImages, thread_count

_MOST_PROJECTED = 1_500_000
"""Most pairs of points and photos that are tried where no tracks tell which photo sees which point."""


class PointObservations:
    """Reads the colours of points [P, 3], in the run's frame, in photos of a dataset. Raises InputError.

    `source` is the file from which the points were read. If it has tracks, they tell which photo sees which point.
    Otherwise all points are projected, and those that lie behind others are left out.
    """

    def __init__(self, points: Tensor, source: Path | None, dataset: InputDataset, device: torch.device) -> None:
        self.points = points.to(device)
        self.dataset = dataset
        self.seen: list[NDArray[np.int64]] | None = None
        if source is not None:
            self.seen = points_seen(source, dataset.image_filenames)

    @property
    def has_tracks(self) -> bool:
        """Whether tracks tell which photo sees which point."""
        return self.seen is not None

    def of_all(self, images: Sequence[Mapping[str, Any]]) -> Observations:
        """Return the observations in all photos, whose data the datamanager holds."""
        indices = range(len(self.dataset))
        if not isinstance(images, LazyImages):
            return _joined([self._in_photo(index, images[index]) for index in indices])
        with ThreadPoolExecutor(thread_count(None)) as pool:  # Each photo is decoded, used and dropped.
            found = list(pool.map(lambda index: self._in_photo(index, images[index]), indices))
        return _joined(found)

    def of_one(self, index: int, data: Mapping[str, Any]) -> Observations:
        """Return the observations in one photo, which counts as photo 0."""
        found = self._in_photo(index, data)
        return Observations(np.zeros_like(found.views), found.points, found.stops)

    def _in_photo(self, index: int, data: Mapping[str, Any]) -> Observations:
        device = self.points.device
        candidates = self._candidates(index).to(device)
        mask = data.get("mask")
        if mask is not None:
            mask = mask[..., 0].bool().to(device)
        cameras = self.dataset.cameras
        found, stops = observe_points(
            data["image"].to(device),
            mask,
            viewmats_from_camera_to_world(cameras.camera_to_worlds[index : index + 1])[0].to(device),
            cameras[index].get_intrinsics_matrices().to(device),
            self.points[candidates],
            visible=self.has_tracks,
        )
        views = np.full(len(found), index)
        return Observations(views, candidates[found].cpu().numpy(), stops.cpu().numpy())

    def _candidates(self, index: int) -> Tensor:
        """Return the indices of points to look for in a photo. int64 [Q]"""
        if self.seen is not None:
            return torch.from_numpy(self.seen[index])
        every = math.ceil(len(self.points) * len(self.dataset) / _MOST_PROJECTED)
        return torch.arange(0, len(self.points), max(every, 1))


def _joined(parts: Sequence[Observations]) -> Observations:
    """Return the observations of several photos as one."""
    return Observations(
        np.concatenate([part.views for part in parts]),
        np.concatenate([part.points for part in parts]),
        np.concatenate([part.stops for part in parts]),
    )
