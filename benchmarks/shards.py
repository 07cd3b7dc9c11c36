"""A training step of Gaussians that are spread over several devices: `python -m benchmarks shards`.

    torchrun --nproc-per-node 2 -m benchmarks.shards --gaussians 8000000 --megapixels 2 8

One process, which needs no torchrun, is timed as it trains alone. The Gaussians are made up: a spherical shell, which
cameras around it look at, or several that no camera sees two of, as a view of a city sees a part of it. Scenes of one
block a device, with one view of each, tell how much longer a step takes where the scene grows with the devices.
"""

from __future__ import annotations

import math
import os
import statistics
import time
from collections.abc import Sequence
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor

from benchmarks import command_lines
from sadgs_ns.distributed.rasterization import rasterize as rasterize_together
from sadgs_ns.distributed.shards import Shards
from sadgs_ns.method.absgs import accumulate_gradients, empty_gradients, keep_gradient
from sadgs_ns.method.losses import photometric_loss, photometric_part
from sadgs_ns.method.statistics import empty_statistics, observe
from sadgs_ns.plugin.nonfinite import NonFiniteLog
from sadgs_ns.plugin.optimizers import FusedAdam, step_together
from sadgs_ns.render.rasterization import rasterize

ASPECT = 1.5
"""Width of the images, relative to their height."""
ETA_EVERY = 10
"""Steps between two that observe η, about as many as in a run of 3,000 iterations."""
BLOCKS_APART = 10.0
"""Distance between the centres of two blocks, in radii of one."""
ROOM = 1.2
"""Places in one process's tile lists, relative to the pairs of its first step: as in training, it does not wait."""


class Step:
    """A training step on made-up Gaussians, of which this process has its part.

    Args:
        gaussians: Number of the Gaussians of all processes.
        width: px.
        height: px.
        views: Number V of views of a step.
        device: Where this process computes.
        shards: The processes; None for one process.
        blocks: Number of shells, at least 1, of which each has as many Gaussians and views as another where it divides
            their numbers. Each process has as many Gaussians of a block as another process.
    """

    def __init__(
        self,
        gaussians: int,
        width: int,
        height: int,
        views: int,
        device: torch.device,
        shards: Shards | None,
        blocks: int = 1,
    ) -> None:
        self.shards, self.width, self.height, self.views = shards, width, height, views
        part = slice(0, gaussians) if shards is None else shards.take_even_part(gaussians)
        number = part.stop - part.start
        generator = torch.Generator(device).manual_seed(part.start)

        def uniform(low: float, high: float, *shape: int) -> Tensor:
            return torch.empty(shape, device=device).uniform_(low, high, generator=generator)

        directions = torch.nn.functional.normalize(
            torch.empty((number, 3), device=device).normal_(generator=generator), dim=-1
        )
        spacing = math.sqrt(4 * math.pi * blocks / gaussians)  # of points on the unit sphere
        means = directions * uniform(0.95, 1.05, number, 1)
        means[:, 1] += BLOCKS_APART * (torch.arange(number, device=device) % blocks)
        values = {
            "means": means,
            "scales": torch.log(spacing * uniform(0.3, 1.2, number, 3)),
            "quats": uniform(-1.0, 1.0, number, 4),
            "features_dc": uniform(-1.0, 1.0, number, 3),
            "features_rest": uniform(-0.1, 0.1, number, 15, 3),
            "opacities": torch.logit(uniform(0.05, 0.95, number, 1)),
        }
        self.params = {name: torch.nn.Parameter(value) for name, value in values.items()}
        log = NonFiniteLog(device, capacity=1)
        self.optimizers = [FusedAdam([parameter], lr=1e-6, eps=1e-15) for parameter in self.params.values()]
        for optimizer in self.optimizers:
            optimizer.log = log  # What shares it is updated in one launch.
        self.state: dict[str, Any] = empty_statistics(number, device) | empty_gradients(number, device)
        numbers = torch.arange(views, device=device)
        angles = (numbers // blocks) * (2 * math.pi * blocks / views)
        self.viewmats = torch.eye(4, device=device).repeat(views, 1, 1)
        self.viewmats[:, 0, 0] = self.viewmats[:, 2, 2] = angles.cos()
        self.viewmats[:, 0, 2] = angles.sin()
        self.viewmats[:, 2, 0] = -angles.sin()
        self.viewmats[:, 1, 3] = -BLOCKS_APART * (numbers % blocks)
        self.viewmats[:, 2, 3] = 1.6
        focal = 0.8 * width
        K = torch.tensor([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], device=device)
        self.Ks = K.repeat(views, 1, 1)
        self.images = torch.full((views, height, width, 3), 100, dtype=torch.uint8, device=device)
        self.codes = torch.full((views, height, width, 3), 60, dtype=torch.uint8, device=device)
        self.capacity: int | None = None
        self.count = 0

    def __call__(self) -> None:
        """Render, compare, differentiate and update; the first of every `ETA_EVERY` steps observes η."""
        for parameter in self.params.values():
            parameter.grad = None
        p = self.params
        splats = (
            p["means"], p["quats"], p["scales"].exp(), torch.sigmoid(p["opacities"]).squeeze(-1),
            (p["features_dc"], p["features_rest"]), self.viewmats, self.Ks, self.width, self.height,
        )  # fmt: skip
        loss, info = self._alone(splats) if self.shards is None else self._together(self.shards, splats)
        if self.count % ETA_EVERY == 0:
            jitter = None if self.shards is None else self.shards.rand(self.views)
            seen = info | {"viewmats": self.viewmats, "Ks": self.Ks, "structure_tensors": self.codes}
            observe(self.state, p, seen, jitter=jitter)  # type: ignore[arg-type]
        self.count += 1
        loss.backward()
        accumulate_gradients(self.state, info, self.views)
        together = [optimizer for optimizer in self.optimizers if optimizer.triton]
        step_together(together)
        for optimizer in self.optimizers if not together else ():
            optimizer.step()

    def _alone(self, splats: tuple[Any, ...]) -> tuple[Tensor, dict[str, Any]]:
        renders, _, info = rasterize(*splats, sh_degree=3, absgrad=True, tile_capacity=self.capacity)
        keep_gradient(info["means2d"])
        if "pair_counts" in info and self.capacity is None:
            self.capacity = int(ROOM * sum(info["pair_counts"].wait()))
        return photometric_loss(renders, self.images)[0], info

    def _together(self, shards: Shards, splats: tuple[Any, ...]) -> tuple[Tensor, dict[str, Any]]:
        rendered, loss, info = rasterize_together(shards, *splats, sh_degree=3, absgrad=True)
        for band, colors, _ in rendered:
            part, _ = photometric_part(
                colors, self.images[band.view][None, band.top : band.bottom],
                rows=(band.first, band.last), top=band.top, height=self.height,
            )  # fmt: skip
            loss = loss + part / self.views
        return loss, info


def measure(step: Step, device: torch.device, repeats: int) -> tuple[float, float]:
    """Time steps that follow each other, after some that compile kernels.

    Returns:
        Milliseconds a step, the median of three rounds; and the peak of this process's memory on the device in 10⁹
        bytes, NaN without CUDA.
    """

    def wait() -> None:
        if device.type == "cuda":
            torch.cuda.synchronize()
        if step.shards is not None:
            step.shards.all(True)

    for _ in range(3):
        step()
    wait()
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats()
    times = []
    for _ in range(3):
        start = time.perf_counter()
        for _ in range(repeats):
            step()
        wait()
        times.append((time.perf_counter() - start) / repeats * 1e3)
    peak = torch.cuda.max_memory_allocated() / 1e9 if device.type == "cuda" else math.nan
    return statistics.median(times), peak


def main(argv: Sequence[str] | None = None) -> int:
    """Print a row of a table for each number of Gaussians and size, in all processes together; returns 0."""
    parser = command_lines.shards()
    options = parser.parse_args(argv)
    if options.blocks < 1:
        parser.error(f"--blocks must be at least 1, got {options.blocks}.")
    number, local = int(os.environ.get("WORLD_SIZE", "1")), int(os.environ.get("LOCAL_RANK", "0"))
    device = torch.device("cuda", local) if torch.cuda.is_available() else torch.device("cpu")
    if device.type == "cuda":
        torch.cuda.set_device(device)  # NCCL, and Triton, take the current device.
    shards = None
    if number > 1:
        dist.init_process_group("nccl" if device.type == "cuda" else "gloo")
        shards = Shards(device)
    first = shards is None or shards.rank == 0
    if first:
        name = torch.cuda.get_device_name() if device.type == "cuda" else "CPU"
        print(f"{number} × {name}, torch {torch.__version__}\n", flush=True)
        print("| devices | Gaussians | megapixels | views | blocks | ms a step | peak GB of each device |")
        print("| ---: | ---: | ---: | ---: | ---: | ---: | :--- |", flush=True)
    for gaussians in options.gaussians:
        for megapixels in options.megapixels:
            for views in options.views:
                height = round((megapixels * 1e6 / ASPECT) ** 0.5)
                step = Step(gaussians, round(ASPECT * height), height, views, device, shards, options.blocks)
                milliseconds, peak = measure(step, device, options.repeats)
                peaks = torch.tensor([peak], device=device)
                peaks = peaks if shards is None else shards.gather(peaks)[:, 0]
                if first:
                    each = ", ".join(f"{peak:.2f}" for peak in peaks.tolist())
                    size = f"| {number} | {gaussians:,} | {megapixels:g} | {views} | {options.blocks} |"
                    print(f"{size} {milliseconds:.2f} | {each} |", flush=True)
                if options.profile:
                    profile(step, first)
                del step
                if device.type == "cuda":
                    torch.cuda.empty_cache()
    if shards is not None:
        dist.destroy_process_group()
    return 0


def profile(step: Step, show: bool) -> None:
    """Print what takes the device of the first process the time of three steps.

    Args:
        step: A step that has run before.
        show: Whether this is the first process.
    """
    activities = [torch.profiler.ProfilerActivity.CPU]
    if torch.cuda.is_available():
        activities.append(torch.profiler.ProfilerActivity.CUDA)
    with torch.profiler.profile(activities=activities) as profiler:
        for _ in range(3):
            step()
    if show:
        by = "self_cuda_time_total" if torch.cuda.is_available() else "self_cpu_time_total"
        print(profiler.key_averages().table(sort_by=by, row_limit=30, max_name_column_width=70), flush=True)


if __name__ == "__main__":
    raise SystemExit(main())
