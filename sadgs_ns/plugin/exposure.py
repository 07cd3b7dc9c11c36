"""What the training photos tell of their exposure, and what a run makes of that."""

from __future__ import annotations

import numpy as np
import torch
from nerfstudio.cameras.cameras import CameraType
from nerfstudio.data.datasets.base_dataset import InputDataset

from sadgs_ns.data.exposure import Exposures, PinholeViews, exposures
from sadgs_ns.plugin.model import SadgsModel
from sadgs_ns.render.rasterization import viewmats_from_camera_to_world


def exposures_of(dataset: InputDataset) -> Exposures | None:
    """Find out how much the exposure of the photos of a dataset varies, as `data.exposure.exposures` does.

    Args:
        dataset: Photos with their cameras before they are undistorted, and SfM points where there are some.

    Returns:
        Their exposures; None where neither EXIF nor SfM points tell.
    """
    cameras = dataset.cameras.to("cpu")
    pinholes = bool((cameras.camera_type == CameraType.PERSPECTIVE.value).all())
    points, colors = (dataset.metadata.get(f"points3D_{name}") for name in ("xyz", "rgb"))
    if points is None or colors is None or not pinholes:  # EXIF alone may tell.
        points, colors = torch.zeros((0, 3)), torch.zeros((0, 3), dtype=torch.uint8)
    intrinsics = torch.cat(
        [
            cameras.fx / cameras.width,
            cameras.fy / cameras.height,
            cameras.cx / cameras.width,
            cameras.cy / cameras.height,
        ],
        dim=-1,
    )
    distortion = cameras.distortion_params
    views = PinholeViews(
        files=dataset.image_filenames,
        world_to_camera=viewmats_from_camera_to_world(cameras.camera_to_worlds)[:, :3].double().numpy(),
        intrinsics=intrinsics.double().numpy(),
        distortion=np.zeros((len(cameras), 6)) if distortion is None else distortion.double().numpy(),
    )
    finite = points.isfinite().all(dim=-1)
    return exposures(views, points[finite].double().numpy(), colors[finite].to(torch.uint8).numpy())


def choose_color_model(model: SadgsModel, dataset: InputDataset) -> str | None:
    """Let a model with `color_model` "auto" learn matrices of colours where exposure varies; call before optimizers.

    Args:
        model: The model.
        dataset: The training photos.

    Returns:
        A line for the user where exposure varies; None where it does not, or another model of colours was asked for.
    """
    asked = model.config.color_model
    if asked not in ("none", "auto") or (found := exposures_of(dataset)) is None or not found.varies:
        return None
    if asked == "auto":
        model.learn_color_matrices()
    remedy = "--pipeline.model.color-model affine learns a matrix of colours for each"
    action = "a matrix of colours is learned for each" if asked == "auto" else remedy
    how = "by EXIF" if found.source == "EXIF" else "by the brightness of SfM points in them"
    return f"The exposure of the photos varies {2**found.range:.1f}-fold ({how}): {action}."
