"""η observations → per-Gaussian multiview statistics (paper, section 3.4), tensors [N, …] in a strategy's state."""

from __future__ import annotations

from collections.abc import Callable, Mapping, MutableMapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from sadgs_ns.gsplat_compat import SCREEN_BLUR
from sadgs_ns.kernels import use_triton
from sadgs_ns.method.eta import WAVELENGTH_EPSILON, eta, projected_axes, sample_footprint, sample_map
from sadgs_ns.method.ops import Params
from sadgs_ns.method.quantization import HIGHEST_FREQUENCY, INVALID, OCTAVES
from sadgs_ns.render.ewa import FRUSTUM_MARGIN
from sadgs_ns.render.rasterization import visible

HIGH_ETA = 1.0
"""η above this is a violation: the axis is longer than the local wavelength (paper, section 3.4)."""
LOW_ETA = 0.1
"""η below this is a low response: the axis covers a smooth region (paper, section 3.4)."""


@dataclass(frozen=True)
class Statistic:
    """A number, or three, that a run keeps of η for each Gaussian."""

    shape: tuple[int, ...]
    """(3,) is a number for each axis, () one for the Gaussian. All are 0 while there is no observation."""
    update: Callable[[Tensor, Tensor], object]
    """Adds a forward pass, in place. It takes the statistic, float32 [N, *shape], and η of C views, float32 [C, N, 3],
    which is NaN on all axes where the Gaussian was not observed."""


def _count(values: Tensor, happened: Tensor) -> None:
    values.add_(happened.sum(0, dtype=values.dtype))


def _keep_largest(values: Tensor, eta: Tensor) -> None:
    for of_view in eta:  # `amax` would keep NaN.
        torch.fmax(values, of_view, out=values)


# A comparison with NaN is false.
STATISTICS: dict[str, Statistic] = {
    "n_high": Statistic((3,), lambda values, eta: _count(values, eta > HIGH_ETA)),
    "n_low": Statistic((3,), lambda values, eta: _count(values, eta < LOW_ETA)),
    "eta_max": Statistic((3,), _keep_largest),
    "n_total": Statistic((), lambda values, eta: _count(values, eta[..., 0] >= 0)),
}
"""The statistics by their names in the strategy's state: numbers of violations, of low responses, the largest η of each
axis, and the number of observations. One that is added here is kept, emptied, saved and planned for like these."""


def empty_statistics(num_gaussians: int, device: torch.device) -> dict[str, Tensor]:
    """Return the `STATISTICS` of Gaussians that no view has observed yet."""
    return {name: torch.zeros((num_gaussians, *s.shape), device=device) for name, s in STATISTICS.items()}


@torch.no_grad()
def observe(
    statistics: MutableMapping[str, Tensor],
    params: Params,
    info: Mapping[str, Any],
    jitter: Tensor,  # [C, N, 2] in [0, 1)
) -> None:
    """Add one forward pass to `STATISTICS`, in place: one jittered sample per visible Gaussian and view.

    `info` is gsplat's meta, unpacked, of C views of one size, plus `structure_tensors` [C, H, W, 3] (S̄, which may be
    quantized), `viewmats` [C, 4, 4] and `Ks` [C, 3, 3].
    """
    of_views = observed_eta(params, info, jitter)
    for name, statistic in STATISTICS.items():
        statistic.update(statistics[name], of_views)


def observed_eta(
    params: Params,
    info: Mapping[str, Any],
    jitter: Tensor,  # [C, N, 2] in [0, 1)
) -> Tensor:
    """Return η of the axes in each view, NaN where there is no observation. [C, N, 3]

    A Gaussian is observed in a view when the rasterizer drew it there, its sample lies in the image and not on a masked
    pixel, and its η is finite on all axes. The arguments are those of `observe`.
    """
    if use_triton(params["means"]):
        from sadgs_ns.kernels import statistics as kernel

        return kernel.observed_eta(
            (params["means"], params["quats"], params["scales"]),
            **{name: info[name] for name in ("radii", "means2d", "conics", "structure_tensors", "viewmats", "Ks")},
            jitter=jitter,
            constants=(SCREEN_BLUR, FRUSTUM_MARGIN, WAVELENGTH_EPSILON),
            quantization=(HIGHEST_FREQUENCY, OCTAVES, INVALID),
        )
    seen = visible(info)  # [C, N]
    num_cameras, num_gaussians = seen.shape
    scales, views = torch.exp(params["scales"]), []
    # Every Gaussian is measured, and unseen ones are masked out: selecting first would make the host wait.
    for camera in range(num_cameras):
        camera_ids = torch.full((num_gaussians,), camera, device=seen.device)  # [N]
        viewmats = info["viewmats"][camera].expand(num_gaussians, 4, 4)
        Ks = info["Ks"][camera].expand(num_gaussians, 3, 3)
        shapes = params["means"], params["quats"], scales
        axes = projected_axes(*shapes, viewmats, Ks, info["width"], info["height"])  # [N, 3, 2]
        # An unseen Gaussian's projection is garbage, so its sample is moved to a place where nothing can overflow.
        means2d = torch.where(seen[camera, :, None], info["means2d"][camera], -1.0)
        a, b, c = info["conics"][camera].unbind(-1)
        # Python numbers: a tensor made of them here would make the host wait for its copy to the device.
        a, b, c = (torch.where(seen[camera], *pair) for pair in ((a, 1.0), (b, 0.0), (c, 1.0)))
        conics = torch.stack([a, b, c], -1)
        points = sample_footprint(means2d, conics, jitter[camera])
        sampled, inside = sample_map(info["structure_tensors"], camera_ids, points)
        violation = eta(axes, sampled)  # [N, 3]
        observed = (seen[camera] & inside & violation.isfinite().all(dim=1))[:, None]  # [N, 1]
        views.append(torch.where(observed, violation, torch.nan))
    return torch.stack(views)


def consistent(
    counts: Tensor,  # [N, 3]
    n_total: Tensor,  # [N]
    threshold: float,
    min_observations: int = 1,
) -> Tensor:
    """Whether a response was seen in more than a fraction of the observations: N / N_total > τ (paper, section 3.4).

    `counts` are `n_high` or `n_low`, with τ_split or τ_prune. Fewer than `min_observations` say nothing. bool [N, 3]
    """
    return (counts > threshold * n_total[:, None]) & (n_total >= min_observations)[:, None]
