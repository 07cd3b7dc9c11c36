"""A training step on made-up Gaussians: its parts with and without our kernels.

The Gaussians are a spherical shell, which cameras around it look at. Calls follow each other, so that the host's work
counts only where it takes longer than the GPU's.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from benchmarks.evaluate import now
from benchmarks.table import grid
from sadgs_ns import gsplat_compat, kernels
from sadgs_ns.method.losses import photometric_loss
from sadgs_ns.method.running_strategy import empty_state
from sadgs_ns.method.screen_gradients import accumulate_gradients, keep_gradient
from sadgs_ns.method.statistics import observe
from sadgs_ns.render.rasterization import rasterize
from sadgs_ns.render.types import Cameras, Gaussians, RenderOptions
from sadgs_ns.training.step.optimizers import AdamUpdate, FusedAdam

REPEATS = 20
"""Calls in a row that are timed together."""
ETA_EVERY = 10
"""Steps between two that observe η, about as many as in a run of 3,000 iterations."""
ROOM = 1.25
"""Places in the tile lists, relative to the pairs of the first step: as in training, later ones do not wait."""


def milliseconds(function: Callable[[], object], rounds: int = 5) -> float:
    """Time of a call among calls that follow each other, as in training: the median of some rounds, after one."""
    times = []
    for _ in range(1 + rounds):
        start = now()
        for _ in range(REPEATS):
            function()
        times.append((now() - start) / REPEATS * 1e3)
    return statistics.median(times[1:])


class Step:
    """A training step of Gaussians of degree 3 in V views of `width` × `height` px, whose parts can be called alone."""

    def __init__(
        self, gaussians: int, width: int, height: int, views: int = 1, device: torch.device | str = "cuda"
    ) -> None:
        self.width = width
        self.height = height
        self.views = views
        device = torch.device(device)
        generator = torch.Generator(device).manual_seed(0)

        def uniform(low: float, high: float, *shape: int) -> Tensor:
            return torch.empty(shape, device=device).uniform_(low, high, generator=generator)

        directions = torch.empty((gaussians, 3), device=device).normal_(generator=generator)
        spacing = math.sqrt(4 * math.pi / gaussians)  # of points on the unit sphere
        values = {
            "means": torch.nn.functional.normalize(directions, dim=-1) * uniform(0.95, 1.05, gaussians, 1),
            "scales": torch.log(spacing * uniform(0.3, 1.2, gaussians, 3)),
            "quats": uniform(-1.0, 1.0, gaussians, 4),
            "features_dc": uniform(-1.0, 1.0, gaussians, 3),
            "features_rest": uniform(-0.1, 0.1, gaussians, 15, 3),
            "opacities": torch.logit(uniform(0.05, 0.95, gaussians, 1)),
        }
        self.params = {name: torch.nn.Parameter(value) for name, value in values.items()}
        opacities = values["opacities"].sigmoid().squeeze(-1)
        self.activated = values["means"], values["quats"], values["scales"].exp(), opacities
        self.optimizers = {name: FusedAdam([p], lr=1e-6, eps=1e-15) for name, p in self.params.items()}
        self.nonfinite_flag = torch.zeros(1, device=device)
        self.state: dict[str, Any] = empty_state(gaussians, device)
        angles = torch.arange(views, device=device) * (2 * math.pi / views)
        self.viewmats = torch.eye(4, device=device).repeat(views, 1, 1)
        self.viewmats[:, 0, 0] = self.viewmats[:, 2, 2] = angles.cos()
        self.viewmats[:, 0, 2] = angles.sin()
        self.viewmats[:, 2, 0] = -angles.sin()
        self.viewmats[:, 2, 3] = 1.6
        K = torch.tensor([[0.8 * width, 0, width / 2], [0, 0.8 * width, height / 2], [0, 0, 1]], device=device)
        self.Ks = K.repeat(views, 1, 1)
        self.images = torch.full((views, height, width, 3), 100, dtype=torch.uint8, device=device)
        self.structure_tensors = torch.full_like(self.images, 60)
        self.rendered = (self.images / 255).requires_grad_()
        self.capacity: int | None = None
        self.count = 0
        self.info: dict[str, Any] = {}

    def draw(self) -> Tensor:
        """Rasterize the views. [V, H, W, 3]"""
        p = self.params
        opacities = p["opacities"].sigmoid().squeeze(-1)
        colors = (p["features_dc"], p["features_rest"])
        gaussians = Gaussians(p["means"], p["quats"], p["scales"].exp(), opacities, colors)
        cameras = Cameras(self.viewmats, self.Ks, self.width, self.height)
        options = RenderOptions(sh_degree=3, absgrad=True, tile_capacity=self.capacity)
        drawn, _, info = rasterize(gaussians, cameras, options)
        keep_gradient(info["means2d"])
        if "pair_counts" in info and self.capacity is None:
            self.capacity = int(ROOM * sum(info["pair_counts"].wait()))
        self.info = {**info, "viewmats": self.viewmats, "Ks": self.Ks, "structure_tensors": self.structure_tensors}
        return drawn

    @torch.no_grad()
    def project(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Project the Gaussians, without their activation and without gradients, by our kernel or by gsplat's."""
        if kernels.use_triton(self.params["means"]):
            from sadgs_ns.kernels.projection_forward import project_forward as project
        else:
            project = gsplat_compat.project
        means, quats, scales, opacities = self.activated
        return project(means, quats, scales, opacities, self.viewmats, self.Ks, self.width, self.height)

    def forget_gradients(self) -> None:
        """Set all gradients to None, as a step does when it begins."""
        for parameter in self.params.values():
            parameter.grad = None

    def render(self) -> None:
        """Rasterize forward and backward."""
        self.forget_gradients()
        self.draw().sum().backward()

    def compare(self) -> None:
        """The photometric loss with its gradient."""
        self.rendered.grad = None
        photometric_loss(self.rendered, self.images)[0].backward()

    def observe(self) -> None:
        """One observation of η."""
        jitter = torch.rand_like(self.info["means2d"])
        observe(self.state, self.params, self.info, jitter)  # type: ignore[arg-type]

    def optimize(self) -> None:
        """Adam on all parameters that have gradients: our kernel in one launch, as in training."""
        gradients = {name: p.grad for name, p in self.params.items() if p.grad is not None}
        update = AdamUpdate({name: self.optimizers[name] for name in gradients})
        update.launch(
            gradients, update.factors().to(self.nonfinite_flag.device, non_blocking=True), self.nonfinite_flag
        )
        for name, gradient in gradients.items():
            self.params[name].grad = gradient  # torch's Adam has used it up, and this may be called again.

    def __call__(self, after: Callable[[str], None] = lambda phase: None) -> None:
        """A whole step; every `ETA_EVERY`th observes η, and `after` hears the phases of `step_memory.step_bytes`."""
        self.forget_gradients()
        drawn = self.draw()
        if self.count % ETA_EVERY == 0:
            self.observe()
        self.count += 1
        after("tile lists")
        loss, _ = photometric_loss(drawn, self.images)
        after("loss")
        loss.backward()
        accumulate_gradients(self.state, self.info, self.views)
        after("backward")
        self.optimize()


@dataclass
class Command:
    """Time the parts of a training step with and without our kernels (CUDA)."""

    gaussians: tuple[int, ...] = (500_000, 4_000_000)
    """numbers of Gaussians"""
    width: int = 1600
    """px"""
    height: int = 1060
    """px"""

    def __call__(self) -> int:
        if not torch.cuda.is_available():
            raise ValueError("this needs a CUDA device, and torch finds none.")
        print(f"torch {torch.__version__}, {torch.cuda.get_device_name()}\n", flush=True)
        for gaussians in self.gaussians:
            columns = []
            for triton in (False, True):
                with kernels.triton_switched(triton):
                    step = Step(gaussians, self.width, self.height)
                    step()
                    parts = {
                        "projection, forward": step.project,
                        "rasterize, forward and backward": step.render,
                        "L1 + SSIM + ℓ2 with gradient": step.compare,
                        "one observation of η": step.observe,
                        "Adam, all parameters": step.optimize,
                        f"whole step, η in every {ETA_EVERY}th": step,
                    }
                    columns.append({name: milliseconds(part) for name, part in parts.items()})
                    del step, parts
            print(f"{gaussians:,} Gaussians, a view of {self.width}×{self.height} px; ms:\n")
            lines = [(name, *(f"{column[name]:.2f}" for column in columns)) for name in columns[0]]
            print(grid(("part", "gsplat and torch", "with our kernels"), lines), end="\n\n", flush=True)
        return 0
