"""How much memory a training step takes on CUDA, and how many Gaussians can be added before the next one.

The bytes are counted from the code that allocates them: `render.backend_triton` and gsplat's `fully_fused_projection`,
`kernels.tiles`, `kernels.losses` and `kernels.compositing`; `tests/benchmarks/test_step.py` measures real peaks.

A step is largest in one of three phases: while the tile lists are sorted, in the loss, and in the backward pass of
rasterization. The bytes that a Gaussian keeps between steps come on top.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from sadgs_ns.kernels import use_triton

Params = Mapping[str, Tensor] | torch.nn.ParameterDict
"""The Gaussians' parameters by name, each with leading dimension N."""
COPIES = 4
"""Tensors of a parameter's size: the parameter, its gradient and Adam's two moments. The mean over the last iterations
takes the place of the statistics and of a split's copy, which are gone by then."""
ACTIVATION_BYTES = 16  # Bytes of a Gaussian in every phase: exp(scales) 12, sigmoid(opacities) 4
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
EXCHANGE_BYTES = 200
"""Bytes of a Gaussian and view besides, in every phase, where several processes composite: its place 8, rows of 12
numbers that are gathered, sent, received and taken apart 48 each. Every Gaussian counts as seen in each view."""
PAIR_SORT_BYTES = 40
"""Bytes of a pair of a Gaussian and a tile while pairs are sorted by tile, with tiles of 32 bits: tiles 4, Gaussians 4,
sorted tiles 4, indices before 8 and after 8 the sort, the sort's buffers 12. With tiles of 16 bits they are 34."""
PAIR_BYTES = 4  # Bytes of such a pair until the end of the step: the Gaussian in the tile's list
PIXEL_BYTES = 54
"""Bytes of a pixel in the backward pass of rasterization: the rendered colours 12 and those on the background 12,
alphas 4, last Gaussians 4, gradient of the colours 12 and of alphas 4, image in bytes 3, quantized S̄ 3."""
LOSS_PIXEL_BYTES = 162
"""Bytes of a pixel in the loss, with our kernels: rendered colours 12, on the background 12 + 16, alphas 4, last
Gaussians 4, image 12, five blurred maps 60, three slopes 36, image in bytes 3, quantized S̄ 3."""
TORCH_LOSS_PIXEL_BYTES = 300
"""The same without our kernels, where torch keeps about twenty maps for the loss; measured, not counted."""
PAIRS_PER_GAUSSIAN = 12  # Pairs, of tiles of 8 px, that a trained Gaussian has in a view: 10.5 were counted on fox


@dataclass(frozen=True)
class StepSize:
    """The size of a step, besides the number of Gaussians."""

    views: int = 0  # Number of views
    pixels: int = 0  # Number of pixels of all views
    pairs: float = 0
    """Number of pairs of a Gaussian and a tile that it reaches, in all views, with the places of tile lists that a step
    left unused because their length was foreseen (render/tile_forecast.py)."""
    exchanged: bool = False  # Whether processes share the step out; pixels and pairs are then those of one.

    @classmethod
    def of(cls, infos: Sequence[Mapping[str, Any]]) -> StepSize:
        """The size of a step that was rendered, from gsplat's or `distributed.rasterization`'s `info` of its views."""
        return cls(
            sum(info["n_cameras"] for info in infos),
            sum(info.get("num_pixels", info["n_cameras"] * info["width"] * info["height"]) for info in infos),
            sum(info["num_pairs"] if "num_pairs" in info else len(info["flatten_ids"]) for info in infos),
            any("num_pairs" in info for info in infos),
        )


def available_bytes(device: torch.device) -> tuple[float, float]:
    """Bytes of the device that are free or already this process's, and all of its bytes; infinite without CUDA."""
    if device.type != "cuda":
        return math.inf, math.inf
    left, total = torch.cuda.mem_get_info(device)
    return float(left + torch.cuda.memory_reserved(device)), float(total)


def free_bytes(device: torch.device) -> float:
    """Bytes that new tensors may take: free in the driver, or kept unused by torch; infinite without CUDA."""
    available, _ = available_bytes(device)
    return available - torch.cuda.memory_allocated(device) if device.type == "cuda" else available


def kept_bytes(params: Params, state: Mapping[str, Any]) -> int:
    """Bytes that one Gaussian keeps: its parameters, their gradients and moments, and its statistics in `state`."""
    tensors = [value for value in state.values() if isinstance(value, Tensor)]
    return COPIES * sum(map(_row_bytes, params.values())) + sum(map(_row_bytes, tensors))


def widest_bytes(params: Params) -> int:
    """Bytes of a Gaussian's widest parameter; while a split copies it to its new length, memory holds it twice."""
    return max(map(_row_bytes, params.values()))


def step_bytes(num_gaussians: int, size: StepSize, device: torch.device) -> dict[str, float]:
    """Bytes that a step of Gaussians, visible or not, takes at its peak in each phase, besides `kept_bytes`."""
    return {name: a * num_gaussians + b + p * size.pairs for name, (a, b, p) in _phases(size, device).items()}


def affordable_growth(params: Params, state: Mapping[str, Any], free: float, size: StepSize) -> float:
    """How many Gaussians may be added so that adding them and the next training step fit; ≥ 0, or infinity.

    Added Gaussians bring `PAIRS_PER_GAUSSIAN` pairs each in every view.

    Args:
        free: Bytes left, as `free_bytes` counts them.
        size: The next step's, with the pairs of the present Gaussians.
    """
    if math.isinf(free):
        return free
    n = len(params["means"])
    widest = widest_bytes(params)
    new_pairs = PAIRS_PER_GAUSSIAN * size.views
    kept = kept_bytes(params, state)
    growth = min(
        (free - n * (a + widest) - b - p * size.pairs) / (kept + widest + a + p * new_pairs)
        for a, b, p in _phases(size, params["means"].device).values()
    )
    return max(math.floor(growth), 0)


def _phases(size: StepSize, device: torch.device) -> dict[str, tuple[float, float, float]]:
    """Bytes per Gaussian, bytes besides and bytes per pair, in each phase."""
    projected = ACTIVATION_BYTES + (PROJECTION_BYTES + EXCHANGE_BYTES * size.exchanged) * size.views
    loss = LOSS_PIXEL_BYTES if use_triton(device) else TORCH_LOSS_PIXEL_BYTES
    gradients = ACTIVATION_GRADIENT_BYTES + PROJECTION_GRADIENT_BYTES * size.views
    return {
        "tile lists": (projected + DEPTH_SORT_BYTES * size.views, 0.0, PAIR_SORT_BYTES),
        "loss": (projected, loss * size.pixels, PAIR_BYTES),
        "backward": (projected + gradients, PIXEL_BYTES * size.pixels, PAIR_BYTES),
    }


def _row_bytes(tensor: Tensor) -> int:
    return math.prod(tensor.shape[1:]) * tensor.element_size()
