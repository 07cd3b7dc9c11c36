"""How much memory a training step takes on CUDA, and how many Gaussians can be added before the next one.

The bytes are counted from the code that allocates them: `render.backend_triton`, `kernels.projection_forward`,
`kernels.tiles`, `kernels.losses` and `kernels.compositing`; `tests/benchmarks/test_step.py` measures real peaks.

A step is largest in one of three phases: while the tile lists are sorted, in the loss, and in the backward pass of
rasterization. The bytes that a Gaussian keeps between steps come on top.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from sadgs_ns.kernels import use_triton

Params = Mapping[str, Tensor] | torch.nn.ParameterDict
"""The Gaussians' parameters by name, each with leading dimension N."""
COPIES = 4
"""Tensors of a parameter's size: the parameter, its gradient and Adam's two moments. The mean over the last iterations
takes the place of the statistics and of a split's copy, which are gone by then."""
ACTIVATION_BYTES = 16
"""Bytes of a Gaussian in every phase: exp(scales) 12, sigmoid(opacities) 4."""
ACTIVATION_GRADIENT_BYTES = 28
"""Bytes of a Gaussian in the backward pass: gradients of the activations 16, the means' from harmonics 12."""
PROJECTION_BYTES = 52
"""Bytes of a Gaussian and view in every phase: radii 4, means2d 8, depths 4, conics 12, opacities 4, colours 12."""
DEPTH_SORT_BYTES = 40
"""Bytes of a Gaussian and view besides, while Gaussians are sorted by depth: numbers of tiles 8, indices before 8 and
after 8 the sort, sorted depths 4, the sort's buffers 12."""
PROJECTION_GRADIENT_BYTES = 84
"""Bytes of a Gaussian and view besides, in the backward pass: a row of 12 gradients 48, and those that the projection
wants contiguous or that are kept for AbsGS: means2d 8 + 8, conics 12, depths 4, opacities 4."""
COLOR_MAP_BYTES = 12
"""Bytes of a Gaussian and view besides, in every phase where views change colours (`rasterization.project`), which
keeps the colours before and after that. The backward pass takes as many for the gradient."""
EXCHANGE_BYTES = 200
"""Bytes of a Gaussian and view besides, in every phase, where several processes composite: its place 8, rows of 12
numbers that are gathered, sent, received and taken apart 48 each. Every Gaussian counts as seen in each view."""
PAIR_SORT_BYTES = 40
"""Bytes of a pair of a Gaussian and a tile while pairs are sorted by tile, with tiles of 32 bits: tiles 4, Gaussians 4,
sorted tiles 4, indices before 8 and after 8 the sort, the sort's buffers 12. With tiles of 16 bits they are 34."""
PAIR_BYTES = 4
"""Bytes of such a pair until the end of the step: the Gaussian in the tile's list."""
PIXEL_BYTES = 54
"""Bytes of a pixel in the backward pass of rasterization: the rendered colours 12 and those on the background 12,
alphas 4, last Gaussians 4, gradient of the colours 12 and of alphas 4, image in bytes 3, quantized S̄ 3."""
LOSS_PIXEL_BYTES = 114
"""Bytes of a pixel in the loss, with our kernels: rendered colours 12, on the background 12 + 16, alphas 4, last
Gaussians 4, image 12, three slopes 36, gradient 12, image in bytes 3, quantized S̄ 3."""
TORCH_LOSS_PIXEL_BYTES = 300
"""The same without our kernels, where torch keeps about twenty maps for the loss; measured, not counted."""
PAIRS_PER_GAUSSIAN = 12
"""Pairs, of tiles of 8 px, that a trained Gaussian has in a view: 10.5 were counted on fox."""


@dataclass(frozen=True)
class StepSize:
    """The size of a step, besides the number of Gaussians."""

    views: int = 0  # Number of views
    pixels: int = 0  # Number of pixels of all views
    pairs: float = 0
    """Number of pairs of a Gaussian and a tile that it reaches, in all views, with the places of tile lists that a step
    left unused because their length was foreseen (render/tile_forecast.py)."""
    exchanged: bool = False  # Whether processes share the step out; pixels and pairs are then those of one.
    has_color_maps: bool = False  # Whether views change the Gaussians' colours, as gains of exposure do

    @classmethod
    def of(cls, infos: Sequence[Mapping[str, Any]]) -> StepSize:
        """Return the size of a step that was rendered, from `info` of its views.

        It is gsplat's, or that of `distributed.rasterization`, which alone has `num_pairs`; a training step adds
        `has_color_maps`.
        """
        views = 0
        pixels = 0
        pairs = 0
        exchanged = False
        has_color_maps = any(info.get("has_color_maps", False) for info in infos)
        for info in infos:
            views += info["n_cameras"]
            pixels += info.get("num_pixels", info["n_cameras"] * info["width"] * info["height"])
            if "num_pairs" in info:
                exchanged = True
                pairs += info["num_pairs"]
            else:
                pairs += len(info["flatten_ids"])
        return cls(views, pixels, pairs, exchanged, has_color_maps)


def available_bytes(device: torch.device) -> tuple[float, float]:
    """Bytes of the device that are free or already this process's, and all of its bytes; infinite without CUDA."""
    if device.type != "cuda":
        return math.inf, math.inf
    left, total = torch.cuda.mem_get_info(device)
    available = left + torch.cuda.memory_reserved(device)
    return float(available), float(total)


def free_bytes(device: torch.device) -> float:
    """Bytes that new tensors may take: free in the driver, or kept unused by torch; infinite without CUDA."""
    available, _ = available_bytes(device)
    if device.type != "cuda":
        return available
    return available - torch.cuda.memory_allocated(device)


def kept_bytes(params: Params, state: Mapping[str, Any]) -> int:
    """Bytes that one Gaussian keeps: its parameters, their gradients and moments, and its statistics in `state`."""
    of_params = sum(_row_bytes(parameter) for parameter in params.values())
    of_state = sum(_row_bytes(value) for value in state.values() if isinstance(value, Tensor))
    return COPIES * of_params + of_state


def widest_bytes(params: Params) -> int:
    """Bytes of a Gaussian's widest parameter; while a split copies it to its new length, memory holds it twice."""
    return max(_row_bytes(parameter) for parameter in params.values())


def step_bytes(num_gaussians: int, size: StepSize, device: torch.device) -> dict[str, float]:
    """Bytes that a step of Gaussians, visible or not, takes at its peak in each phase, besides `kept_bytes`."""
    taken = {}
    for name, phase in _phases(size, device).items():
        taken[name] = phase.per_gaussian * num_gaussians + phase.of_pixels + phase.per_pair * size.pairs
    return taken


def affordable_growth(params: Params, state: Mapping[str, Any], free: float, size: StepSize) -> float:
    """Return how many Gaussians may be added so that adding them and the next training step fit; ≥ 0, or infinity.

    Added Gaussians bring `PAIRS_PER_GAUSSIAN` pairs each in every view.

    Args:
        params: The present Gaussians' parameters.
        state: The strategy's state, whose tensors hold a row for each Gaussian.
        free: Bytes left, as `free_bytes` counts them.
        size: The next step's, with the pairs of the present Gaussians.
    """
    if math.isinf(free):
        return free
    num_present = len(params["means"])
    widest = widest_bytes(params)
    kept = kept_bytes(params, state)
    new_pairs = PAIRS_PER_GAUSSIAN * size.views
    growth = math.inf
    for phase in _phases(size, params["means"].device).values():
        bytes_of_present = num_present * (phase.per_gaussian + widest)
        bytes_left = free - bytes_of_present - phase.of_pixels - phase.per_pair * size.pairs
        bytes_of_new = kept + widest + phase.per_gaussian + phase.per_pair * new_pairs  # Of each new Gaussian
        growth = min(growth, bytes_left / bytes_of_new)
    return max(math.floor(growth), 0)


class _Phase(NamedTuple):
    """The bytes that a phase of a step takes."""

    per_gaussian: float
    of_pixels: float
    per_pair: float  # For each pair of a Gaussian and a tile


def _phases(size: StepSize, device: torch.device) -> dict[str, _Phase]:
    """Bytes that each phase of a step takes, besides what Gaussians keep."""
    per_view = PROJECTION_BYTES
    if size.exchanged:
        per_view += EXCHANGE_BYTES
    of_gradients = PROJECTION_GRADIENT_BYTES
    if size.has_color_maps:
        per_view += COLOR_MAP_BYTES
        of_gradients += COLOR_MAP_BYTES
    projected = ACTIVATION_BYTES + per_view * size.views
    sorted_by_depth = projected + DEPTH_SORT_BYTES * size.views
    gradients = ACTIVATION_GRADIENT_BYTES + of_gradients * size.views
    loss_pixel = TORCH_LOSS_PIXEL_BYTES
    if use_triton(device):
        loss_pixel = LOSS_PIXEL_BYTES
    sorting = _Phase(sorted_by_depth, 0.0, PAIR_SORT_BYTES)
    loss = _Phase(projected, loss_pixel * size.pixels, PAIR_BYTES)
    backward = _Phase(projected + gradients, PIXEL_BYTES * size.pixels, PAIR_BYTES)
    return {"tile lists": sorting, "loss": loss, "backward": backward}


def _row_bytes(tensor: Tensor) -> int:
    """Bytes of a row of a tensor [N, ...]."""
    return math.prod(tensor.shape[1:]) * tensor.element_size()
