"""A random scene, and what either rasterizer makes of it."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from helpers.generators import seeded
from helpers.gsplat_like import rasterization
from sadgs_ns.kernels import triton_switched
from sadgs_ns.render.rasterization import visible

_PARAMETERS = ("means", "quats", "scales", "opacities", "colors")


def random_scene(gaussians: int, size: int, seed: int) -> dict[str, Tensor]:
    """A cube of Gaussians with SH of degree 3 in front of one camera, with random weights for a loss.

    Args:
        gaussians: Number N of Gaussians.
        size: Width and height S of the image in pixels.
        seed: Of the random numbers.

    Returns:
        float64 CPU tensors: the arguments of `rasterize` by name, and `weights` [1, S, S, 3].
    """
    generator = seeded(seed)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)

    scene = {
        "means": uniform(-1.0, 1.0, gaussians, 3),
        "quats": torch.randn(gaussians, 4, generator=generator, dtype=torch.float64),
        "scales": uniform(0.01, 0.08, gaussians, 3),
        "opacities": uniform(0.05, 0.95, gaussians),
        "colors": 0.3 * torch.randn(gaussians, 16, 3, generator=generator, dtype=torch.float64),
        "viewmats": torch.eye(4, dtype=torch.float64)[None],
        "Ks": torch.tensor([[[1.2 * size, 0.0, 0.5 * size], [0.0, 1.2 * size, 0.5 * size], [0.0, 0.0, 1.0]]]).double(),
        "weights": uniform(0.5, 1.5, 1, size, size, 3),
    }
    scene["viewmats"][0, 2, 3] = 3.0
    # Rounded once, so that every dtype renders the same numbers.
    return {name: tensor.float().double() for name, tensor in scene.items()}


def render_with_gradients(scene: dict[str, Tensor], device: str, dtype: torch.dtype) -> dict[str, Tensor]:
    """Images, projections and gradients of mean(weights * colour^2), as float64 CPU tensors.

    Args:
        scene: From `random_scene`.
        device: "cuda" renders with gsplat, "cpu" with the splatter.
        dtype: Floating-point type to render in; gsplat needs float32.

    Returns:
        `visible` bool [1, N]; `colour`, `alpha`, `means2d`, `conics`, `absgrad`, and `gradient of ...` per parameter.
    """
    arguments: dict[str, Any] = {name: tensor.to(device, dtype, copy=True) for name, tensor in scene.items()}
    weights = arguments.pop("weights")  # [1, S, S, 3]
    for name in _PARAMETERS:
        arguments[name].requires_grad_()
    height, width = weights.shape[1:3]
    with triton_switched(False):
        colors, alphas, info = rasterization(**arguments, width=width, height=height, sh_degree=3, absgrad=True)
    (weights * colors.square()).mean().backward()
    results = {"colour": colors, "alpha": alphas, "means2d": info["means2d"], "conics": info["conics"]}
    results |= {f"gradient of {name}": arguments[name].grad for name in _PARAMETERS}
    results["absgrad"] = info["means2d"].absgrad
    return {"visible": visible(info).cpu()} | {name: value.detach().cpu().double() for name, value in results.items()}
