"""A training step: render views, compare them with their photos, differentiate, update all parameters.

One function serves every run. Several processes come in at `distributed.rasterization.rasterize`, and CUDA graphs
where the trainer replays a step instead of calling it (cuda_graphs.py).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from typing import Any

import torch
from torch import Tensor

from sadgs_ns.distributed.bands import Band
from sadgs_ns.distributed.rasterization import rasterize
from sadgs_ns.geometry.point_colors import BRIGHTEST
from sadgs_ns.method.losses import photometric_loss, photometric_part
from sadgs_ns.render.types import Cameras, Gaussians, RenderOptions
from sadgs_ns.training.model import SadgsModel
from sadgs_ns.training.step.color_matrices import anchored, correct_colors
from sadgs_ns.training.step.images import stack, stack_masks
from sadgs_ns.training.step.optimizers import AdamUpdate
from sadgs_ns.training.step.row_adam import RowUpdate

CLIPPED_FROM = BRIGHTEST + 0.5 / 255
"""Value of photos from which they are clipped, with gains. It lies between two bytes, so that no rounding decides."""


@dataclass(frozen=True)
class ViewGroup:
    """Views of a step that have one size, on the training device."""

    indices: list[int]  # Indices of V training views
    cameras: Cameras  # With the initial poses
    options: RenderOptions
    data: Sequence[Mapping[str, Tensor]]
    """`image` of each view, uint8 or floats in [0, 1] [H, W, 3 or 4], and perhaps `mask`, bool [H, W, 1]. With several
    processes, views that only others composite have none."""
    view_ids: Tensor | None = None  # `indices` on the device if views have colours or poses of their own. int64 [V]
    structure_tensors: Tensor | None = None  # Quantized S̄ if η is observed. uint8 [V, H, W, 3]
    images: Tensor | None = None  # The images, if they are in one tensor already. [V, H, W, 3]
    masks: Tensor | None = None  # The masks, if `images` is there and a view has one. bool [V, H, W, 1]

    def batch(self, band: Band | None) -> dict[str, Tensor]:
        """Return `image` and, if a view has a mask, `mask` of all views [V, H, W, ·], or of a band's rows."""
        if band is not None:
            rows = slice(band.top, band.bottom)
            data = self.data[band.view]
            return {name: data[name][None, rows] for name in ("image", "mask") if name in data}
        images = self.images
        if images is None:
            images = stack([data["image"] for data in self.data])
        batch = {"image": images}
        masks = self.masks
        if masks is None:
            masks = stack_masks(self.data, batch["image"].shape[1:3], self.cameras.viewmats.device)
        if masks is not None:
            batch["mask"] = masks
        return batch


@dataclass(frozen=True)
class StepResult:
    """The results of a step on the device."""

    loss: Tensor  # Loss of all processes, without gradient, a scalar
    psnr: Tensor  # PSNR of the views in dB, a scalar
    means_gradient: Tensor  # Gradient of the loss by the centres. [N, 3]
    infos: list[dict[str, Any]]  # The rasterizer's info of each group of views


def training_step(
    model: SadgsModel,
    groups: Sequence[ViewGroup],
    opacity_reg: float,  # Factor on the mean opacity in the loss
    update: AdamUpdate,  # The update of all parameters
    factors: Tensor,  # What `AdamUpdate.factors` returned, on the device
    nonfinite_flag: Tensor,  # Becomes NaN if a gradient was not finite. float32 [1]
) -> StepResult:
    """Train on the views of a step; the loss is their mean. This enqueues work and changes tensors only.

    It waits for none of it; only several processes wait for the numbers of Gaussians that they send each other. If the
    tile lists of a group were too short, it was not drawn and gives no gradient. If all were, nothing changes.
    """
    world = model.strategy.world
    # Gradients of the parameters themselves would add up on the stream of their first use, where no graph is captured.
    leaves = {name: parameter.detach().requires_grad_() for name, parameter in model.trained_params.items()}
    if not world.is_single:
        opacity_reg *= len(leaves["means"]) / world.total  # The mean is over the Gaussians of all processes.
    gaussians, penalty = model.gaussians(leaves, opacity_reg)
    if model.dropout is not None:
        gaussians = model.dropout.apply(gaussians)
    if world.is_single and len(groups) == 1:
        # The kernel adds the penalty to the loss of a single group.
        losses, qualities, infos = _render_and_compare(model, groups, gaussians, leaves, penalty)
    else:
        losses, qualities, infos = _render_and_compare(model, groups, gaussians, leaves, None)
        if penalty is not None:
            losses.append(penalty.sum())
    loss = reduce(torch.add, losses)
    loss.backward()
    gradients = {name: _gradient_of(leaves[name]) for name in update.parameters}
    overflowed = tuple(info["overflowed"] for info in infos if "overflowed" in info)
    update.launch(gradients, factors, nonfinite_flag, overflowed, _moved_poses(model, groups, infos))
    if model.poses is not None:
        model.poses.hold_frame()
    model.strategy.accumulate(model.strategy_state, model.step, infos)
    loss = loss.detach()
    if world.is_single:
        psnr = reduce(torch.add, qualities)
    else:
        loss, error = world.sum(torch.stack([loss, sum(qualities, torch.zeros_like(loss))]))
        psnr = -10 * error.log10()
    return StepResult(loss, psnr, gradients["means"], infos)


def _render_and_compare(
    model: SadgsModel,
    groups: Sequence[ViewGroup],
    gaussians: Gaussians,
    leaves: Mapping[str, Tensor],  # The parameters by name, of which the Gaussians were made
    penalty: Tensor | None,  # Numbers whose sum is added to the loss of a single group
) -> tuple[list[Tensor], list[Tensor], list[dict[str, Any]]]:
    """Render the views of a step and compare them with their photos.

    Returns:
        Losses, whose sum is that of the step. Qualities, whose sum is the mean PSNR in dB; with several processes, the
        mean square error. The rasterizer's info of each group, in which η was observed if that is due.
    """
    world = model.strategy.world
    num_views = sum(len(group.indices) for group in groups)
    losses: list[Tensor] = []
    qualities: list[Tensor] = []
    infos: list[dict[str, Any]] = []
    # All processes have the same groups, and autograd goes back through them in the same order.
    for group in groups:
        cameras = group.cameras
        if model.poses is not None and group.view_ids is not None:
            moved = model.poses.viewmats(cameras.viewmats, group.view_ids, leaves["poses"])
            cameras = cameras._replace(viewmats=moved)
        color_maps = model.color_maps(group.view_ids)
        pictures, info = rasterize(world, gaussians, cameras, group.options, color_maps)
        viewmats, Ks = cameras[:2]
        info |= {"viewmats": viewmats.detach(), "Ks": Ks, "structure_tensors": group.structure_tensors}
        info["has_color_maps"] = color_maps is not None
        model.strategy.step_pre_backward(model.gauss_params, {}, model.strategy_state, model.step, info)
        infos.append(info)
        for band, colors, alphas in pictures:
            if model.color_matrices is not None and group.view_ids is not None:
                view_ids = group.view_ids
                if band is not None:
                    view_ids = view_ids[band.view : band.view + 1]
                colors = correct_colors(colors, alphas, anchored(leaves["color_matrices"], view_ids))
            rgb = model.before_background(colors, alphas, model.background)
            rgb, photo = model.masked_pair(rgb, group.batch(band), model.background)
            loss, quality, views = _compare(model, (rgb, photo), group, band, penalty)
            if views != num_views:
                loss = views / num_views * loss
                quality = views / num_views * quality
            losses.append(loss)
            qualities.append(quality)
        anchor = info.pop("anchor", None)
        if anchor is not None:
            losses.append(anchor)
    return losses, qualities, infos


def _compare(
    model: SadgsModel,
    pair: tuple[Tensor, Tensor],  # A rendering and its photo [V, H, W, 3], of a band its rows alone
    group: ViewGroup,
    band: Band | None,
    penalty: Tensor | None,  # Numbers whose sum is added to the loss of a whole group
) -> tuple[Tensor, Tensor, int]:
    """Return the loss of a group or of one view's band, its quality, and the number of views that both are of.

    The quality is PSNR in dB of a group, and the mean square error of a band.
    """
    predicted, target = pair
    ssim_lambda = model.config.ssim_lambda
    clipped_from = None
    if model.exposure is not None:
        clipped_from = CLIPPED_FROM
    if band is None:
        loss, quality = photometric_loss(
            predicted, target, ssim_lambda=ssim_lambda, parts=penalty, clipped_from=clipped_from
        )
        return loss, quality, len(group.indices)
    loss, quality = photometric_part(
        predicted,
        target,
        rows=(band.first, band.last),
        top=band.top,
        height=group.cameras.height,
        ssim_lambda=ssim_lambda,
        clipped_from=clipped_from,
    )
    return loss, quality, 1


def _moved_poses(
    model: SadgsModel, groups: Sequence[ViewGroup], infos: Sequence[Mapping[str, Any]]
) -> RowUpdate | None:
    """Return which poses a step moves: those of the views that were drawn. None if poses are fixed."""
    if model.poses is None:
        return None
    # With poses, each group has its `view_ids`.
    views = [group.view_ids for group in groups if group.view_ids is not None]
    overflowed = [info.get("overflowed") for info in infos]
    return model.poses.row_update(views, overflowed)


def _gradient_of(leaf: Tensor) -> Tensor:
    """Return the gradient of a tensor, zeros if it has none."""
    if leaf.grad is None:
        return torch.zeros_like(leaf)
    return leaf.grad
