"""What every Triton kernel computes from fixed random inputs, for `benchmarks.hashes`.

Import this only where TRITON_INTERPRET is 1: Triton then runs the kernels in its interpreter, on the CPU. Where the
package chooses between a kernel and torch in a function, that function is called, so that its part is hashed, too.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple
from unittest import mock

import torch
from torch import Tensor

from sadgs_ns import gsplat_compat
from sadgs_ns.kernels import TILE_SIZE, projection, triton_switched
from sadgs_ns.kernels.adam import adam_step, rate_and_scale
from sadgs_ns.kernels.compositing import rasterize_to_pixels
from sadgs_ns.kernels.exchange import pack, unpack
from sadgs_ns.kernels.harmonics import colors_from_harmonics
from sadgs_ns.kernels.projection_forward import project_forward
from sadgs_ns.kernels.tiles import intersect_tiles
from sadgs_ns.method.losses import photometric_loss
from sadgs_ns.method.quantization import quantize
from sadgs_ns.method.screen_gradients import accumulate_gradients, empty_gradients
from sadgs_ns.method.statistics import empty_statistics, observe, observed_eta
from sadgs_ns.method.structure_tensor import multiscale_structure_tensor
from sadgs_ns.render.activations import activate
from sadgs_ns.render.rasterization import rasterize
from sadgs_ns.render.types import Cameras, Gaussians, RenderOptions

WIDTH = 75
"""Width of the images in px: no multiple of a tile's, or of what a program handles. So is the height."""
HEIGHT = 50
VIEWS = 3
"""Number of views."""
N = 150
"""Number of Gaussians: more than the 128 that a program handles."""
Results = dict[str, Tensor]
"""Outputs and gradients by name."""


class Random:
    """Random float32 tensors, the same for the same seed."""

    def __init__(self, seed: int) -> None:
        self.generator = torch.Generator().manual_seed(seed)

    def normal(self, *shape: int) -> Tensor:
        """Draw from the standard normal distribution."""
        return torch.randn(shape, generator=self.generator)

    def uniform(self, low: float, high: float, *shape: int) -> Tensor:
        """Draw evenly from [low, high)."""
        return low + (high - low) * torch.rand(shape, generator=self.generator)

    def integers(self, low: int, high: int, *shape: int) -> Tensor:
        """Draw evenly from low … high − 1. int64"""
        return torch.randint(low, high, shape, generator=self.generator)


class Projection(NamedTuple):
    """Gaussians as V views see them, as in `render.types.Projected`, but made up."""

    radii: Tensor  # px, 0 where a Gaussian is culled. int32 [V, N] (gsplat 1.4) or [V, N, 2] (gsplat 1.5)
    means2d: Tensor  # px. [V, N, 2]
    depths: Tensor  # [V, N]
    conics: Tensor  # 1/px². [V, N, 3]
    opacities: Tensor  # [V, N]


def random_projection(
    random: Random, per_axis: bool, views: int = VIEWS, n: int = N, size: tuple[int, int] = (WIDTH, HEIGHT)
) -> Projection:
    """Make Gaussians of all sizes, some of them long and thin, faint, opaque, culled or off the image of `size` px."""
    factors = random.normal(views, n, 2, 2) * torch.exp(random.uniform(-1.0, 3.0, views, n, 1, 1))
    factors[:, ::4, :, 1] *= 1e-3
    covariances = factors @ factors.mT + 0.3 * torch.eye(2)  # px²
    a = covariances[..., 0, 0]
    b = covariances[..., 0, 1]
    c = covariances[..., 1, 1]
    determinants = a * c - b * b
    conics = torch.stack([c, -b, a], dim=-1) / determinants[..., None]
    radii = torch.ceil(3 * torch.stack([a, c], dim=-1).sqrt()).int()
    radii[:, ::11] = 0
    if not per_axis:
        radii = radii.amax(dim=-1)
    opacities = random.uniform(0.0, 1.0, views, n)
    opacities[:, ::7] = 0.003  # less than 1/255
    opacities[:, ::5] = 1.0
    means2d = random.uniform(-0.2, 1.2, views, n, 2) * torch.tensor(size)
    return Projection(radii, means2d, random.uniform(0.5, 5.0, views, n), conics, opacities)


class World(NamedTuple):
    """Gaussians and cameras, as in `render.types`."""

    means: Tensor  # [N, 3]
    quats: Tensor  # [N, 4]
    scales: Tensor  # [N, 3]
    viewmats: Tensor  # [V, 4, 4]
    Ks: Tensor  # [V, 3, 3]


def random_world(random: Random) -> World:
    """Make Gaussians before cameras that are turned and moved a little; some lie far off the images."""
    means = random.normal(N, 3) * torch.tensor([2.0, 2.0, 0.5]) + torch.tensor([0.0, 0.0, 4.0])
    scales = torch.exp(random.uniform(-4.0, 0.0, N, 3))
    angles = random.uniform(-0.2, 0.2, VIEWS)
    viewmats = torch.eye(4).repeat(VIEWS, 1, 1)
    viewmats[:, 0, 0] = angles.cos()
    viewmats[:, 0, 2] = angles.sin()
    viewmats[:, 2, 0] = -angles.sin()
    viewmats[:, 2, 2] = angles.cos()
    viewmats[:, :3, 3] = 0.2 * random.normal(VIEWS, 3)
    K = torch.tensor([[60.0, 0.0, 38.0], [0.0, 70.0, 24.0], [0.0, 0.0, 1.0]])
    return World(means, 3 * random.normal(N, 4), scales, viewmats, K.repeat(VIEWS, 1, 1))


def with_gradients(random: Random, function: Callable[..., Any], inputs: Mapping[str, Tensor]) -> Results:
    """Call a function with tensors by name, and differentiate the sum of its results times random weights.

    Args:
        random: Draws the weights.
        function: Returns a tensor, or several, some of which may be None.
        inputs: The function's arguments, by which its results are differentiated.
    """
    leaves = {name: value.clone().requires_grad_() for name, value in inputs.items()}
    returned = function(**leaves)
    if isinstance(returned, Tensor):
        returned = [returned]
    outputs = [value for value in returned if value is not None]
    results = {f"output {place}": value.detach() for place, value in enumerate(outputs)}
    differentiable = [value for value in outputs if value.requires_grad]
    torch.autograd.backward(differentiable, [random.normal(*value.shape) for value in differentiable])
    for name, leaf in leaves.items():
        if leaf.grad is not None:
            results[f"gradient of {name}"] = leaf.grad
        for kept in ("absgrad", "grad2d"):  # Compositing leaves these at the projected centres.
            if hasattr(leaf, kept):
                results[f"{kept} of {name}"] = getattr(leaf, kept)
    return results


def named(case: str, results: Results) -> Results:
    """Put the case before the names of its results."""
    return {f"{case}: {name}": tensor for name, tensor in results.items()}


def activations() -> Results:
    """Activate 1,500 Gaussians, with and without the penalty of opacities."""
    random = Random(1)
    inputs = {"log_scales": random.normal(1500, 3), "logits": 3 * random.normal(1500, 1)}
    found: Results = {}
    for penalty in (0.0, 0.3):
        function = partial(activate, penalty=penalty)
        found |= named(f"penalty {penalty}", with_gradients(random, function, inputs))
    return found


def adam() -> Results:
    """Update six parameters three times, once by gradients that are not finite, and with flags of overflow."""
    random = Random(2)
    shapes = [(3,), (15, 3), (3,), (1,), (4,), (3,)]
    betas = (0.9, 0.999)
    found: Results = {}
    for flags in ([], [1, 0], [1, 1]):
        parameters = tuple(random.normal(N, *shape) for shape in shapes)
        exp_avgs = tuple(torch.zeros_like(parameter) for parameter in parameters)
        exp_avg_sqs = tuple(torch.zeros_like(parameter) for parameter in parameters)
        nonfinite_flag = torch.zeros(1)
        overflowed = tuple(torch.tensor([flag]) for flag in flags)
        for step in (1, 2, 3):
            gradients = tuple(random.normal(N, *shape) for shape in shapes)
            if step == 2:
                gradients[0][0, 0] = math.nan
                gradients[1][1, 1, 1] = math.inf
                gradients[2][2, 2] = -1e30
            columns = [rate_and_scale(step, 10.0**-power, betas) for power in range(len(shapes))]
            factors = torch.tensor(columns).T.contiguous()
            adam_step(
                parameters, gradients, exp_avgs, exp_avg_sqs, factors, nonfinite_flag, overflowed,
                betas=betas, eps=1e-15, max_gradient=1e18,
            )  # fmt: skip
        case = f"flags {flags}"
        found[f"{case}: nonfinite flag"] = nonfinite_flag
        for place in range(len(shapes)):
            found[f"{case}: parameter {place}"] = parameters[place]
            found[f"{case}: exp_avg {place}"] = exp_avgs[place]
            found[f"{case}: exp_avg_sq {place}"] = exp_avg_sqs[place]
    return found


def compositing() -> Results:
    """Composite two views, with and without absolute gradients, and with and without gradients by the alphas."""

    def composite(reads_alphas: bool, **arguments: Any) -> list[Tensor]:
        """Return the results that `with_gradients` differentiates."""
        renders, alphas = rasterize_to_pixels(**arguments)
        if reads_alphas:
            return [renders, alphas]
        return [renders]

    found: Results = {}
    for absgrad in (False, True):
        for reads_alphas in (False, True):
            random = Random(4)
            projected = random_projection(random, per_axis=False, views=2, n=60)
            pending = intersect_tiles(**projected._asdict(), width=WIDTH, height=HEIGHT, tile_size=TILE_SIZE)
            lists = pending.lists()
            inputs = {
                "means2d": projected.means2d,
                "conics": projected.conics,
                "colors": random.uniform(0.0, 1.0, 2, 60, 3),
                "opacities": projected.opacities,
            }
            function = partial(
                composite, reads_alphas, width=WIDTH, height=HEIGHT,
                isect_offsets=lists.starts, flatten_ids=lists.ids, absgrad=absgrad,
            )  # fmt: skip
            found |= named(f"absgrad {absgrad}, alphas {reads_alphas}", with_gradients(random, function, inputs))
    return found


def exchange() -> Results:
    """Pack 200 rows for another process, some of them twice, and unpack them."""
    found: Results = {}
    for per_axis in (False, True):
        random = Random(5)
        projected = random_projection(random, per_axis)
        places = random.integers(0, VIEWS * N, 200)
        rows = pack(*projected, random.normal(VIEWS, N, 3), places)
        case = f"radius per axis {per_axis}"
        found[f"{case}: rows"] = rows
        for top in (0, 16):
            for place, tensor in enumerate(unpack(rows, top)):
                found[f"{case}, from row {top}: tensor {place}"] = tensor
    return found


def harmonics() -> Results:
    """Compute colours of all degrees."""
    found: Results = {}
    for degree in (0, 1, 2, 3):
        random = Random(6)
        radii = random_projection(random, per_axis=degree % 2 == 1).radii
        world = random_world(random)
        inputs = {"means": world.means, "first": random.normal(N, 3), "rest": 0.3 * random.normal(N, 15, 3)}
        function = partial(colors_from_harmonics, degree, viewmats=world.viewmats, radii=radii)
        found |= named(f"degree {degree}", with_gradients(random, function, inputs))
    return found


def losses() -> Results:
    """Compare views with bytes, also where they are clipped, and with floats that are equal in one half.

    The last loss has a penalty.
    """
    random = Random(7)
    shape = (2, 21, 47, 3)
    pixels = random.integers(0, 256, *shape).byte()
    floats = pixels / 255.0
    predicted = floats + 0.1 * random.normal(*shape)
    to_bytes = partial(photometric_loss, target=pixels)
    found = named("bytes", with_gradients(random, to_bytes, {"predicted": predicted}))
    to_clipped = partial(photometric_loss, target=pixels, clipped_from=0.5)
    found |= named("clipped bytes", with_gradients(random, to_clipped, {"predicted": predicted}))
    predicted[:, :10] = floats[:, :10]
    inputs = {"predicted": predicted, "parts": random.uniform(-0.1, 0.3, 7)}
    to_floats = partial(photometric_loss, target=floats, ssim_lambda=0.3, l2_lambda=1.5)
    return found | named("floats", with_gradients(random, to_floats, inputs))


@contextmanager
def projected_as(projected: Projection) -> Iterator[None]:
    """Meanwhile take this in place of what the forward projection returns, so that Gaussians of all forms are drawn."""
    results = (projected.radii, projected.means2d, projected.depths, projected.conics)
    with mock.patch.object(projection, "project_forward", lambda *arguments: results):
        yield


def projections() -> Results:
    """Differentiate projections, with and without gradients by depths and through the centres."""

    def results(count: int, **arguments: Any) -> tuple[Tensor, ...]:
        _, means2d, depths, conics, means = projection.project(**arguments, width=WIDTH, height=HEIGHT)
        return (means2d, conics, depths, means)[:count]

    found: Results = {}
    for per_axis in (False, True):
        for count in (1, 2, 4):
            random = Random(8)
            projected = random_projection(random, per_axis)
            world = random_world(random)
            inputs = {"means": world.means, "quats": world.quats, "scales": world.scales}
            others = {"opacities": projected.opacities[0], "viewmats": world.viewmats, "Ks": world.Ks}
            with projected_as(projected):
                gradients = with_gradients(random, partial(results, count, **others), inputs)
            found |= named(f"radius per axis {per_axis}, {count} outputs", gradients)
    return found


def forward_projections() -> Results:
    """Project Gaussians, with one radius and with two.

    Only radii are hashed of Gaussians that are not drawn, because the kernel does not write their other outputs.
    """
    found: Results = {}
    for per_axis in (False, True):
        random = Random(15)
        world = random_world(random)
        opacities = random.uniform(0.0, 1.0, N)
        arguments = (world.means, world.quats, world.scales, opacities, world.viewmats, world.Ks, WIDTH, HEIGHT)
        with mock.patch.object(gsplat_compat, "RADII_PER_AXIS", per_axis):
            radii, means2d, depths, conics = project_forward(*arguments)
        is_drawn = gsplat_compat.drawn(radii, means2d)
        results = {"radii": radii}
        for place, output in enumerate((means2d, depths, conics)):
            results[f"output {place}"] = output[is_drawn]
        found |= named(f"radius per axis {per_axis}", results)
    return found


def random_structure_tensors(random: Random) -> Tensor:
    """Make positive semidefinite tensors (xx, xy, yy) of all sizes, with masked pixels. [V, H, W, 3]"""
    factors = random.normal(VIEWS, HEIGHT, WIDTH, 2, 2) * torch.exp(
        random.uniform(-6.0, 1.0, VIEWS, HEIGHT, WIDTH, 1, 1)
    )
    products = factors @ factors.mT
    tensors = torch.stack([products[..., 0, 0], products[..., 0, 1], products[..., 1, 1]], dim=-1)
    tensors[:, :, 30:36] = math.nan
    tensors[0, :10, :10] = 0.0
    return tensors


def screen_gradients() -> Results:
    """Add the gradients of two backward passes, parts of rows as compositing returns them; some are not finite."""
    found: Results = {}
    for per_axis in (False, True):
        random = Random(10)
        projected = random_projection(random, per_axis)
        sums = empty_gradients(N, torch.device("cpu"))
        for _ in range(2):
            rows = random.normal(VIEWS, N, 12)
            rows[0, 3, 0] = math.nan
            rows[1, 4, 10] = math.inf
            means2d: Any = projected.means2d.clone()
            means2d.grad2d = rows[..., :2]
            means2d.absgrad = rows[..., 9:11].abs()
            info = {"radii": projected.radii, "means2d": means2d, "width": WIDTH, "height": HEIGHT}
            accumulate_gradients(sums, info, VIEWS)
        found |= named(f"radius per axis {per_axis}", sums)
    return found


def statistics() -> Results:
    """Observe η twice, in structure tensors of bytes and of 16-bit floats."""
    found: Results = {}
    for per_axis in (False, True):
        random = Random(11)
        projected = random_projection(random, per_axis)
        world = random_world(random)
        params: Any = {"means": world.means, "quats": world.quats, "scales": world.scales.log()}
        tensors = random_structure_tensors(random)
        info = {**projected._asdict(), "viewmats": world.viewmats, "Ks": world.Ks, "width": WIDTH, "height": HEIGHT}
        for kept in (quantize(tensors), tensors.half()):
            info["structure_tensors"] = kept
            sums = empty_statistics(N, torch.device("cpu"))
            for _ in range(2):
                jitter = random.uniform(0.0, 1.0, VIEWS, N, 2)
                observe(sums, params, info, jitter)
            sums["eta"] = observed_eta(params, info, jitter)
            found |= named(f"radius per axis {per_axis}, {kept.dtype}", sums)
    return found


def structure_tensor() -> Results:
    """Compute S̄ of one image twice: with the defaults, and with a mask and as the paper prints eq. 3 to 5."""
    random = Random(12)
    images = random.uniform(0.0, 1.0, 1, 7, 70, 3)
    masks = random.uniform(0.0, 1.0, 1, 7, 70) < 0.8
    return {
        "defaults": multiscale_structure_tensor(images),
        "masked, epsilon given": multiscale_structure_tensor(images, masks, energy_blur=0.0, epsilon=1e-3),
    }


def tiles() -> Results:
    """List the Gaussians of tiles, in lists of exact, sufficient and too small a length."""
    size = (320, 240)
    found: Results = {}
    for per_axis in (False, True):
        random = Random(13)
        projected = random_projection(random, per_axis, views=2, n=60, size=size)
        projected.radii[:, 1] = 2000  # These cover all 1,200 tiles, and are listed in parts.
        projected.conics[:, 1] = torch.tensor([1e-6, 0.0, 1e-6])
        projected.opacities[:, 1] = 0.5
        options: dict[str, Any] = {"width": size[0], "height": size[1], "tile_size": TILE_SIZE, "max_off_axis": 0.0}
        if per_axis:
            options["max_off_axis"] = 1.2
        pending = intersect_tiles(**projected._asdict(), **options)
        case = f"radius per axis {per_axis}"
        found[f"{case}: order"] = pending.order
        found[f"{case}: ends"] = pending.ends
        needed = int(pending.ends[-1])
        for capacity in (None, needed + 50, needed - 1):
            lists = pending.lists(capacity)
            of_lists = lists._asdict() | {"radii": projected.radii.clone()}
            unit = "exact" if capacity is None else f"{capacity - needed:+}"
            found |= named(f"{case}, length {unit}", of_lists)
    return found


def rasterization() -> Results:
    """Rasterize through the Triton backend, with harmonics and absolute gradients."""

    def draw(means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, first: Tensor, rest: Tensor) -> Any:
        gaussians = Gaussians(means, quats, scales, opacities, (first, rest))
        cameras = Cameras(world.viewmats, world.Ks, WIDTH, HEIGHT)
        renders, alphas, info = rasterize(gaussians, cameras, options)
        found.update({name: value for name, value in info.items() if isinstance(value, Tensor)})
        return renders, alphas

    random = Random(14)
    world = random_world(random)
    options = RenderOptions(sh_degree=3, max_off_axis=1.3, absgrad=True, backend="triton")
    found: Results = {}
    inputs = {
        "means": world.means,
        "quats": world.quats,
        "scales": world.scales,
        "opacities": random.uniform(0.0, 1.0, N),
        "first": random.normal(N, 3),
        "rest": 0.3 * random.normal(N, 15, 3),
    }
    with projected_as(random_projection(random, per_axis=True)):
        drawn = with_gradients(random, draw, inputs)
    return found | drawn


KERNELS: dict[str, Callable[[], Results]] = {
    "activations": activations,
    "adam": adam,
    "compositing": compositing,
    "exchange": exchange,
    "harmonics": harmonics,
    "losses": losses,
    "projection": projections,
    "projection_forward": forward_projections,
    "screen_gradients": screen_gradients,
    "statistics": statistics,
    "structure_tensor": structure_tensor,
    "tiles": tiles,
    "rasterization": rasterization,
}
"""By the names of the files in `sadgs_ns/kernels`, what their kernels compute; the last entry calls several."""


def results_of(kernel: str) -> Results:
    """Compute the outputs and gradients of one of KERNELS."""
    with triton_switched(True):
        return KERNELS[kernel]()
