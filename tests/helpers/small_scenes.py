"""Small random scenes for tests, a training step on them, and the sizes of the drawn one."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from helpers.generators import seeded
from helpers.gsplat_like import splatted
from sadgs_ns.method.strategy import StructureAwareStrategy
from sadgs_ns.method.structure_tensor import multiscale_structure_tensor

WIDTH = 48
HEIGHT = 36
VIEWS = 10
POINTS = 300
"""Of the drawn scene that the fixture `scene` is."""
ITERATIONS = 12
"""Of the run on it that the fixture `config` describes."""
CHECKER_SIZE = 32, 24
"""Width and height of the image of `train_on_checker`."""


def random_params(n: int, seed: int = 0, dtype: torch.dtype = torch.float32) -> dict[str, torch.nn.Parameter]:
    """Gaussians in gsplat's parameters, about 4 units in front of a camera at the origin."""
    generator = seeded(seed)

    def rand(*shape: int) -> Tensor:
        return torch.rand(shape, generator=generator, dtype=dtype)

    params = {
        "means": (rand(n, 3) - 0.5) * 2 + torch.tensor([0.0, 0.0, 4.0], dtype=dtype),
        "scales": torch.log(0.05 + 0.2 * rand(n, 3)),
        "quats": rand(n, 4) - 0.5,
        "opacities": torch.logit(0.2 + 0.7 * rand(n)),
        "features_dc": rand(n, 3),
    }
    return {name: torch.nn.Parameter(value) for name, value in params.items()}


def adam(params: dict[str, torch.nn.Parameter], lr: float = 1e-3) -> dict[str, torch.optim.Optimizer]:
    """One Adam per parameter with one step taken, so that every optimizer has a state."""
    optimizers: dict[str, torch.optim.Optimizer] = {name: torch.optim.Adam([p], lr=lr) for name, p in params.items()}
    for parameter in params.values():
        parameter.grad = torch.ones_like(parameter)
    for optimizer in optimizers.values():
        optimizer.step()
        optimizer.zero_grad()
    return optimizers


def camera(width: int = 64, height: int = 48, focal: float = 60.0, dtype: torch.dtype = torch.float32):
    """viewmats [1, 4, 4] and Ks [1, 3, 3] of a camera at the origin."""
    K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], dtype=dtype)
    return torch.eye(4, dtype=dtype)[None], K[None]


def cameras_at(centres: Tensor, seed: int = 0) -> Tensor:
    """viewmats of cameras at centres [C, 3], turned at random. [C, 4, 4]"""
    generator = seeded(seed)
    viewmats = torch.eye(4).repeat(len(centres), 1, 1)
    viewmats[:, :3, :3] = torch.linalg.qr(torch.randn((len(centres), 3, 3), generator=generator))[0]
    viewmats[:, :3, 3:] = -viewmats[:, :3, :3] @ centres[..., None].float()
    return viewmats


def centres_of(viewmats: Tensor) -> Tensor:
    """Where cameras are, in float64. [C, 4, 4] → [C, 1, 3]"""
    viewmats = viewmats.double().cpu()
    return -(viewmats[:, :3, :3].mT @ viewmats[:, :3, 3:]).mT


def splat(params: dict[str, torch.nn.Parameter], viewmats: Tensor, Ks: Tensor, width: int, height: int, **options: Any):
    """The splatter's colours [C, H, W, 3], alphas [C, H, W, 1] and info of `random_params`' parameters."""
    return splatted(
        params["means"],
        params["quats"],
        params["scales"].exp(),
        torch.sigmoid(params["opacities"]),
        params["features_dc"],
        viewmats,
        Ks,
        width,
        height,
        packed=False,
        **options,
    )


def training_step(
    strategy: StructureAwareStrategy,
    params: dict[str, torch.nn.Parameter],
    optimizers: dict[str, torch.optim.Optimizer],
    state: dict[str, Any],
    step: int,
    images: Tensor,
    structure_tensors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    **options: Any,
) -> None:
    """An iteration of a plain gsplat loop with the strategy, on images [C, H, W, 3]."""
    height, width = images.shape[1:3]
    renders, _, info = splat(params, viewmats, Ks, width, height, absgrad=strategy.needs_absgrad(step), **options)
    info |= {"structure_tensors": structure_tensors, "viewmats": viewmats, "Ks": Ks}
    strategy.step_pre_backward(params, optimizers, state, step, info)
    (renders - images).abs().mean().backward()
    for optimizer in optimizers.values():
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
    strategy.step_post_backward(params, optimizers, state, step, info)


def train_on_checker(
    strategy: StructureAwareStrategy, params: dict[str, torch.nn.Parameter], steps: int
) -> tuple[dict[str, Any], list[int]]:
    """Train in a plain loop on a fine checker, in place; the strategy's state and the counts after each step."""
    width, height = CHECKER_SIZE
    torch.manual_seed(0)
    optimizers = adam(params)
    state = strategy.initialize_state()
    y, x = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    image = (0.25 + 0.5 * ((x // 3 + y // 3) % 2).float())[None, ..., None].repeat(1, 1, 1, 3)
    tensors = multiscale_structure_tensor(image)
    viewmats, Ks = camera(width, height, focal=30.0)
    counts = []
    for step in range(steps):
        training_step(strategy, params, optimizers, state, step, image, tensors, viewmats, Ks)
        counts.append(len(params["means"]))
    return state, counts
