"""Find what moved while the photos were taken, at a few times of a run, and leave it out from there on."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from itertools import groupby, islice
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image
from torch import Tensor

from sadgs_ns.distributed.rasterization import rasterize
from sadgs_ns.files import atomic_path
from sadgs_ns.geometry import moved
from sadgs_ns.geometry.moved import Group, SmallView, Spread
from sadgs_ns.geometry.stereo_neighbours import choose_neighbours
from sadgs_ns.method.schedule import DENSIFICATION_SHARE
from sadgs_ns.render.types import Cameras, Gaussians
from sadgs_ns.training.photo_names import common_folder, paths_from
from sadgs_ns.training.run.progress import warn
from sadgs_ns.training.step.color_matrices import anchored, correct_colors
from sadgs_ns.training.step.images import thread_count
from sadgs_ns.training.step.structure_cache import StructureCache

JUDGED_AT = (1 / 4, 1 / 2, 1.0, 11 / 8)
"""Times of judging as shares of densification, each an iteration before Gaussians are added, removed or reset. Later
ones take wrong verdicts back, and find what the first left."""
FEWEST_VIEWS = 3
"""Training views from which something can be found: others must deny what one shows."""
MASKS = "masks"
"""Name of the folder, in a run's, for masks of the photos in which something moved."""
_FEWEST_TOGETHER = 4  # Views that are drawn at once, which takes less time than one after another
_MOST_TOGETHER = 16
_GAUSSIANS_TOGETHER = 2**22  # Gaussians, counted in each view, from which the fewest views are drawn at once
_PIXELS_TOGETHER = 2**23  # Pixels of photos that are reduced at once, in arrays of 100 MB
_COVERED = 0.5  # Opacity from which a pixel's depth is that of something
_VALID = 0.99  # Share of a small pixel that masks must leave


@dataclass(frozen=True)
class Verdict:
    """The evidence of all views, and what follows from it."""

    groups: list[Group]
    excesses: list[Tensor]  # Of all views; NaN where unknown. [h, w] each
    limits: Spread
    regions: dict[int, Tensor]  # By view, 1 where something moved. uint8 [h, w]

    def view(self, index: int) -> SmallView:
        """Return a training view as it was compared."""
        for group in self.groups:
            if index in group.place_of:
                return group.view(group.place_of[index])
        raise IndexError(f"there is no view {index}")


@lru_cache(maxsize=8)
def judged_steps(iterations: int, refine_stop_iter: int) -> frozenset[int]:
    """Return the steps after which a run judges, given its length and the end of its densification, 0 if it has none.

    Steps are counted from 0.
    """
    end = refine_stop_iter
    if end == 0:
        end = round(DENSIFICATION_SHARE * iterations)
    steps = [round(share * end) - 2 for share in JUDGED_AT]
    return frozenset(step for step in steps if 0 <= step < iterations - 1)


class MovedSearch:
    """Judges the training views of a run, and tells the views and their structure tensors what to leave out."""

    def __init__(self, structure_cache: StructureCache) -> None:
        self._cache = structure_cache
        self._views = structure_cache.views
        self._model = structure_cache.views.model

    def is_due(self, step: int) -> bool:
        """Tell whether the views are judged after a step."""
        if len(self._views) < FEWEST_VIEWS:
            return False
        return step in judged_steps(self._model.plan.iterations, self._model.strategy.windows.refine_stop_iter)

    def judge(self) -> None:
        """Judge all training views anew, and leave out what moved by the present Gaussians.

        All processes call this. Nothing is random, and nothing of the run changes if nothing is found. One process
        keeps what it left out if the device's memory is full, and prints that.
        """
        world = self._model.strategy.world
        try:
            groups = self._small_views()
            found: dict[int, Tensor] = {}
            if world.rank == 0:
                found = verdict(groups, self._threads).regions
        except torch.cuda.OutOfMemoryError:
            if not world.is_single:  # The others would wait for this one.
                raise
            warn(f"Iteration {self._model.step + 1}: the device's memory is too full to find what moved.")
            return
        if not world.is_single:
            found = self._shared(found)
        self._cache.forget(self._views.moved.replace(found))

    @torch.no_grad()
    def _small_views(self) -> list[Group]:
        """Draw all training views at working size, and compare them with their photos; only rank 0 returns them."""
        gaussians, _ = self._model.gaussians()
        is_first = self._model.strategy.world.rank == 0
        photos = self._photos()
        views = []
        for indices in self._batches():
            colors, depths, cameras = self._draw(gaussians, indices)
            if not is_first:
                continue
            data = list(islice(photos, len(indices)))
            small_photos, valid = self._small_photos(data, (cameras.height, cameras.width))
            differences = moved.difference(small_photos, colors, valid)
            structures = moved.structure(small_photos, colors, valid)
            parts = (differences, structures, depths, valid, cameras.viewmats, cameras.Ks)
            views += [SmallView(*of_view) for of_view in zip(*parts, strict=True)]
        return moved.grouped(views)

    def _batches(self) -> Iterator[list[int]]:
        """Yield the training views in their order, as many at once as are drawn together; these have one size."""
        number = max(self._model.num_gaussians, 1)
        together = min(max(_GAUSSIANS_TOGETHER // number, _FEWEST_TOGETHER), _MOST_TOGETHER)
        for _, views in groupby(range(len(self._views)), key=lambda index: self._views.sizes[index]):
            same_size = list(views)
            for start in range(0, len(same_size), together):
                yield same_size[start : start + together]

    @property
    def _threads(self) -> int:
        """Number of threads that decode images and search regions."""
        return thread_count(self._views.datamanager.config.max_thread_workers)

    def _photos(self) -> Iterator[Mapping[str, Any]]:
        """Yield the datamanager's data of all training views in their order; threads decode compressed images."""
        images = self._views.datamanager.cached_train
        if isinstance(images, list):
            yield from images
            return
        threads = self._threads
        with ThreadPoolExecutor(threads) as pool:
            for start in range(0, len(images), 2 * threads):  # The host may have no room for all.
                yield from pool.map(images.__getitem__, range(start, min(start + 2 * threads, len(images))))

    def _draw(self, gaussians: Gaussians, indices: Sequence[int]) -> tuple[Tensor, Tensor, Cameras]:
        """Draw V views of one size, at working size and with the gains of their photos.

        All processes call this. Each draws some rows, and all get the whole pictures.

        Returns:
            Colours in [0, 1] [V, 3, h, w], depths [V, h, w], 0 where little is drawn, and the cameras at working size.
        """
        model = self._model
        world = model.strategy.world
        full_height, full_width = self._views.sizes[indices[0]]
        height, width = moved.working_size((full_height, full_width))
        viewmats, Ks = self._views.stacked_cameras(indices)
        scale = Ks.new_tensor([width / full_width, height / full_height, 1.0])
        cameras = Cameras(viewmats, Ks * scale[:, None], width, height)
        view_ids = model.view_ids(indices)
        options = model.color_options(expected_depth=True)
        pictures, _ = rasterize(world, gaussians, cameras, options, model.color_maps(view_ids))
        canvas = viewmats.new_zeros((len(indices), height, width, 5))  # Colour, depth and alpha
        for band, rendered, opacity in pictures:
            joined = torch.cat([rendered, opacity], dim=-1)
            if band is None:
                canvas = joined
            else:
                rows = slice(band.first - band.top, band.last - band.top)
                canvas[band.view, band.first : band.last] = joined[0, rows]
        world.sum(canvas)
        colors = canvas[..., :3].contiguous()
        alphas = canvas[..., 4:].contiguous()
        if model.color_matrices is not None and view_ids is not None:
            colors = correct_colors(colors, alphas, anchored(model.color_matrices, view_ids))
        colors = model.before_background(colors, alphas, model.background).clamp(0, 1)
        depths = torch.where(alphas[..., 0] > _COVERED, canvas[..., 3], 0.0)
        return colors.movedim(-1, 1), depths, cameras

    @torch.no_grad()
    def pictures(self, index: int) -> tuple[Tensor, Tensor]:
        """Return the photo of a view and its rendering at working size; all processes call this. [3, h, w] each"""
        gaussians, _ = self._model.gaussians()
        colors, _, cameras = self._draw(gaussians, [index])
        data = self._views.datamanager.cached_train[index]
        photos, _ = self._small_photos([data], (cameras.height, cameras.width))
        return photos[0], colors[0]

    def _small_photos(self, data: Sequence[Mapping[str, Any]], size: tuple[int, int]) -> tuple[Tensor, Tensor]:
        """Return V photos in [0, 1] [V, 3, h, w], and where no mask hides them, bool [V, h, w], at a size in px."""
        height, width = data[0]["image"].shape[:2]
        together = max(_PIXELS_TOGETHER // (height * width), 1)
        photos = []
        for start in range(0, len(data), together):
            for same_kind in _of_one_kind(data[start : start + together]):
                images = torch.stack([view["image"].to(self._model.device) for view in same_kind])
                photos.append(_reduced(self._model.photo({"image": images}), size))
        valid = torch.ones((len(data), *size), dtype=torch.bool, device=self._model.device)
        for place, view in enumerate(data):
            if "mask" in view:
                valid[place] = _reduced(view["mask"].to(photos[0])[None], size)[0, 0] > _VALID
        return torch.cat(photos), valid

    def _shared(self, found: Mapping[int, Tensor]) -> dict[int, Tensor]:
        """Return the regions that rank 0 found, in all processes."""
        world = self._model.strategy.world
        number = len(self._views)
        flags = torch.tensor([int(view in found) for view in range(number)], device=world.device)
        world.broadcast(flags, 0)
        shared = {}
        for view in flags.nonzero()[:, 0].tolist():
            size = moved.working_size(self._views.sizes[view])
            region = found.get(view, torch.zeros(size, dtype=torch.uint8, device=world.device)).contiguous()
            world.broadcast(region, 0)
            shared[view] = region
        return shared

    def evidence(self) -> Verdict:
        """Judge all training views by the present Gaussians, and return the verdict without leaving anything out."""
        return verdict(self._small_views(), self._threads)

    def report(self, folder: Path) -> None:
        """Print how much is left out, and write masks of the photos into a run's folder; nothing if nothing moved.

        Raises WriteError if the disk is full.
        """
        regions = self._views.moved
        if not len(regions):
            return
        shares = [regions.share(view) for view in regions.views]
        mean = sum(shares) / len(shares)
        written = self._write_masks(folder / MASKS)
        warn(
            f"Something moved in {len(regions)} of {len(self._views)} training photos, in {mean:.1%} of their pixels, "
            f"which were left out: see {written}. --pipeline.find-moved False leaves nothing out."
        )

    def _write_masks(self, folder: Path) -> Path:
        """Write a black and white mask of each photo that has a region, and return the folder."""
        files = self._views.datamanager.train_dataset.image_filenames
        names = paths_from(common_folder(files), files)
        images = self._views.datamanager.cached_train
        for view in self._views.moved.views:
            data = self._views.moved.masked(view, images[view])
            # A picture of one bit takes a hundredth of the time.
            picture = Image.fromarray(data["mask"][..., 0].cpu().numpy())
            name = names[view].with_suffix(".png")
            with atomic_path(folder / name) as partial:
                picture.save(partial, format="PNG")
        return folder


def verdict(groups: Sequence[Group], threads: int = 1) -> Verdict:
    """Judge views by each other; threads search regions side by side."""
    points = moved.surface_points(groups)
    num_views = sum(len(group.members) for group in groups)
    neighbours = [[] for _ in range(num_views)]
    if len(points):
        viewmats = points.new_zeros((num_views, 4, 4))
        Ks = points.new_zeros((num_views, 3, 3))
        sizes = points.new_zeros((num_views, 2))
        for group in groups:
            height, width = group.size
            viewmats[group.members] = group.viewmat.double()
            Ks[group.members] = group.K.double()
            sizes[group.members] = points.new_tensor([width, height])
        chosen = choose_neighbours(viewmats, Ks, sizes, points, moved.NEIGHBOURS).tolist()
        neighbours = [[other for other in row if other >= 0] for row in chosen]
    excesses = moved.excesses(groups, neighbours)
    limits = moved.spread(excesses)
    regions = {}
    for index, region in moved.regions(groups, excesses, limits, threads).items():
        regions[index] = torch.from_numpy(region.view(np.uint8)).to(points.device)
    return Verdict(list(groups), excesses, limits, regions)


def _of_one_kind(data: Sequence[Mapping[str, Any]]) -> Iterator[list[Mapping[str, Any]]]:
    """Yield photos in their order, as many at once as have one number of channels and one type."""

    def kind(view: Mapping[str, Any]) -> tuple[int, torch.dtype]:
        return view["image"].shape[-1], view["image"].dtype

    for _, views in groupby(data, key=kind):
        yield list(views)


def _reduced(
    images: Tensor,  # Floats [V, H, W, C]
    size: tuple[int, int],  # Height and width in px
) -> Tensor:
    """Reduce images to a size. [V, C, h, w]"""
    planes = images.movedim(-1, 1)
    if planes.shape[2:] == size:
        return planes
    return F.interpolate(planes, size, mode="area")
