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
_INPUTS = ("radii", "means2d", "conics", "structure_tensors", "viewmats", "Ks")
"""What the Triton kernel reads of gsplat's info."""


@dataclass(frozen=True)
class Statistic:
    """A number, or three, that a run keeps of η for each Gaussian."""

    shape: tuple[int, ...]
    """(3,) is a number for each axis, () one for the Gaussian. All are 0 while there is no observation."""
    update: Callable[[Tensor, Tensor], object]
    """Adds a forward pass, in place. It takes the statistic, float32 [N, *shape], and η of C views, float32 [C, N, 3],
    which is NaN on all axes where the Gaussian was not observed."""


def _count(values: Tensor, happened: Tensor) -> None:
    """Add the number of views in which something happened, bool [C, N, ...], to values [N, ...]."""
    values.add_(happened.sum(0, dtype=values.dtype))


# Below, a comparison with NaN is false, so that what was not observed is not counted.


def _count_high(values: Tensor, eta: Tensor) -> None:
    _count(values, eta > HIGH_ETA)


def _count_low(values: Tensor, eta: Tensor) -> None:
    _count(values, eta < LOW_ETA)


def _count_observations(values: Tensor, eta: Tensor) -> None:
    _count(values, eta[..., 0] >= 0)


def _keep_largest(values: Tensor, eta: Tensor) -> None:
    for of_view in eta:  # `amax` would keep NaN.
        torch.fmax(values, of_view, out=values)


STATISTICS: dict[str, Statistic] = {
    "n_high": Statistic((3,), _count_high),
    "n_low": Statistic((3,), _count_low),
    "eta_max": Statistic((3,), _keep_largest),
    "n_total": Statistic((), _count_observations),
}
"""The statistics by their names in the strategy's state: numbers of violations, of low responses, the largest η of each
axis, and the number of observations. One that is added here is kept, emptied, saved and planned for like these."""


def empty_statistics(num_gaussians: int, device: torch.device) -> dict[str, Tensor]:
    """Return the `STATISTICS` of Gaussians that no view has observed yet."""
    empty = {}
    for name, statistic in STATISTICS.items():
        empty[name] = torch.zeros((num_gaussians, *statistic.shape), device=device)
    return empty


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
    eta_in_views = observed_eta(params, info, jitter)  # [C, N, 3]
    for name, statistic in STATISTICS.items():
        statistic.update(statistics[name], eta_in_views)


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
        return _observed_eta_by_kernel(params, info, jitter)
    seen = visible(info)  # [C, N]
    scales = torch.exp(params["scales"])
    shapes = (params["means"], params["quats"], scales)
    views = []
    for camera in range(len(seen)):
        views.append(_eta_in_view(shapes, info, camera, seen[camera], jitter[camera]))
    return torch.stack(views)


def _observed_eta_by_kernel(params: Params, info: Mapping[str, Any], jitter: Tensor) -> Tensor:
    from sadgs_ns.kernels import statistics as kernel

    shapes = (params["means"], params["quats"], params["scales"])
    inputs = {name: info[name] for name in _INPUTS}
    constants = (SCREEN_BLUR, FRUSTUM_MARGIN, WAVELENGTH_EPSILON)
    quantization = (HIGHEST_FREQUENCY, OCTAVES, INVALID)
    return kernel.observed_eta(shapes, **inputs, jitter=jitter, constants=constants, quantization=quantization)


def _eta_in_view(
    shapes: tuple[Tensor, Tensor, Tensor],  # means [N, 3], quats [N, 4] and standard deviations [N, 3]
    info: Mapping[str, Any],
    camera: int,  # index of the view in `info`
    seen: Tensor,  # bool [N]
    jitter: Tensor,  # [N, 2] in [0, 1)
) -> Tensor:
    """Return η of the axes in one view, NaN where there is no observation. [N, 3]

    Every Gaussian is measured, and unseen ones are masked out: selecting first would make the host wait.
    """
    num_gaussians = len(seen)
    viewmats = info["viewmats"][camera].expand(num_gaussians, 4, 4)
    Ks = info["Ks"][camera].expand(num_gaussians, 3, 3)
    axes = projected_axes(*shapes, viewmats, Ks, info["width"], info["height"])  # [N, 3, 2]
    # An unseen Gaussian's projection is garbage, so its sample is moved to a place where nothing can overflow. The
    # values are Python numbers: a tensor made of them here would make the host wait for its copy to the device.
    means2d = torch.where(seen[:, None], info["means2d"][camera], -1.0)
    a, b, c = info["conics"][camera].unbind(-1)
    a = torch.where(seen, a, 1.0)
    b = torch.where(seen, b, 0.0)
    c = torch.where(seen, c, 1.0)
    conics = torch.stack([a, b, c], -1)
    points = sample_footprint(means2d, conics, jitter)
    camera_ids = torch.full((num_gaussians,), camera, device=seen.device)  # [N]
    sampled, inside = sample_map(info["structure_tensors"], camera_ids, points)
    found = eta(axes, sampled)  # [N, 3]
    observed = seen & inside & found.isfinite().all(dim=1)
    return torch.where(observed[:, None], found, torch.nan)


def consistent(
    counts: Tensor,  # [N, 3]
    n_total: Tensor,  # [N]
    threshold: float,
    min_observations: int = 1,
) -> Tensor:
    """Tell where a response was seen in more than a share of the observations: N / N_total > τ (paper, section 3.4).

    `counts` are `n_high` or `n_low`, with τ_split or τ_prune. Fewer than `min_observations` say nothing. bool [N, 3]
    """
    is_frequent = counts > threshold * n_total[:, None]
    is_known = n_total >= min_observations
    return is_frequent & is_known[:, None]
