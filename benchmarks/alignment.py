"""Quality of held-out views whose cameras were aligned on the finished, frozen Gaussians.

A held-out camera has an error of its own, and one that learned poses, or the capture's own, may share: no training of
the other cameras can undo it. So each held-out camera's pose is fitted to its photo first, the same way for every
method: by gradients of the picture that the model gives for a camera.
"""

from __future__ import annotations

import contextlib
import copy
from collections.abc import Iterable, Iterator
from typing import Any

import torch
from torch import Tensor

from benchmarks.evaluate import View, quality
from sadgs_ns.geometry.poses import corrected, image_motion, pixel_steps
from sadgs_ns.method.losses import photometric_loss
from sadgs_ns.render.rasterization import viewmats_from_camera_to_world

STEPS = 60
FIRST_PIXELS = 0.2
"""How far the first step moves the image, in px, about; all steps together up to 4 px."""
LAST_PIXELS = 0.01
"""How far the last step moves the image, in px, about."""
SSIM_WEIGHT = 0.2  # Of the loss, as in 3DGS


def aligned_quality(model: Any, views: Iterable[View], network: Any = None) -> dict[str, Any]:
    """Return what `evaluate.quality` does after aligning each view, by names that begin with `aligned_`."""
    aligned_views = ((align(model, view), view[1]) for view in views)
    found = quality(model, aligned_views, network)
    return {f"aligned_{name}": value for name, value in found.items()}


@torch.enable_grad()
def align(model: Any, view: View) -> Any:
    """Return a view's camera at the pose, near its own, from which the model's picture is most like the photo.

    Of all poses on the way it is the one with the least loss; the model's parameters do not change.
    """
    camera, batch = view
    camera = copy.copy(camera.to(model.device))
    camera.metadata = {}  # So that no model takes another pose than the given one.
    initial = viewmats_from_camera_to_world(camera.camera_to_worlds)
    correction = torch.zeros(1, 6, device=model.device, requires_grad=True)
    best = camera.camera_to_worlds
    least = torch.inf
    with _frozen(model):
        units = _units(model, camera)
        adam = torch.optim.Adam([correction], lr=FIRST_PIXELS)
        decay = torch.optim.lr_scheduler.ExponentialLR(adam, (LAST_PIXELS / FIRST_PIXELS) ** (1 / (STEPS - 1)))
        for _ in range(STEPS):
            pose = _camera_to_world(corrected(initial, units * correction))
            leaf = pose.detach().requires_grad_()  # splatfacto compiles what it does with a pose, and warns of others.
            loss = _loss(model, camera, leaf, batch["image"])
            if float(loss) < least:
                least = float(loss)
                best = pose.detach()
            adam.zero_grad()
            loss.backward()
            pose.backward(leaf.grad)
            adam.step()
            decay.step()
    camera.camera_to_worlds = best
    return camera


@contextlib.contextmanager
def _frozen(model: Any) -> Iterator[None]:
    """Let no parameter of a model have a gradient meanwhile."""
    parameters = [parameter for parameter in model.parameters() if parameter.requires_grad]
    for parameter in parameters:
        parameter.requires_grad_(False)
    try:
        yield
    finally:
        for parameter in parameters:
            parameter.requires_grad_(True)


def _loss(model: Any, camera: Any, pose: Tensor, photo: Tensor) -> Tensor:
    """Return the photometric loss of the picture from a pose [1, 3, 4]; `get_outputs_for_camera` has no gradients."""
    moved = copy.copy(camera)
    moved.camera_to_worlds = pose
    outputs = model.get_outputs(moved)
    truth = model.composite_with_background(model.get_gt_img(photo), outputs["background"])[..., :3]
    loss, _ = photometric_loss(outputs["rgb"][None], truth[None].contiguous(), ssim_lambda=SSIM_WEIGHT)
    return loss


@torch.no_grad()
def _units(model: Any, camera: Any) -> Tensor:
    """Return how far each number of a correction goes to move the image by 1 px, by the picture's depths. [1, 6]"""
    outputs = model.get_outputs(camera)
    depths = outputs["depth"][outputs["accumulation"] > 0.5]
    depths = depths[depths > 0]
    quartiles = torch.ones(1, 3, device=model.device)
    if len(depths) > 0:
        ordered = depths.sort().values
        quartiles = torch.stack([ordered[len(ordered) * k // 4] for k in (1, 2, 3)])[None]
    size = torch.cat([camera.width, camera.height], dim=-1).to(quartiles)
    return pixel_steps(image_motion(camera.get_intrinsics_matrices().to(quartiles), size, quartiles))


def _camera_to_world(viewmats: Tensor) -> Tensor:
    """Return nerfstudio's pose of world-to-camera matrices [1, 4, 4]. [1, 3, 4]"""
    rotations = viewmats[:, :3, :3].mT
    centres = -rotations @ viewmats[:, :3, 3:]
    return torch.cat([rotations * viewmats.new_tensor([1.0, -1.0, -1.0]), centres], dim=2)
