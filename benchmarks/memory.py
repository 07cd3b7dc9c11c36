"""The memory plan beside the real peaks of training steps on a CUDA device: `python -m benchmarks memory`.

The Gaussians are made up: a spherical shell in front of cameras that all stand at the same place. A step does what one
of training does: it renders views, observes η, computes the loss with its gradients, adds up AbsGS's gradients and
updates the parameters.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Any

import torch
from nerfstudio.cameras.cameras import Cameras
from torch import Tensor

from benchmarks import command_lines
from benchmarks.step import rasterize_parameters
from sadgs_ns.method import memory
from sadgs_ns.method.absgs import accumulate_gradients, empty_gradients, keep_gradient
from sadgs_ns.method.losses import photometric_loss
from sadgs_ns.method.memory import StepSize
from sadgs_ns.method.statistics import empty_statistics, observe
from sadgs_ns.plugin.memory_plan import estimate_pairs
from sadgs_ns.plugin.nonfinite import NonFiniteLog
from sadgs_ns.plugin.optimizers import FusedAdam, step_together

ASPECT = 4 / 3
"""Width of the images divided by their height."""


class Training:
    """Made-up Gaussians and views, and a step of training on them.

    Args:
        gaussians: Number N of Gaussians, of degree 3.
        width: px.
        height: px.
        views: Number C of views of a step.
        device: Any device; peaks are measured on CUDA.
    """

    def __init__(self, gaussians: int, width: int, height: int, views: int, device: torch.device) -> None:
        generator = torch.Generator(device).manual_seed(0)

        def uniform(low: float, high: float, *shape: int) -> Tensor:
            return torch.empty(shape, device=device).uniform_(low, high, generator=generator)

        directions = torch.nn.functional.normalize(uniform(-1.0, 1.0, gaussians, 3), dim=-1)
        spacing = math.sqrt(4 * math.pi / gaussians)  # of points on the unit sphere
        values = {
            "means": directions * uniform(0.95, 1.05, gaussians, 1),
            "scales": torch.log(spacing * uniform(0.3, 1.2, gaussians, 1)).repeat(1, 3),
            "quats": uniform(-1.0, 1.0, gaussians, 4),
            "features_dc": uniform(-1.0, 1.0, gaussians, 3),
            "features_rest": uniform(-0.1, 0.1, gaussians, 15, 3),
            "opacities": torch.logit(uniform(0.05, 0.95, gaussians, 1)),
        }
        self.width, self.height, self.views = width, height, views
        self.params = {name: torch.nn.Parameter(value) for name, value in values.items()}
        self.optimizers = [FusedAdam([parameter], lr=1e-6, eps=1e-15) for parameter in self.params.values()]
        log = NonFiniteLog(device, capacity=1)
        for optimizer in self.optimizers:
            optimizer.log = log  # all share one log, as in training, and are then stepped in one launch
        self.state: dict[str, Any] = empty_statistics(gaussians, device) | empty_gradients(gaussians, device)
        pose = torch.tensor([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, -1.6]])
        focal = 0.8 * width
        self.cameras = Cameras(pose.repeat(views, 1, 1), focal, focal, width / 2, height / 2, width, height)
        self.viewmats = torch.eye(4, device=device).repeat(views, 1, 1)
        self.viewmats[:, 2, 3] = 1.6
        self.Ks = self.cameras.get_intrinsics_matrices().to(device)
        shape = (height, width, 3)
        self.images = [torch.full(shape, 100, dtype=torch.uint8, device=device) for _ in range(views)]
        self.codes = [torch.full(shape, 100, dtype=torch.uint8, device=device) for _ in range(views)]
        self.size = StepSize()

    @property
    def image_bytes(self) -> int:
        """Bytes of the images and the codes of S̄."""
        return sum(tensor.numel() for tensor in self.images + self.codes)

    def step(self, after: Callable[[str], None] = lambda phase: None) -> None:
        """One step of training.

        Args:
            after: Called with the name of each of `memory.step_bytes`' phases when it is over.
        """
        p = self.params
        for parameter in p.values():
            parameter.grad = None
        renders, alphas, info = rasterize_parameters(p, self.viewmats, self.Ks, self.width, self.height, absgrad=True)
        self.size = StepSize.of([info])
        keep_gradient(info["means2d"])
        tensors = torch.stack(self.codes)
        seen = info | {"viewmats": self.viewmats, "Ks": self.Ks, "structure_tensors": tensors}
        observe(self.state, p, seen)  # type: ignore[arg-type]
        after("tile lists")
        target = torch.stack(self.images) / 255.0
        rgb = renders + (1 - alphas) * torch.ones(3, device=renders.device)
        loss, _ = photometric_loss(rgb, target)
        after("loss")
        del target
        loss.backward()
        accumulate_gradients(self.state, info, self.views)
        after("backward")
        together = [optimizer for optimizer in self.optimizers if optimizer.triton]
        step_together(together)
        for optimizer in self.optimizers if not together else ():
            optimizer.step()


def plan(training: Training) -> dict[str, float]:
    """Bytes of all that a step of `training` has at its peak in each phase, as the memory plan counts them."""
    n = len(training.params["means"])
    kept = memory.kept_bytes(training.params, training.state) * n + training.image_bytes  # type: ignore[arg-type]
    return {name: kept + value for name, value in memory.step_bytes(n, training.size).items()}


def measure(training: Training) -> dict[str, float]:
    """Bytes of all that torch had allocated at the peak of each phase of the third step."""
    peaks: dict[str, float] = {}

    def note(phase: str) -> None:
        peaks[phase] = torch.cuda.max_memory_allocated()
        torch.cuda.reset_peak_memory_stats()

    for _ in range(2):  # kernels are compiled, and Adam's moments are made
        training.step()
    torch.cuda.synchronize()
    torch.cuda.reset_peak_memory_stats()
    training.step(note)
    return peaks


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table; returns the exit code, 1 where there is no CUDA device."""
    options = command_lines.memory().parse_args(argv)
    if not torch.cuda.is_available():
        print("This comparison needs a CUDA device, and torch finds none.")
        return 1
    start, device = time.perf_counter(), torch.device("cuda")
    print(f"torch {torch.__version__}, {torch.cuda.get_device_name()}; GB, plan / peak:\n")
    phases = list(memory.step_bytes(0, StepSize()))
    print(
        "| Gaussians | megapixels | views | million pairs (estimated) |", " | ".join(phases), "| step | plan / peak |"
    )
    print("| ---: " * (6 + len(phases)) + "|")
    for gaussians in options.gaussians:
        for megapixels in options.megapixels:
            height = round(math.sqrt(1e6 * megapixels / ASPECT))
            for views in options.views:
                training = Training(gaussians, round(ASPECT * height), height, views, device)
                peaks = measure(training)
                planned = plan(training)
                pairs = views * estimate_pairs(training.params, training.cameras) / 1e6  # type: ignore[arg-type]
                cells = [f"{planned[name] / 1e9:.2f} / {peaks[name] / 1e9:.2f}" for name in phases]
                most, real = max(planned.values()), max(peaks.values())
                print(
                    f"| {gaussians:,} | {megapixels:g} | {views} | {training.size.pairs / 1e6:.1f} ({pairs:.1f}) |",
                    " | ".join(cells),
                    f"| {most / 1e9:.2f} / {real / 1e9:.2f} | {most / real:.2f} |",
                    flush=True,
                )
                del training
                torch.cuda.empty_cache()
    print(f"\n{time.perf_counter() - start:.0f} s")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
