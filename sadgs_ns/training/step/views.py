"""The training views: which of them each step takes, and their images and cameras on the training device."""

from __future__ import annotations

import math
import random
from collections.abc import Mapping, Sequence
from functools import cached_property
from itertools import chain
from typing import Any

import torch
from nerfstudio.data.datamanagers.full_images_datamanager import FullImageDatamanager
from torch import Tensor

from sadgs_ns.data.cameras import check_undistortion
from sadgs_ns.distributed.bands import views_of_rank
from sadgs_ns.render.rasterization import viewmats_from_camera_to_world
from sadgs_ns.training.model import SadgsModel
from sadgs_ns.training.step.images import ImagePrefetcher, thread_count
from sadgs_ns.training.step.moved_regions import MovedRegions


class ViewSampler:
    """Draws the training views of each step. Each round has every view once, in an order that the seed decides.

    If a round ends inside a step, the step continues with views of the next round that it does not have yet; those it
    skips come first in the next step. So no view is drawn twice in a step, unless the step takes more than there are.
    """

    def __init__(self, num_views: int, seed: int) -> None:
        self.num_views = num_views
        self._generator = random.Random(seed)
        self._order: list[int] = []  # Views to come; another round is appended when a step needs it

    def draw(self, number: int) -> list[int]:
        """Return the indices of the next step's views."""
        return self._take_step(self._order, number)

    def foresee(self, number: int, steps: int) -> list[list[int]]:
        """Return what `draw` will return in the next steps, unless views are requeued."""
        order = [*self._order]
        return [self._take_step(order, number) for _ in range(steps)]

    def requeue(self, views: Sequence[int]) -> None:
        """Put these views first again, because their step did not count."""
        self._order[:0] = views

    def state_dict(self) -> dict[str, Any]:
        """Return the views to come and the state of the generator of later rounds."""
        return {"num_views": self.num_views, "order": [*self._order], "generator": self._generator.getstate()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue a saved order, unless the number of views has changed."""
        if state["num_views"] == self.num_views:
            self._order = [*state["order"]]
            self._generator.setstate(state["generator"])

    def _take_step(self, order: list[int], number: int) -> list[int]:
        """Take the views of a step from an order, the sampler's own or a copy of it."""
        step: list[int] = []
        while len(step) < number:
            # A step of more views than there are takes all of them before one comes again.
            num_rounds = len(step) // self.num_views
            drawn = step[num_rounds * self.num_views :]
            position = next((position for position, view in enumerate(order) if view not in drawn), None)
            if position is None:
                self._append_round(order)
            else:
                step.append(order.pop(position))
        return step

    def _append_round(self, order: list[int]) -> None:
        """Append another round to the sampler's own order, and to `order` if it is a copy."""
        views = list(range(self.num_views))
        self._generator.shuffle(views)
        self._order += views
        if order is not self._order:
            order += views


class TrainingViews:
    """Draws training views, the same in all processes, and gives their images and corrected cameras.

    Attributes:
        moved: Regions of photos that masks hide, too, because something moved there.
    """

    def __init__(self, datamanager: FullImageDatamanager, model: SadgsModel) -> None:
        self.datamanager = datamanager
        self.model = model
        self.sampler = ViewSampler(len(datamanager.train_dataset), datamanager.config.train_cameras_sampling_seed)
        self.moved = MovedRegions()

    def seed(self, seed: int) -> None:
        """Begin anew with rounds of views in an order that this seed decides."""
        self.sampler = ViewSampler(len(self), seed)

    def __len__(self) -> int:
        """Number of training views."""
        return self.sampler.num_views

    @cached_property
    def prefetcher(self) -> ImagePrefetcher | None:
        """Brings images from the host ahead of their step; None if all images are on the device."""
        config = self.datamanager.config
        if config.cache_images == "gpu":
            return None
        threads = thread_count(config.max_thread_workers)
        return ImagePrefetcher(self.datamanager.cached_train, self.model.device, threads)

    @cached_property
    def sizes(self) -> list[tuple[int, int]]:
        """Height and width in px of all training images."""
        _ = self.datamanager.cached_train  # Undistorting the images has changed their sizes.
        cameras = self.datamanager.train_dataset.cameras
        return list(zip(cameras.height.flatten().tolist(), cameras.width.flatten().tolist(), strict=True))

    def draw(self, number: int) -> list[tuple[int, Mapping[str, Any]]]:
        """Return index and data of each view of the next step, and prefetch images of later ones.

        The image is on the training device, and so is the mask if it was prefetched. With several processes, prefetched
        data is there only of views that this process composites. Raises as `ImagePrefetcher.take`.
        """
        indices = self.sampler.draw(number)
        prefetcher = self.prefetcher
        if prefetcher is None:
            cached = self.datamanager.cached_train
            device = self.model.device
            drawn = []
            for index in indices:
                image = cached[index]["image"].to(device, non_blocking=True)
                drawn.append((index, self.moved.masked(index, {**cached[index], "image": image})))
            return drawn
        data = prefetcher.take(self._composited(indices))
        share = math.ceil(number / self.model.world.num_ranks)  # Views of a step that a process loads
        threads = prefetcher.threads
        upcoming = self.sampler.foresee(number, 2 + math.ceil(threads / share))
        steps = [self._composited(step) for step in upcoming]
        # The number of views under way is the same in each step, so that none is forgotten before its step.
        most = max(threads + 2 * share, len(steps[0]))
        views = list(dict.fromkeys(chain(*steps)))  # Each once, in the order of the steps
        prefetcher.prefetch(views[:most], following=steps[0])
        return [(index, self.moved.masked(index, data.get(index, {}))) for index in indices]

    def cached(self, index: int) -> Mapping[str, Any]:
        """Data of a training view where the datamanager keeps it, with a mask that hides what moved, too."""
        return self.moved.masked(index, self.datamanager.cached_train[index])

    def _composited(self, indices: Sequence[int]) -> list[int]:
        """Return the views of a step, each once, of which this process composites rows."""
        world = self.model.world
        if not world.is_single:
            sizes = tuple(self.sizes[index] for index in indices)
            indices = [indices[position] for position in views_of_rank(sizes, world.num_ranks, world.rank)]
        return list(dict.fromkeys(indices))

    def close(self) -> None:
        """End the threads that decode images; they start again if another view is drawn."""
        if vars(self).get("prefetcher") is not None:
            vars(self)["prefetcher"].close()

    @cached_property
    def cameras(self) -> tuple[Sequence[Tensor], Sequence[Tensor]]:
        """World-to-camera matrices [4, 4] and intrinsics in px [3, 3] of all training views, made once.

        In a step, nerfstudio's cameras would make the host wait. Raises InputError if undistorting an image failed.
        """
        dataset = self.datamanager.train_dataset
        _ = self.datamanager.cached_train  # Undistorting the images has changed the intrinsics.
        cameras = dataset.cameras
        device = self.model.device
        check_undistortion(cameras, dataset.image_filenames)
        viewmats = viewmats_from_camera_to_world(cameras.camera_to_worlds)
        return viewmats.to(device).unbind(), cameras.get_intrinsics_matrices().to(device).unbind()

    def viewmat(self, index: int) -> Tensor:
        """World-to-camera matrix of a training view, as it is refined so far. [4, 4]"""
        if self.model.poses is not None:
            return self.model.poses.viewmat(index)
        viewmats, _ = self.cameras
        return viewmats[index]

    def stacked_cameras(self, indices: Sequence[int], refined: bool = True) -> tuple[Tensor, Tensor]:
        """World-to-camera matrices [V, 4, 4] and intrinsics in px [V, 3, 3] of V training views.

        The matrices are as refined so far, or the initial ones.
        """
        initial, every_K = self.cameras
        if refined:
            viewmats = [self.viewmat(index) for index in indices]
        else:
            viewmats = [initial[index] for index in indices]
        Ks = [every_K[index] for index in indices]
        n = len(indices)
        if n == 1:
            return viewmats[0][None], Ks[0][None]
        # This takes one copy on the device instead of two; both results are contiguous, as gsplat wants them.
        flat_viewmats, flat_Ks = torch.cat([matrix.flatten() for matrix in viewmats + Ks]).split([16 * n, 9 * n])
        return flat_viewmats.view(n, 4, 4), flat_Ks.view(n, 3, 3).detach()
