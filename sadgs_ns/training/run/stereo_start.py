"""The dense start of a run: stereo depth of its training photos, and points drawn from it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from sadgs_ns.data.cameras import mean_pixels
from sadgs_ns.geometry.dense_start import NUMBER, dense_points
from sadgs_ns.geometry.extents import plausible_points
from sadgs_ns.geometry.point_colors import apply_gains
from sadgs_ns.geometry.stereo import depth_maps
from sadgs_ns.method.eta import wavelength
from sadgs_ns.method.quantization import dequantize
from sadgs_ns.render.rasterization import viewmats_from_camera_to_world
from sadgs_ns.training.pipeline import SadgsPipeline
from sadgs_ns.training.run.progress import note

FEWEST_VIEWS = 3
"""Number of training views from which a run starts from stereo depth by default."""
MOST_VIEWS = 60
"""Largest number of views whose depth is found. More take longer and show little that these do not."""
PIXELS_OF_A_POINT = 30
"""Pixels of an image for each SfM point, up to which SfM's points are many enough by themselves. Captures have either
7 or 50 to 211 (docs/results.md#dense-start)."""


def number_of_points(pipeline: SadgsPipeline) -> int:
    """Return how many points of stereo depth a run may start from, and print a sentence if they need CUDA.

    0 if the run starts from no such points.
    """
    model = pipeline.model
    views = len(pipeline.datamanager.train_dataset)
    requested = model.config.stereo_points
    if model.seed_points is None or model.config.random_init:
        return 0
    if requested is not None:
        return requested
    cameras = pipeline.datamanager.train_dataset.cameras
    number_of_sfm_points = len(model.seed_points[0])
    has_many_points = number_of_sfm_points * PIXELS_OF_A_POINT >= mean_pixels(cameras)
    if views < FEWEST_VIEWS or has_many_points:
        return 0
    if pipeline.device.type != "cuda":
        note("The start has no points of stereo depth, which takes minutes on the CPU.")
        return 0
    return NUMBER


def start_from_stereo(pipeline: SadgsPipeline, resumed: bool) -> bool:
    """Add points of stereo depth to the initial Gaussians, if the options ask for some and no run is resumed.

    It loads the images. Returns whether the run starts, or started, from such points.
    """
    number = number_of_points(pipeline)
    if number == 0:
        return False
    if resumed:
        return True
    model = pipeline.model
    cache = pipeline.structure_cache
    images = pipeline.datamanager.cached_train  # Undistorting images changes the cameras, so this comes first.
    # Frames of a video that lie far apart tell more about depth.
    chosen = torch.linspace(0, len(images) - 1, min(len(images), MOST_VIEWS)).round().long()
    cameras = pipeline.datamanager.train_dataset.cameras[chosen]
    viewmats = viewmats_from_camera_to_world(cameras.camera_to_worlds)
    Ks = cameras.get_intrinsics_matrices()
    views = chosen.tolist()
    assert model.seed_points is not None
    points, _ = model.seed_points
    points = points[plausible_points(points)].to(model.device)
    masks = [_mask_of(images[view]) for view in views]

    # Images that stay compressed are decoded at each access: the host may have no room for all of them.
    def image_of(place: int) -> Tensor:
        return images[views[place]]["image"]

    def photo_of(place: int) -> Tensor:
        photo = cache.photo(images[views[place]])[..., :3]
        if model.exposure is None:
            return photo
        to_median = 1 / model.exposure.gains()[views[place]]
        return apply_gains(photo, to_median.to(photo)).clamp(0, 1)

    def wavelength_of(place: int) -> Tensor:
        return wavelength(dequantize(cache[views[place]]))

    depths = depth_maps(image_of, viewmats, Ks, points, masks=masks, device=model.device)
    means, colors, scales = dense_points(depths, viewmats, photo_of, wavelength_of, number)
    added = model.add_points(means, colors, scales)
    known = sum(float((depth.confidence > 0).float().mean()) for depth in depths) / len(depths)
    note(f"The start has {added:,} points of stereo depth, known in {known:.0%} of the pixels, beside the SfM points.")
    return True


def _mask_of(data: Mapping[str, Any]) -> Tensor | None:
    """Return the mask of a datamanager's image, bool [H, W]; None if it has none."""
    if "mask" not in data:
        return None
    return data["mask"][..., 0].bool()
