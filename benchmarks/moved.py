"""What a run found to have moved: how much of it is right, and `python -m benchmarks evidence RUN` for pictures of why.

In copies that `disturbed` writes it is known what is in some photos only. Of rows that find what moved, these fields
are in the results:

- `moved_iou`: overlap of found and true regions, intersection over union, mean over the disturbed training photos;
- `moved_share`: share of all training photos' pixels that are left out;
- `moved_wrong`: share of all training photos' pixels that are left out, and show the same as in the other photos.

A picture has a photo, its rendering, and the photo with what is found in red and true outlines in green; below them the
difference of the two, its excess over other views' differences, both fourfold, and in white where that is unknown.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage
from torch import Tensor
from tyro.conf import Positional

from benchmarks.disturbed import IMAGES, MASKS
from benchmarks.trained_run import load_pipeline

Mask = NDArray[np.bool_]
_GAIN = 4  # By which differences are brighter in pictures
_RED = np.array([255, 0, 0], np.uint8)
_GREEN = np.array([0, 255, 0], np.uint8)


def true_region(photo: Path, size: tuple[int, int]) -> Mask | None:
    """Return what is in this photo of a copy alone, at a size in px; None if nothing is, or it is not known. [H, W]"""
    folders = [folder for folder in photo.parents if folder.name == IMAGES]
    if not folders:
        return None
    mask = folders[0].parent / MASKS / photo.relative_to(folders[0]).with_suffix(".png")
    if not mask.exists():
        return None
    height, width = size
    with Image.open(mask) as image:
        reduced = image.convert("L").resize((width, height), Image.Resampling.BOX)
    return np.asarray(reduced) < 128


def overlap(found: Mask, true: Mask) -> float:
    """Return the intersection of two regions over their union, 1 if both are empty."""
    union = int((found | true).sum())
    if union == 0:
        return 1.0
    return int((found & true).sum()) / union


def measures(pipeline: Any) -> dict[str, float | None]:
    """Return the fields of a results' row, as at the top of this module; none if the run was not to find anything."""
    if not getattr(pipeline.config, "find_moved", False):
        return {}
    files = pipeline.datamanager.train_dataset.image_filenames
    overlaps = []
    num_left_out = 0
    num_wrong = 0
    num_pixels = 0
    for view, file in enumerate(files):
        height, width = pipeline.views.sizes[view]
        found = pipeline.views.moved.hidden(view, (height, width)).cpu().numpy()
        true = true_region(file, (height, width))
        if true is None:
            true = np.zeros_like(found)
        else:
            overlaps.append(overlap(found, true))
        num_left_out += int(found.sum())
        num_wrong += int((found & ~true).sum())
        num_pixels += found.size
    iou = None
    if overlaps:
        iou = sum(overlaps) / len(overlaps)
    return {"moved_iou": iou, "moved_share": num_left_out / num_pixels, "moved_wrong": num_wrong / num_pixels}


def picture(evidence: Any, photo: Tensor, drawn: Tensor, true: Mask | None) -> NDArray[np.uint8]:
    """Return the picture of a view's evidence: one of the verdict's views, its photo and its rendering [3, h, w]."""
    view, excess, region = evidence
    marked = _bytes(photo)
    if region is not None:
        inside = region.cpu().numpy() > 0
        marked[inside] = marked[inside] // 2 + _RED // 2
    if true is not None:
        inner: Any = ndimage.binary_erosion(true)
        marked[true & ~inner] = _GREEN
    unknown = excess.isnan().to(excess)
    upper = [_bytes(photo), _bytes(drawn), marked]
    lower = [_grey(_GAIN * view.difference), _grey(_GAIN * excess.nan_to_num()), _grey(unknown)]
    return np.vstack([np.hstack(upper), np.hstack(lower)])


def _bytes(image: Tensor) -> NDArray[np.uint8]:
    """[3, h, w] in [0, 1] → [h, w, 3]"""
    return (255 * image.clamp(0, 1)).round().to(torch.uint8).movedim(0, -1).cpu().numpy().copy()


def _grey(values: Tensor) -> NDArray[np.uint8]:
    """[h, w] in [0, 1] → [h, w, 3]"""
    return _bytes(values.expand(3, -1, -1))


@dataclass
class Command:
    """Judge what moved by a checkpoint of a run, and draw the evidence of some photos."""

    config: Positional[Path]
    """config.yml of the run"""
    output: Path
    """folder for the pictures"""
    only: str = ""
    """names of photos, without suffix, with commas between; the default are all in which something is found or true"""
    step: int | None = None
    """step of the checkpoint; the default is the last (a run keeps more with --save-only-latest-checkpoint False)"""

    def __call__(self) -> int:
        pipeline = load_pipeline(self.config, self.step)
        search = pipeline.moved_search
        verdict = search.evidence()
        limits = verdict.limits
        print(f"Excess: median {limits.median:.4f}, deviation {limits.deviation:.4f}.")
        print(f"Limits: {limits.weak:.3f} and {limits.strong:.3f}.")
        self.output.mkdir(parents=True, exist_ok=True)
        files: Sequence[Path] = pipeline.datamanager.train_dataset.image_filenames
        for index, file in enumerate(files):
            view = verdict.view(index)
            size = view.size
            true = true_region(file, size)
            region = verdict.regions.get(index)
            wanted = file.stem in self.only.split(",")
            if not self.only:
                wanted = true is not None or region is not None
            if not wanted:
                continue
            photo, drawn = search.pictures(index)
            drawing = picture((view, verdict.excesses[index], region), photo, drawn, true)
            Image.fromarray(drawing).save(self.output / f"{file.stem}.png")
            print(f"{file.name}: {_describe(region, true, size)}", flush=True)
        return 0


def _describe(region: Tensor | None, true: Mask | None, size: tuple[int, ...]) -> str:
    """Say how much is found in a photo, and how much of it is true."""
    found = np.zeros(size, np.bool_)
    if region is not None:
        found = region.cpu().numpy() > 0
    text = f"{found.mean():.1%} found"
    if true is not None:
        text += f", {true.mean():.1%} true, overlap {overlap(found, true):.2f}"
    return text
