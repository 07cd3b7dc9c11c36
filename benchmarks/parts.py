"""Where a training step of a finished run goes: `python -m benchmarks parts RUN`.

Each part of rendering, loss and their backward passes is timed by itself, with the Gaussians and training views of the
run, on a CUDA device. Calls follow each other, so that the host's work counts only where it takes longer than the
GPU's.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import torch
from torch import Tensor

from benchmarks import command_lines
from benchmarks.step import milliseconds
from sadgs_ns import kernels
from sadgs_ns.cli.export import read_gaussians
from sadgs_ns.data.run_cameras import read_cameras
from sadgs_ns.errors import InputError
from sadgs_ns.method.losses import photometric_loss
from sadgs_ns.render.rasterization import viewmats_from_camera_to_world

ROUNDS = 3
"""Rounds of calls, of which the median counts."""
ROOM = 1.25
"""Places in the tile lists, relative to the pairs, about as many as in training."""


def parts(
    params: Mapping[str, Tensor],
    viewmats: Tensor,  # [V, 4, 4]
    Ks: Tensor,  # [V, 3, 3]
    width: int,
    height: int,
    max_off_axis: float,
) -> tuple[dict[str, Callable[[], object]], int]:
    """Return the parts of a step by their names, each of which can be called again and again, and the number of pairs.

    Args:
        params: `means` [N, 3], `quats` [N, 4], log `scales` [N, 3], logit `opacities` [N, 1], `features_dc` [N, 3] and
            `features_rest` [N, K − 1, 3] of degree 3 at most.
        viewmats: World to camera. [V, 4, 4]
        Ks: Intrinsics in px. [V, 3, 3]
        width: px.
        height: px.
        max_off_axis: As `render.rasterization.rasterize` takes it.
    """
    from sadgs_ns.kernels import compositing
    from sadgs_ns.kernels.compositing_forward import composite_forward
    from sadgs_ns.kernels.harmonics import colors_from_harmonics
    from sadgs_ns.kernels.projection import project
    from sadgs_ns.kernels.tiles import intersect_tiles

    views, degree = len(viewmats), round((params["features_rest"].shape[1] + 1) ** 0.5) - 1
    geometry = [params["means"], params["quats"], params["scales"].exp()]
    leaves = [value.clone().requires_grad_() for value in geometry]
    first, rest = (params[name].clone().requires_grad_() for name in ("features_dc", "features_rest"))
    opacities = params["opacities"].sigmoid().flatten()
    cameras = viewmats, Ks, width, height

    def projected() -> tuple[Tensor, ...]:
        return project(*leaves, opacities, *cameras, False)[:4]  # type: ignore[return-value]

    radii, means2d, depths, conics = (value.detach().contiguous() for value in projected())
    each = torch.stack([opacities] * views)

    def colored() -> Tensor:
        return colors_from_harmonics(degree, leaves[0].detach(), first, rest, viewmats, radii)

    ellipses = means2d, radii, depths, conics, each
    counted = partial(intersect_tiles, *ellipses, width, height, compositing.TILE_SIZE, max_off_axis)
    pending = counted()
    pairs = sum(pending.pair_counts.wait())
    capacity = int(ROOM * pairs) + 1
    starts, ids = pending.lists(capacity)
    splats = [value.detach().clone().requires_grad_() for value in (means2d, conics, colored(), each)]
    drawn = [value.detach() for value in splats]
    renders, _ = partial(compositing.rasterize_to_pixels, *splats)(width, height, starts, ids, False)
    upstream, target = torch.rand_like(renders), torch.zeros_like(renders, dtype=torch.uint8)
    image = renders.detach().requires_grad_()
    return {
        "projection": projected,
        "projection, with gradient": lambda: torch.autograd.grad([v.sum() for v in projected()[1:]], leaves),
        "harmonics": colored,
        "harmonics, with gradient": lambda: torch.autograd.grad(colored().sum(), [first, rest]),
        "tiles counted, order by depth": counted,
        "tile lists": lambda: pending.lists(capacity),
        "compositing": partial(composite_forward, *drawn, width, height, starts, ids),
        "compositing's gradient": lambda: torch.autograd.grad(renders, splats, upstream, retain_graph=True),
        "loss": lambda: photometric_loss(image, target),
        "loss, with gradient": lambda: torch.autograd.grad(photometric_loss(image, target)[0], [image]),
    }, pairs


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table; returns the exit code, 1 where there is no CUDA device with Triton, 2 where the run is wrong."""
    options = command_lines.parts().parse_args(argv)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if not kernels.available(device):
        print("The parts are our Triton kernels, which need a CUDA device.", file=sys.stderr)
        return 1
    try:
        folder = options.run if options.run.is_dir() else options.run.parent
        params = {name: value.to(device) for name, value in read_gaussians(folder).items()}
        cameras = read_cameras(folder, options.data, split="train")
    except InputError as error:
        print(f"python -m benchmarks parts: {error}", file=sys.stderr)
        return 2
    same = [i for i, size in enumerate(cameras.sizes) if size == cameras.sizes[0]][: options.views]
    width, height = cameras.sizes[0]
    viewmats = viewmats_from_camera_to_world(cameras.camera_to_worlds[same]).to(device)
    timed, pairs = parts(params, viewmats, cameras.Ks[same].to(device), width, height, options.max_off_axis)
    print(
        f"{len(params['means']):,} Gaussians, {len(same)} views of {width}×{height}, {pairs / 1e6:.2f} million pairs "
        f"of a Gaussian and a tile, torch {torch.__version__}.\n"
    )
    print("| part | ms |\n| --- | ---: |")
    for name, function in timed.items():
        print(f"| {name} | {milliseconds(function, ROUNDS):.3f} |", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
