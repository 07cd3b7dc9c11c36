"""The dense start of a run: stereo depth of its training photos, and points drawn from it."""

from __future__ import annotations

import torch

from sadgs_ns.geometry.dense_start import NUMBER, dense_points
from sadgs_ns.geometry.initialization import plausible_points
from sadgs_ns.geometry.stereo import depth_maps
from sadgs_ns.method.eta import wavelength
from sadgs_ns.method.quantization import dequantize
from sadgs_ns.render.rasterization import viewmats_from_camera_to_world
from sadgs_ns.training.pipeline import SadgsPipeline
from sadgs_ns.training.run.progress import note

FEWEST_VIEWS, MOST_VIEWS = 3, 60
"""Numbers of training views with which a run starts from stereo depth by default. With more views it brought no PSNR
and little else, for one to two seconds (docs/results.md#dense-start)."""


def number_of_points(pipeline: SadgsPipeline) -> int:
    """Return how many points of stereo depth a run may start from; print a line if CUDA is missing for them."""
    model = pipeline.model
    views = len(pipeline.datamanager.train_dataset)
    requested = model.config.stereo_points
    if model.seed_points is None or model.config.random_init:
        return 0
    if requested is not None:
        return requested
    if not FEWEST_VIEWS <= views <= MOST_VIEWS:
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
    if not number or resumed:
        return number > 0
    model = pipeline.model
    cache = pipeline.structure_cache
    cached = pipeline.datamanager.cached_train  # Undistorting images changes cameras.
    # Frames of a video that lie far apart tell more about depth.
    chosen = torch.linspace(0, len(cached) - 1, min(len(cached), MOST_VIEWS)).round().long()
    cameras = pipeline.datamanager.train_dataset.cameras[chosen]
    views = chosen.tolist()
    viewmats = viewmats_from_camera_to_world(cameras.camera_to_worlds)
    assert model.seed_points is not None
    points = model.seed_points[0]
    Ks = cameras.get_intrinsics_matrices()
    points = points[plausible_points(points)].to(model.device)
    # Images that stay compressed are decoded at each access: the host may have no room for all of them.
    masks = [d["mask"][..., 0].bool() if "mask" in d else None for d in (cached[view] for view in views)]
    depths = depth_maps(lambda i: cached[views[i]]["image"], viewmats, Ks, points, masks=masks, device=model.device)
    starts = dense_points(
        depths,
        viewmats,
        lambda i: cache.photo(cached[views[i]])[..., :3],
        lambda i: wavelength(dequantize(cache[views[i]])),
        number,
    )
    added = model.add_points(*starts)
    known = sum(float((d.confidence > 0).float().mean()) for d in depths) / len(depths)
    note(f"The start has {added:,} points of stereo depth, known in {known:.0%} of the pixels, beside the SfM points.")
    return True
