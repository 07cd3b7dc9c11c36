"""For each Triton kernel, what would do its work if it were not there: its twin in torch, or gsplat's kernel.

`replaced` puts a twin in its kernel's place, for all that a run calls meanwhile. Twins that wait for the device, as
gsplat's tile lists do, cannot be part of a CUDA graph.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from importlib import import_module
from typing import TYPE_CHECKING, Any, NamedTuple
from unittest import mock

import gsplat
import torch
from torch import Tensor
from torch.optim.adam import adam

from sadgs_ns import gsplat_compat
from sadgs_ns.distributed.bands import Band
from sadgs_ns.distributed.exchange import Exchange
from sadgs_ns.distributed.world import World
from sadgs_ns.render import backend_gsplat
from sadgs_ns.render.off_axis import cull_off_axis
from sadgs_ns.render.types import Gaussians, Projected
from sadgs_ns.training.step.nonfinite import leave_out_nonfinite

if TYPE_CHECKING:  # Triton need not be installed.
    from sadgs_ns.kernels.tiles import PairCounts, PendingTiles, TileLists

REFINED = {"pipeline.model.poses": "refined"}
"""Settings of a run that launches the kernels of poses."""
_MANY_STEPS = 1e9  # After so many updates Adam corrects no bias, and float32 does not change if 1 is added.


class Patch(NamedTuple):
    """A name of a module of the package, and what stands there in a kernel's place."""

    module: str
    name: str
    stand_in: Callable[..., Any]


@dataclass(frozen=True)
class Twin:
    """What does the work of a kernel."""

    by: str  # "torch" or "gsplat"
    patches: tuple[Patch, ...]
    waits: bool = False  # Whether the host waits for the device, so that no step can be a CUDA graph
    is_once: bool = False  # Whether a run launches the kernel when it loads its images, and not in its steps
    settings: dict[str, Any] = field(default_factory=dict)  # Settings without which a run does not launch the kernel


@contextmanager
def replaced(twin: Twin | None) -> Iterator[None]:
    """Put a twin in its kernel's place within a block of code; None changes nothing."""
    with ExitStack() as stack:
        if twin is not None:
            for patch in twin.patches:
                module = import_module(f"sadgs_ns.{patch.module}")
                stack.enter_context(mock.patch.object(module, patch.name, patch.stand_in))
        yield


def _never(place: torch.device | Tensor) -> bool:
    """Stand in for `kernels.use_triton`."""
    return False


def _torch_in(*modules: str) -> tuple[Patch, ...]:
    """Return the patches with which some modules take their functions in torch."""
    return tuple(Patch(module, "use_triton", _never) for module in modules)


def adam_step(
    parameters: tuple[Tensor, ...],
    gradients: tuple[Tensor, ...],
    exp_avgs: tuple[Tensor, ...],
    exp_avg_sqs: tuple[Tensor, ...],
    factors: Tensor,  # [2, P]
    nonfinite_flag: Tensor,  # [1]
    overflowed: tuple[Tensor, ...] = (),
    *,
    betas: tuple[float, float],
    eps: float,
    max_gradient: float,
) -> None:
    """Do what `kernels.adam.adam_step` does, by torch's fused Adam of each parameter; `overflowed` is ignored.

    The factors hold the corrections of the bias, so torch is told that there were many updates. Only `eps` then counts
    less in the first updates of a run.
    """
    scales = factors[1]
    rates = (factors[0] / scales).unbind()
    for index, gradient in enumerate(gradients):
        leave_out_nonfinite(gradient, nonfinite_flag)
        adam(
            [parameters[index].detach()],
            [gradient],
            [exp_avgs[index]],
            [exp_avg_sqs[index]],
            [],
            [_many_steps(gradient.device)],
            fused=True,
            amsgrad=False,
            beta1=betas[0],
            beta2=betas[1],
            lr=rates[index],
            weight_decay=0.0,
            eps=eps,
            maximize=False,
        )


@lru_cache(maxsize=8)
def _many_steps(device: torch.device) -> Tensor:
    """Return a number of updates on the device, a scalar."""
    return torch.tensor(_MANY_STEPS, device=device)


def project(
    means: Tensor,  # [N, 3]
    quats: Tensor,  # [N, 4]
    scales: Tensor,  # [N, 3]
    opacities: Tensor,  # [N]
    viewmats: Tensor,  # [C, 4, 4]
    Ks: Tensor,  # [C, 3, 3]
    width: int,
    height: int,
    near_plane: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Do what `kernels.projection.project` does, by gsplat."""
    projected = gsplat_compat.project(means, quats, scales, opacities, viewmats, Ks, width, height, near_plane)
    return *projected, means


def colors_from_harmonics(
    degree: int,
    means: Tensor,  # [N, 3]
    first: Tensor,  # [N, 3]
    rest: Tensor,  # [N, K - 1, 3]
    viewmats: Tensor,  # [C, 4, 4]
    radii: Tensor,  # [C, N] or [C, N, 2]
) -> Tensor:
    """Do what `kernels.harmonics.colors_from_harmonics` does, by gsplat. [C, N, 3]"""
    nothing = means[:0]  # Colours need neither shapes nor opacities.
    gaussians = Gaussians(means, nothing, nothing, nothing, (first, rest))
    centres = radii.new_empty((*radii.shape[:2], 2))  # Only their number of dimensions is read.
    return backend_gsplat.colors_in_views(gaussians, viewmats, radii, centres, degree)


@dataclass(frozen=True)
class ReadyTiles:
    """gsplat's tile lists, in the place of `kernels.tiles.PendingTiles`."""

    tile_lists: TileLists
    pair_counts: PairCounts

    def lists(self, capacity: int | None = None) -> TileLists:
        """Return the lists, which have their exact length whatever the capacity is."""
        return self.tile_lists


def gsplat_tiles(
    means2d: Tensor,  # [C, N, 2]
    radii: Tensor,  # [C, N] or [C, N, 2]
    depths: Tensor,  # [C, N]
    conics: Tensor,  # [C, N, 3]
    opacities: Tensor,  # [C, N]
    width: int,
    height: int,
    tile_size: int,
    max_off_axis: float = 0.0,
) -> ReadyTiles:
    """Do what `kernels.tiles.intersect_tiles` does, by gsplat, which lists all tiles that a Gaussian's box touches."""
    from sadgs_ns.kernels.tiles import PairCounts, TileLists

    if max_off_axis > 0:
        # Autograd must not see this change, as it does not see our kernel's.
        radii.data.copy_(cull_off_axis(radii, means2d, width, height, max_off_axis))
    columns = -(-width // tile_size)
    rows = -(-height // tile_size)
    with torch.no_grad():
        counts, keys, ids = gsplat.isect_tiles(means2d, radii, depths, tile_size, columns, rows)
        starts = gsplat.isect_offset_encode(keys, len(means2d), columns, rows)
        overflowed = torch.zeros(1, dtype=torch.int64, device=means2d.device)
        of_views = counts.view(len(means2d), -1).sum(dim=1, dtype=torch.int64)
        return ReadyTiles(TileLists(starts, ids, overflowed), PairCounts.sent(of_views))


@dataclass(frozen=True)
class ExactTiles:
    """Our tile lists in their exact length, for which the host waits."""

    pending: PendingTiles

    @property
    def pair_counts(self) -> PairCounts:
        """Return the numbers of pairs in each view."""
        return self.pending.pair_counts

    def lists(self, capacity: int | None = None) -> TileLists:
        """Return the lists; gsplat would read the places that a capacity leaves unused."""
        return self.pending.lists()


def tiles_for_gsplat(
    means2d: Tensor,  # [C, N, 2]
    radii: Tensor,  # [C, N] or [C, N, 2]
    depths: Tensor,  # [C, N]
    conics: Tensor,  # [C, N, 3]
    opacities: Tensor,  # [C, N]
    width: int,
    height: int,
    tile_size: int,
    max_off_axis: float = 0.0,
) -> ExactTiles:
    """Make our lists of tiles of the size with which gsplat composites fastest."""
    from sadgs_ns.kernels.tiles import intersect_tiles

    ellipses = (means2d, radii, depths, conics, opacities)
    return ExactTiles(intersect_tiles(*ellipses, width, height, backend_gsplat.TILE_SIZE, max_off_axis))


def rasterize_to_pixels(
    means2d: Tensor,  # [C, N, 2]
    conics: Tensor,  # [C, N, 3]
    colors: Tensor,  # [C, N, 3]
    opacities: Tensor,  # [C, N]
    width: int,
    height: int,
    starts: Tensor,  # [C, tile rows, tile columns]
    ids: Tensor,  # [number of pairs]
    absgrad: bool,
) -> tuple[Tensor, Tensor]:
    """Do what `kernels.compositing.rasterize_to_pixels` does, by gsplat, from lists of `tiles_for_gsplat`."""
    splats = (means2d, conics, colors, opacities, width, height)
    return gsplat.rasterize_to_pixels(*splats, backend_gsplat.TILE_SIZE, starts, ids, absgrad=absgrad)


class TorchExchange(Exchange):
    """Sends and receives what torch puts into rows, as if Triton's kernels did not work."""

    def __init__(self, world: World, projected: Projected, bands: Sequence[Band]) -> None:
        super().__init__(world, projected, bands)
        self.fused = False


_OF_STEPS = ("activations", "adam", "losses", "screen_gradients", "statistics")
TWINS: dict[str, Twin] = {
    "activations": Twin("torch", _torch_in("render.activations")),
    "adam": Twin("torch", (Patch("kernels.adam", "adam_step", adam_step),)),
    "losses": Twin("torch", _torch_in("method.losses")),
    "screen_gradients": Twin("torch", _torch_in("method.screen_gradients")),
    "statistics": Twin("torch", _torch_in("method.statistics")),
    "poses": Twin("torch", _torch_in("training.step.poses", "training.step.row_adam"), settings=REFINED),
    "structure_tensor": Twin("torch", _torch_in("method.structure_tensor"), is_once=True),
    "harmonics": Twin("gsplat", (Patch("render.backend_triton", "colors_from_harmonics", colors_from_harmonics),)),
    "projection": Twin("gsplat", (Patch("kernels.projection", "project", project),)),
    "tiles": Twin("gsplat", (Patch("render.backend_triton", "intersect_tiles", gsplat_tiles),), waits=True),
    "compositing": Twin(
        "gsplat",
        (
            Patch("render.backend_triton", "intersect_tiles", tiles_for_gsplat),
            Patch("kernels.compositing", "rasterize_to_pixels", rasterize_to_pixels),
        ),
        waits=True,
    ),
    "exchange": Twin("torch", (Patch("distributed.rasterization", "Exchange", TorchExchange),)),
}
"""The twin of each file of kernels that a run launches. Those of gsplat, which may fail, come last on one device.

Several devices are needed for `exchange` alone.
"""
ALL = Twin(
    "gsplat and torch",
    (
        Patch("render.backend_triton", "project", backend_gsplat.project),
        Patch("render.backend_triton", "composite", backend_gsplat.composite),
        *[patch for name in _OF_STEPS for patch in TWINS[name].patches],
    ),
    waits=True,
)
"""Steps without any of our kernels."""
