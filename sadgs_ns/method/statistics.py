"""η observations → per-Gaussian multiview statistics (paper, section 3.4).

The statistics are tensors with leading dimension N in a gsplat strategy state, so every gsplat operation that adds or
removes Gaussians keeps them in step with the parameters.
"""

from __future__ import annotations

from collections.abc import Mapping, MutableMapping
from typing import Any

import torch
from torch import Tensor

from sadgs_ns.gsplat_compat import SCREEN_BLUR
from sadgs_ns.kernels import use_triton
from sadgs_ns.method.eta import (
    WAVELENGTH_EPSILON,
    eta,
    projected_axes,
    sample_footprint,
    sample_map,
)
from sadgs_ns.method.ops import Params
from sadgs_ns.method.quantization import HIGHEST_FREQUENCY, INVALID, OCTAVES
from sadgs_ns.render.ewa import FRUSTUM_MARGIN
from sadgs_ns.render.rasterization import visible

HIGH_ETA = 1.0
"""η above this is a violation: the axis is longer than the local wavelength (paper, section 3.4)."""
LOW_ETA = 0.1
"""η below this is a low response: the axis covers a smooth region (paper, section 3.4)."""


def empty_statistics(num_gaussians: int, device: torch.device) -> dict[str, Tensor]:
    """Statistics of Gaussians that nobody has seen yet.

    Returns:
        `n_high`, `n_low` (counts per axis) and `eta_max` (largest η per axis), each float32 [N, 3]; `n_total`, the
        number of observations, float32 [N].
    """
    zeros = torch.zeros((num_gaussians, 3), device=device)
    return {"n_high": zeros, "n_low": zeros.clone(), "eta_max": zeros.clone(), "n_total": zeros[:, 0].clone()}


@torch.no_grad()
def observe(
    statistics: MutableMapping[str, Tensor],
    params: Params,
    info: Mapping[str, Any],
    *,
    generator: torch.Generator | None = None,
    jitter: Tensor | None = None,  # [C, N, 2]
) -> None:
    """Add one forward pass: one jittered sample per visible Gaussian and view, counted in place.

    A Gaussian is observed in a view when the rasterizer drew it there, its sample lies in the image and not on a masked
    pixel, and its η is finite on all axes: NaN and infinities of the projection or of S̄ are no observation.

    Args:
        statistics: As made by `empty_statistics`.
        params: `means` [N, 3], `quats` [N, 4] and log `scales` [N, 3].
        info: gsplat's meta, unpacked, of C views of one size, plus `structure_tensors` [C, H, W, 3] (S̄,
            which may be quantized), `viewmats` [C, 4, 4] and `Ks` [C, 3, 3].
        generator: Source of the jitter.
        jitter: In [0, 1), where it is not to be drawn here. [C, N, 2]
    """
    means2d = info["means2d"]
    if jitter is None:
        jitter = torch.rand(means2d.shape, generator=generator, device=means2d.device)  # [C, N, 2]
    if use_triton(params["means"]):
        from sadgs_ns.kernels.statistics import observe_views

        observe_views(
            (statistics["n_high"], statistics["n_low"], statistics["eta_max"], statistics["n_total"]),
            (params["means"], params["quats"], params["scales"]),
            info["radii"],
            means2d,
            info["conics"],
            jitter,
            info["structure_tensors"],
            info["viewmats"],
            info["Ks"],
            thresholds=(HIGH_ETA, LOW_ETA),
            constants=(SCREEN_BLUR, FRUSTUM_MARGIN, WAVELENGTH_EPSILON),
            quantization=(HIGHEST_FREQUENCY, OCTAVES, INVALID),
        )
        return
    seen = visible(info)  # [C, N]
    num_cameras, num_gaussians = seen.shape
    scales = torch.exp(params["scales"])
    # Every Gaussian is measured and the unseen are masked out: selecting them first would make the host wait.
    for camera in range(num_cameras):
        camera_ids = torch.full((num_gaussians,), camera, device=seen.device)  # [N]
        axes = projected_axes(
            params["means"],
            params["quats"],
            scales,
            info["viewmats"][camera].expand(num_gaussians, 4, 4),
            info["Ks"][camera].expand(num_gaussians, 3, 3),
            info["width"],
            info["height"],
        )  # [N, 3, 2]
        # An unseen Gaussian's projection is garbage; its sample is moved to a place where nothing can overflow.
        means2d = torch.where(seen[camera, :, None], info["means2d"][camera], -1.0)
        a, b, c = info["conics"][camera].unbind(-1)
        # Python numbers: a tensor made of them here would make the host wait for its copy to the device.
        a, b, c = (torch.where(seen[camera], *pair) for pair in ((a, 1.0), (b, 0.0), (c, 1.0)))
        conics = torch.stack([a, b, c], -1)
        points = sample_footprint(means2d, conics, jitter[camera])
        sampled, inside = sample_map(info["structure_tensors"], camera_ids, points)
        violation = eta(axes, sampled)  # [N, 3]
        observed = (seen[camera] & inside & violation.isfinite().all(dim=1))[:, None]  # [N, 1]
        violation = torch.where(observed, violation, 0.0)
        statistics["n_high"] += violation > HIGH_ETA
        statistics["n_low"] += observed & (violation < LOW_ETA)
        statistics["n_total"] += observed[:, 0]
        torch.maximum(statistics["eta_max"], violation, out=statistics["eta_max"])


def consistent(counts: Tensor, n_total: Tensor, threshold: float, min_observations: int = 1) -> Tensor:
    """Whether a response was seen in more than a fraction of the observations: N / N_total > τ (paper, section 3.4).

    Args:
        counts: `n_high` or `n_low`. [N, 3]
        n_total: [N]
        threshold: τ_split or τ_prune in [0, 1].
        min_observations: Fewer observations than these say nothing: one of one would be all of them.

    Returns:
        Per axis; False for a Gaussian with too few observations. bool [N, 3]
    """
    return (counts > threshold * n_total[:, None]) & (n_total >= min_observations)[:, None]
