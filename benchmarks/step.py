"""What surrounds rasterization in a training step, with and without our kernels: `python -m benchmarks step`.

A synthetic scene on a CUDA device: Gaussians on a spherical shell in front of one camera, an image to compare with,
Adam with its moments. Each part is timed by itself, then the whole step, a split, and the structure tensors of images.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gsplat
import torch
from torch import Tensor

from benchmarks import command_lines
from benchmarks.evaluate import now
from sadgs_ns.method.codes import encode
from sadgs_ns.method.losses import photometric_loss
from sadgs_ns.method.split import grid_split
from sadgs_ns.method.statistics import empty_statistics, observe
from sadgs_ns.method.structure_tensor import multiscale_structure_tensor
from sadgs_ns.plugin.nonfinite import NonFiniteLog
from sadgs_ns.plugin.optimizers import FusedAdam, step_together
from sadgs_ns.render.rasterization import rasterize, visible

REPEATS = 20
ETA_EVERY = 10
"""What `StructureAwareStrategy.eta_every` is in a run of 3,000 iterations."""


def milliseconds(function: Callable[[], object], rounds: int = 5) -> float:
    """Time of a call among calls that follow each other, as in training: the median of some rounds, after one."""
    times = []
    for _ in range(1 + rounds):
        start = now()
        for _ in range(REPEATS):
            function()
        times.append((now() - start) / REPEATS * 1e3)
    return statistics.median(times[1:])


def rasterize_parameters(
    params: Mapping[str, Tensor], viewmats: Tensor, Ks: Tensor, width: int, height: int, **options: bool
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """Call `rasterize` with parameters as they are trained, of degree 3.

    Args:
        params: `means` [N, 3], log `scales` [N, 3], `quats` [N, 4], logit `opacities` [N, 1], `features_dc` [N, 3] and
            `features_rest` [N, 15, 3].
        viewmats: World to camera. [C, 4, 4]
        Ks: Intrinsics in px. [C, 3, 3]
        width: px.
        height: px.
        options: `rasterize`'s switches, such as `absgrad`.
    """
    return rasterize(
        params["means"],
        params["quats"],
        torch.exp(params["scales"]),
        torch.sigmoid(params["opacities"]).squeeze(-1),
        (params["features_dc"], params["features_rest"]),
        viewmats,
        Ks,
        width,
        height,
        sh_degree=3,
        **options,  # type: ignore[arg-type]
    )


class Step:
    """A training step on a synthetic scene, whose parts can be run one by one.

    Args:
        gaussians: Number N of Gaussians.
        width: px.
        height: px.
        fused: Use our kernels, or what they are tested against.
    """

    def __init__(self, gaussians: int, width: int, height: int, fused: bool) -> None:
        device = torch.device("cuda")
        generator = torch.Generator(device).manual_seed(0)

        def uniform(low: float, high: float, *shape: int) -> Tensor:
            return low + (high - low) * torch.rand(shape, generator=generator, device=device)

        directions = torch.nn.functional.normalize(torch.randn((gaussians, 3), generator=generator, device=device))
        spacing = (12.57 / gaussians) ** 0.5  # of points on the unit sphere
        values = {
            "means": directions * uniform(0.95, 1.05, gaussians, 1),
            "scales": torch.log(spacing * uniform(0.3, 1.2, gaussians, 3)),
            "quats": uniform(-1.0, 1.0, gaussians, 4),
            "features_dc": uniform(-1.0, 1.0, gaussians, 3),
            "features_rest": uniform(-0.1, 0.1, gaussians, 15, 3),
            "opacities": torch.logit(uniform(0.05, 0.95, gaussians, 1)),
        }
        self.fused, self.width, self.height = fused, width, height
        self.params = {name: torch.nn.Parameter(value) for name, value in values.items()}
        self.optimizers: dict[str, torch.optim.Optimizer] = {
            name: FusedAdam([p], lr=1e-6, eps=1e-15) if fused else torch.optim.Adam([p], lr=1e-6, eps=1e-15, fused=True)
            for name, p in self.params.items()
        }
        log = NonFiniteLog(device, capacity=1)
        for optimizer in self.optimizers.values():
            if isinstance(optimizer, FusedAdam):
                optimizer.log = log  # one for all, as in training: what shares it is updated in one launch
        self.state: dict[str, Any] = empty_statistics(gaussians, device)
        self.viewmats = torch.eye(4, device=device)[None]
        self.viewmats[0, 2, 3] = 1.6
        self.Ks = torch.tensor([[[width * 0.8, 0, width / 2], [0, width * 0.8, height / 2], [0, 0, 1]]], device=device)
        self.target = uniform(0.0, 1.0, 1, height, width, 3)
        self.structure_tensors = torch.randint(0, 255, (1, height, width, 3), dtype=torch.uint8, device=device)
        self.rendered = self.target.clone().requires_grad_()
        self.gradients: list[Tensor | None] = []
        self.calls = 0  # of `whole`
        self.render()
        self.keep_gradients()

    def forward(self) -> tuple[Tensor, dict[str, Any]]:
        """Colours [1, H, W, 3] and gsplat's info."""
        colors, _, info = rasterize_parameters(
            self.params, self.viewmats, self.Ks, self.width, self.height, fused=self.fused
        )
        self.info = info | {"viewmats": self.viewmats, "Ks": self.Ks, "structure_tensors": self.structure_tensors}
        return colors, info

    def forget_gradients(self) -> None:
        for parameter in self.params.values():
            parameter.grad = None

    def keep_gradients(self) -> None:
        """Remember the gradients for `optimize`."""
        self.gradients = [parameter.grad for parameter in self.params.values()]

    def render(self) -> None:
        """Rasterize forward and backward."""
        self.forget_gradients()
        colors, _ = self.forward()
        colors.backward(self.target)

    def compare(self) -> None:
        """The photometric loss with its gradient."""
        self.rendered.grad = None
        photometric_loss(self.rendered, self.target, fused=self.fused)[0].backward()

    def observe(self) -> None:
        """One observation of η."""
        observe(self.state, self.params, self.info, fused=self.fused)  # type: ignore[arg-type]

    def optimize(self) -> None:
        """Adam on all parameters."""
        for parameter, gradient in zip(self.params.values(), self.gradients, strict=True):
            parameter.grad = gradient
        self.step_optimizers()

    def step_optimizers(self) -> None:
        """Adam on all parameters that have gradients: our kernel in one launch, as in training."""
        together = [o for o in self.optimizers.values() if isinstance(o, FusedAdam) and o.triton]
        step_together(together)
        for optimizer in () if together else self.optimizers.values():
            optimizer.step()

    def whole(self) -> None:
        """A step; η is observed in the calls that `ETA_EVERY` divides."""
        self.forget_gradients()
        colors, _ = self.forward()
        if self.calls % ETA_EVERY == 0:
            self.observe()
        self.calls += 1
        photometric_loss(colors, self.target, fused=self.fused)[0].backward()
        self.step_optimizers()


def compare_parts(gaussians: int, width: int, height: int) -> None:
    """Print the table of the parts of a step."""
    columns: list[dict[str, float]] = []
    for fused in (False, True):
        step = Step(gaussians, width, height, fused)
        seen = int(visible(step.info).sum())
        parts = {
            "rasterize, forward and backward": step.render,
            "L1 + SSIM + ℓ2 with gradient": step.compare,
            "one observation of η": step.observe,
            "Adam, all parameters": step.optimize,
            f"whole step, η in every {ETA_EVERY}th": step.whole,
        }
        columns.append({name: milliseconds(part) for name, part in parts.items()})
        del step
    slow, fast = columns
    print(f"\n{gaussians:,} Gaussians, {seen:,} of them visible, one view of {width}×{height} px; ms:\n")
    print("| part | gsplat and torch | with our kernels |\n| --- | ---: | ---: |")
    for name in slow:
        print(f"| {name} | {slow[name]:.2f} | {fast[name]:.2f} |")
    render, whole = (columns[1][name] for name in (next(iter(slow)), list(slow)[-1]))
    print(f"\nWhole step / rasterize, with our kernels: {whole / render:.2f}; with gsplat's rasterizer: ", end="")
    print(f"{columns[0][list(slow)[-1]] / columns[0][next(iter(slow))]:.2f}")


def time_split(parents: int) -> None:
    """Print what a split into four children each costs, the second time: the first loads kernels."""
    for _ in range(2):
        step = Step(parents, 64, 64, True)
        step.optimize()
        step.gradients = []
        step.forget_gradients()
        counts = torch.tensor([[2, 2, 1]], device="cuda").expand(parents, 3)
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
        start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
        start.record()
        grid_split(step.params, step.optimizers, step.state, counts)  # type: ignore[arg-type]
        end.record()
        torch.cuda.synchronize()
    result = 3 * sum(p.numel() for p in step.params.values()) * 4  # with both moments
    print(f"\nSplit of {parents:,} into {len(step.params['means']):,}: {start.elapsed_time(end):.0f} ms; ", end="")
    print(f"memory at its peak {torch.cuda.max_memory_allocated() / result:.2f} times that of the resulting ", end="")
    print(f"parameters and moments, {result / 1e9:.2f} GB.")


def time_structure_tensors(images: int, width: int, height: int) -> None:
    """Print what the structure tensors of a training set cost."""
    pictures = torch.randint(0, 256, (images, height, width, 3), dtype=torch.uint8, device="cuda")
    batch = max(4_000_000 // (width * height), 1)

    def run(count: int) -> None:
        for start in range(0, count, batch):
            encode(multiscale_structure_tensor(pictures[start : start + batch].float() / 255))

    run(batch)
    torch.cuda.synchronize()
    torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated()
    start, end = torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)
    start.record()
    run(images)
    end.record()
    torch.cuda.synchronize()
    working = (torch.cuda.max_memory_allocated() - before) / 1e9
    print(
        f"\nS̄ of {images} images of {width}×{height} px: {start.elapsed_time(end) / 1e3:.2f} s, {working:.2f} GB of ",
        end="",
    )
    print(f"working memory; the images take {pictures.numel() / 1e9:.2f} GB, and so do the tensors.")


def main(argv: Sequence[str] | None = None) -> int:
    """Print the tables; returns the exit code, 1 where there is no CUDA device."""
    options = command_lines.step().parse_args(argv)
    if not torch.cuda.is_available():
        print("This comparison needs a CUDA device, and torch finds none.")
        return 1
    print(
        f"gsplat {gsplat.__version__}, torch {torch.__version__}, {torch.cuda.get_device_name()}, medians of {REPEATS}."
    )
    for gaussians in options.gaussians:
        compare_parts(gaussians, options.width, options.height)
    time_split(500_000)
    time_structure_tensors(200, options.width, options.height)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
