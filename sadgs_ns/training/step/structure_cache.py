"""The structure tensors of a run's images, and η's statistics in all training views."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property, partial
from typing import Any

import torch
from torch import Tensor

from sadgs_ns.distributed.bands import share_rows
from sadgs_ns.distributed.world import World
from sadgs_ns.method.quantization import quantize
from sadgs_ns.method.statistics import empty_statistics, observe
from sadgs_ns.method.structure_tensor import multiscale_structure_tensor
from sadgs_ns.render.types import Cameras
from sadgs_ns.training.step.images import stack_masks
from sadgs_ns.training.step.views import TrainingViews

PIXELS_PER_BATCH = 4_000_000  # Pixels of the images whose structure tensors are computed at once; each takes 300 bytes


class StructureCache:
    """Computes S̄ of images with a run's settings, and keeps that of the training images, quantized to bytes.

    If decoded images are kept on the device, so is their S̄, all computed at once. If they are on the host, S̄ of a view
    is computed when a step first needs it, and kept there. If they stay compressed, S̄ is not kept: it would be larger.

    Attributes:
        photo: Returns an image of the datamanager as the loss sees it: on the device and the background. [H, W, 3]
        of_images: `multiscale_structure_tensor` with the run's constant c of ω_l = c / σ_l and its other `options`.
    """

    def __init__(
        self,
        views: TrainingViews,
        device: torch.device,
        photo: Callable[[Mapping[str, Any]], Tensor],
        frequency_constant: float,
        **options: float | None,
    ) -> None:
        self.views = views
        self.photo = photo
        self.frequency_constant = frequency_constant
        self._device = device
        self.of_images = partial(multiscale_structure_tensor, frequency_constant=frequency_constant, **options)  # type: ignore[arg-type]
        self.filled = False
        self._kept: dict[int, Tensor] = {}

    def fill(self) -> None:
        """Load the training images, and compute S̄ of all if they are on the device, unless that was done before."""
        if self.filled:
            return
        images = self.views.datamanager.cached_train
        if self.views.prefetcher is None:
            by_size = defaultdict(list)
            for index, data in enumerate(images):
                by_size[data["image"].shape[:2]].append(index)
            for indices in by_size.values():
                tensors = self.quantized([self.views.cached(index) for index in indices])
                self._kept.update(zip(indices, tensors, strict=True))
        self.filled = True

    def __getitem__(self, index: int) -> Tensor:
        """Quantized S̄ of a training image, on the device. uint8 [H, W, 3]"""
        self.fill()
        if index in self._kept:
            return self._kept[index].to(self._device, non_blocking=True)
        return next(self.quantized([self.views.cached(index)]))

    def forget(self, indices: Sequence[int]) -> None:
        """Compute S̄ of some views anew, at once or when it is needed, because their masks have changed."""
        for index in indices:
            if index not in self._kept:
                continue
            if self.views.prefetcher is None:
                self._kept[index] = next(self.quantized([self.views.cached(index)]))
            else:
                del self._kept[index]

    def get(self, views: Sequence[tuple[int, Mapping[str, Any]]], world: World) -> list[Tensor]:
        """Return the quantized S̄ of a step's views of one size, in their order, on the device. uint8 [H, W, 3] each

        All processes of the world pass the same views; the one that composites a view's first rows computes its S̄.
        """
        self.fill()
        data = dict(views)
        height, width = self.views.sizes[views[0][0]]
        found = {index: self[index] for index in data if index in self._kept}
        bands = reversed(share_rows(len(views), height, world.num_ranks))
        ranks = {band.view: band.rank for band in bands}  # those of each view's first rows
        missing = {index: ranks[place] for place, (index, _) in enumerate(views) if index not in found}
        own = [index for index, rank in missing.items() if rank == world.rank]
        found.update(zip(own, self.quantized([data[index] for index in own]), strict=True))
        for index, rank in missing.items():
            if rank != world.rank:
                found[index] = torch.empty((height, width, 3), dtype=torch.uint8, device=world.device)
            world.broadcast(found[index], rank)
            if self._room:
                self._kept[index] = self._room[index].copy_(found[index], non_blocking=True)
        return [found[index] for index, _ in views]

    @cached_property
    def _room(self) -> list[Tensor]:
        """Host memory for S̄ of decoded images, uint8 [H, W, 3] each; pinning it later would wait for the device."""
        prefetcher = self.views.prefetcher
        if prefetcher is None or not prefetcher.decoded:
            return []
        pinned = self._device.type == "cuda"
        return [torch.empty((*size, 3), dtype=torch.uint8, pin_memory=pinned) for size in self.views.sizes]

    def quantized(self, data: Sequence[Mapping[str, Any]]) -> Iterator[Tensor]:
        """Yield quantized S̄ of the datamanager's images of one size, within their masks. uint8 [H, W, 3] each"""
        at_once = 1
        if data:
            at_once = max(PIXELS_PER_BATCH // math.prod(data[0]["image"].shape[:2]), 1)
        for start in range(0, len(data), at_once):
            batch = data[start : start + at_once]
            images = torch.stack([self.photo(d) for d in batch])
            masks = stack_masks(batch, images.shape[1:3], images.device)
            if masks is not None:
                masks = masks[..., 0]
            yield from quantize(self.of_images(images, masks, known_finite=True))


@torch.no_grad()
def observe_training_views(
    cache: StructureCache, progress: Callable[[range], Iterable[int]] = iter
) -> dict[str, Tensor]:
    """Observe η of the present Gaussians once in each training view; the run's random numbers do not change."""
    views = cache.views
    model = views.model
    model.set_crop(None)  # the viewer sets its crop box anew whenever it renders
    params = model.gauss_params
    generator = torch.Generator(model.device).manual_seed(0)
    statistics = empty_statistics(model.num_points, model.device)
    for index in progress(range(len(views))):
        tensors = cache[index][None]
        viewmats, Ks = views.stacked_cameras([index])
        cameras = Cameras(viewmats, Ks, tensors.shape[2], tensors.shape[1])
        _, _, info = model.render(cameras, model.color_options())
        info |= {"viewmats": viewmats, "Ks": Ks, "structure_tensors": tensors}
        jitter = torch.rand(info["means2d"].shape, generator=generator, device=model.device)
        observe(statistics, params, info, jitter)
    return statistics
