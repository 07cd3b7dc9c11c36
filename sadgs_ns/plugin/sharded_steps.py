"""Training steps of Gaussians that are spread over several processes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from sadgs_ns.distributed.rasterization import rasterize
from sadgs_ns.distributed.world import World
from sadgs_ns.method.losses import photometric_part
from sadgs_ns.plugin.model import SadgsModel
from sadgs_ns.render.types import Cameras


def losses_of_views(
    model: SadgsModel,
    world: World,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    views: Sequence[tuple[int, Mapping[str, Any]]],
    structure_tensors: Tensor | None,
) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Render training views of one size in all processes, and let the strategy see this one's Gaussians.

    Args:
        model: The model of this process's Gaussians.
        world: The processes, all of which call this with the same views.
        viewmats, Ks, width, height: As `render.types.Cameras` has them, of V views.
        views: Index and data of each view; the images of those of which this process composites rows are on the
            training device.
        structure_tensors: S̄ of the views, which may be quantized, [V, H, W, 3]; None where η is not observed.

    Returns:
        This process's part of the loss, `main_loss`, whose sum over the processes is the loss of one; and the metrics
        of all: PSNR in dB, the number of Gaussians, and `loss`, that sum.
    """
    kind = model.kind_of_step(width, height, [index for index, _ in views])
    share = len(model.means) / world.total
    gaussians, penalty = model.gaussians(opacity_reg=kind.opacity_reg * share)
    rendered, loss, info = rasterize(world, gaussians, Cameras(viewmats, Ks, width, height), kind.options)
    model.show_to_strategy(info, viewmats, Ks, structure_tensors)
    background, error = model.background, torch.zeros((), device=world.device)
    for band, colors, alphas in rendered:
        rgb = model.before_background(colors, alphas, background)
        rows = slice(band.top, band.bottom)
        data = views[band.view][1]
        batch = {name: data[name][None, rows] for name in ("image", "mask") if name in data}
        predicted, target = model.compared({"rgb": rgb, "background": background}, batch)
        part, square = photometric_part(
            predicted, target, rows=(band.first, band.last), top=band.top, height=height,
            ssim_lambda=model.config.ssim_lambda,
        )  # fmt: skip
        loss, error = loss + part / len(views), error + square / len(views)
    if penalty is not None:
        loss = loss + penalty.sum()
    of_all = world.sum(torch.stack([loss.detach(), error]))
    metrics = {"psnr": -10 * of_all[1].log10(), "gaussian_count": world.total, "loss": of_all[0]}
    return {"main_loss": loss}, metrics
