"""The structure tensors of a run's images, and η's statistics in all training views."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from sadgs_ns.distributed.bands import first_ranks, share_out
from sadgs_ns.distributed.world import World
from sadgs_ns.method.quantization import quantize
from sadgs_ns.method.statistics import empty_statistics, observe
from sadgs_ns.method.structure_tensor import multiscale_structure_tensor
from sadgs_ns.plugin.views import TrainingViews

PIXELS_PER_BATCH = 4_000_000
"""Structure tensors are computed for as many images at once as have this many pixels; each pixel takes at most about
300 bytes meanwhile."""


class StructureMaps:
    """Computes S̄ of images with a run's settings, and keeps its codes for the training images.

    The frequency constant is c of ω_l = c / σ_l in 1/px, and the options are others of `multiscale_structure_tensor`.
    """

    def __init__(self, views: TrainingViews, frequency_constant: float, **options: float | None) -> None:
        self.views = views
        self.frequency_constant = frequency_constant
        self.options = options

    @cached_property
    def codes(self) -> Sequence[Tensor]:
        """Codes (`quantization.quantize`) of S̄ of every training image, on the device. uint8 [H, W, 3] each

        Where the images are on the host, those of a view are computed whenever they are asked for.
        """
        cached = self.views.datamanager.cached_train
        if self.views.ahead is not None:
            return _CodesOnDemand(self, cached)
        by_size = defaultdict(list)
        for index, data in enumerate(cached):
            by_size[data["image"].shape[:2]].append(index)
        codes: list[Tensor] = [torch.empty(0)] * len(cached)
        for indices in by_size.values():
            of_size = self._in_batches([cached[index] for index in indices])
            for index, code in zip(indices, of_size, strict=True):
                codes[index] = code
        return codes

    def of_views(self, views: Sequence[tuple[int, dict[str, Any]]], world: World) -> list[Tensor]:
        """Codes of S̄ of a step's views, which have one size. uint8 [H, W, 3] each

        Where images are on the host, codes that are not known yet are computed, and kept where there is room. All of
        several processes observe η, and the one that composites a view's first rows computes its codes for the others.

        Args:
            views: Number and data of each, as drawn.
            world: The processes of the run, all of which call this with the same views.
        """
        ahead = self.views.ahead
        if ahead is None:
            return [self.codes[index] for index, _ in views]
        for index, data in views:
            # All processes keep the same codes, while those that came with a view may have missed the last step's.
            if "codes" not in data and (kept := ahead.kept_codes(index)) is not None:
                data["codes"] = kept
        missing = [position for position, (_, data) in enumerate(views) if "codes" not in data]
        height, width = self.views.sizes[views[0][0]]
        ranks = first_ranks(share_out(len(views), height, world.num_ranks))
        own = [views[p][1] for p in missing if ranks[p] == world.rank]
        for data, codes in zip(own, self._in_batches(own), strict=True):
            data["codes"] = codes
        for position in missing:
            index, data = views[position]
            if ranks[position] != world.rank:
                data["codes"] = torch.empty((height, width, 3), dtype=torch.uint8, device=world.device)
            world.broadcast(data["codes"], ranks[position])
            ahead.keep_codes(index, data["codes"])
        return [data["codes"] for _, data in views]

    def _in_batches(self, data: Sequence[Mapping[str, Any]]) -> Iterator[Tensor]:
        """Yield the codes of S̄ of images that have one size, computing those of several at once."""
        at_once = max(PIXELS_PER_BATCH // math.prod(data[0]["image"].shape[:2]), 1) if data else 1
        for start in range(0, len(data), at_once):
            yield from self.codes_of(data[start : start + at_once])

    def photo(self, data: Mapping[str, Any]) -> Tensor:
        """An image of the datamanager as the loss sees it: on the training device and on the background. [H, W, 3]"""
        model = self.views.model
        return model.composite_with_background(model.get_gt_img(data["image"]), model.background)

    def codes_of(self, data: Sequence[Mapping[str, Any]]) -> Tensor:
        """Codes of S̄ of the datamanager's images of one size, within their masks, on the device. uint8 [B, H, W, 3]"""
        images = torch.stack([self.photo(d) for d in data])
        masks = None
        if any("mask" in d for d in data):
            everything = torch.ones(images.shape[1:3], dtype=torch.bool, device=images.device)
            masks = torch.stack([d["mask"][..., 0].to(images.device) if "mask" in d else everything for d in data])
        return quantize(self.of_images(images, masks, known_finite=True))

    def of_images(
        self,
        images: Tensor,  # [B, H, W, 3]
        masks: Tensor | None = None,  # [B, H, W]
        known_finite: bool = False,
    ) -> Tensor:
        """S̄ of images in [0, 1], where they have one, within their masks. [B, H, W, 3]"""
        return multiscale_structure_tensor(
            images,
            masks,
            frequency_constant=self.frequency_constant,
            known_finite=known_finite,
            **self.options,  # type: ignore[arg-type]
        )


class _CodesOnDemand(Sequence[Tensor]):
    """Codes of S̄ of images that are not on the device."""

    def __init__(self, maps: StructureMaps, images: Sequence[Mapping[str, Any]]) -> None:
        self._maps, self._images = maps, images

    def __len__(self) -> int:
        return len(self._images)

    def __getitem__(self, index: Any) -> Any:
        return self._maps.codes_of([self._images[index]])[0]


@torch.no_grad()
def observe_training_views(maps: StructureMaps, progress: Callable[[range], Iterable[int]] = iter) -> dict[str, Tensor]:
    """η's statistics of the Gaussians as they are, in one look at each training view, as `statistics.empty_statistics`.

    The samples are drawn from a generator of their own: a run that is watched goes on as if it were not. `progress`
    wraps the numbers of the views, to show how far the work is.
    """
    views, model = maps.views, maps.views.model
    model.set_crop(None)  # the viewer sets its crop box anew whenever it renders
    params = model.gauss_params
    generator = torch.Generator(model.device).manual_seed(0)
    statistics = empty_statistics(model.num_points, model.device)
    for index in progress(range(len(views))):
        codes, (viewmats, Ks) = maps.codes[index].to(model.device)[None], views.stacked_cameras([index])
        _, _, info = model.render(viewmats, Ks, codes.shape[2], codes.shape[1], "RGB")
        observe(
            statistics, params, info | {"viewmats": viewmats, "Ks": Ks, "structure_tensors": codes}, generator=generator
        )
    return statistics
