"""The structure tensors of a run's images, and η's statistics in all training views."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from sadgs_ns.method.codes import encode
from sadgs_ns.method.statistics import empty_statistics, observe
from sadgs_ns.method.structure_tensor import multiscale_structure_tensor
from sadgs_ns.plugin.views import TrainingViews

PIXELS_PER_BATCH = 4_000_000
"""Structure tensors are computed for as many images at once as have this many pixels; each pixel takes at most about
300 bytes meanwhile."""


class StructureMaps:
    """Computes S̄ of images with a run's settings, and keeps its codes for the training images.

    Args:
        views: The training views.
        frequency_constant: c of ω_l = c / σ_l in 1/px.
        options: What else `multiscale_structure_tensor` is called with.
    """

    def __init__(self, views: TrainingViews, frequency_constant: float, **options: float | None) -> None:
        self.views = views
        self.frequency_constant = frequency_constant
        self.options = options

    @cached_property
    def codes(self) -> list[Tensor]:
        """Codes (`codes.encode`) of S̄ of every training image, where the images are cached. uint8 [H, W, 3] each"""
        cached = self.views.datamanager.cached_train
        by_size = defaultdict(list)
        for index, data in enumerate(cached):
            by_size[data["image"].shape[:2]].append(index)
        codes: list[Tensor] = [torch.empty(0)] * len(cached)
        for (height, width), indices in by_size.items():
            batch_size = max(PIXELS_PER_BATCH // (height * width), 1)
            for start in range(0, len(indices), batch_size):
                batch = indices[start : start + batch_size]
                for index, code in zip(batch, self.codes_of([cached[index] for index in batch]), strict=True):
                    moved = code.to(cached[index]["image"].device)
                    # nerfstudio pins the images that it leaves on the host, too: a step's copy then stops nobody.
                    on_host = code.device.type == "cuda" and moved.device.type == "cpu"
                    codes[index] = moved.pin_memory() if on_host else moved
        return codes

    def photo(self, data: Mapping[str, Any]) -> Tensor:
        """An image of the datamanager as the loss sees it: on the training device and on the background. [H, W, 3]"""
        model = self.views.model
        background = model.photo_background.to(model.device)
        return model.composite_with_background(model.get_gt_img(data["image"]), background).to(model.device)

    def codes_of(self, data: Sequence[Mapping[str, Any]]) -> Tensor:
        """Codes of S̄ of images of the datamanager that have one size.

        Args:
            data: The images, with their masks where they have any.

        Returns:
            On the training device. uint8 [B, H, W, 3]
        """
        images = torch.stack([self.photo(d) for d in data])
        masks = None
        if any("mask" in d for d in data):
            everything = torch.ones(images.shape[1:3], dtype=torch.bool, device=images.device)
            masks = torch.stack([d["mask"][..., 0].to(images.device) if "mask" in d else everything for d in data])
        return encode(self.of_images(images, masks), self.views.model.config.fused)

    def of_images(
        self,
        images: Tensor,  # [B, H, W, 3]
        masks: Tensor | None = None,  # [B, H, W]
    ) -> Tensor:
        """S̄ of images in [0, 1], where they have one, within their masks. [B, H, W, 3]"""
        return multiscale_structure_tensor(
            images,
            masks,
            frequency_constant=self.frequency_constant,
            fused=self.views.model.config.fused,
            **self.options,  # type: ignore[arg-type]
        )


@torch.no_grad()
def observe_training_views(maps: StructureMaps, progress: Callable[[range], Iterable[int]] = iter) -> dict[str, Tensor]:
    """η's statistics of the Gaussians as they are, in one look at each training view.

    The samples are drawn from a generator of their own: a run that is watched goes on as if it were not.

    Args:
        maps: The run's structure tensors.
        progress: Wraps the numbers of the views, to show how far the work is.

    Returns:
        As `statistics.empty_statistics`.
    """
    views, model = maps.views, maps.views.model
    model.set_crop(None)  # the viewer sets its crop box anew whenever it renders
    strategy, params = model.strategy, model.gauss_params
    generator = torch.Generator(model.device).manual_seed(0)
    statistics = empty_statistics(model.num_points, model.device)
    for index in progress(range(len(views))):
        codes, (viewmats, Ks) = maps.codes[index].to(model.device)[None], views.stacked_cameras([index])
        _, _, info = model.render(viewmats, Ks, codes.shape[2], codes.shape[1], "RGB")
        observe(
            statistics,
            params,
            info | {"viewmats": viewmats, "Ks": Ks, "structure_tensors": codes},
            generator=generator,
            fused=strategy.fused,
        )
    return statistics
