"""The stages of a training step on a few Gaussians; together they launch all kernels of a run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from sadgs_ns.method.losses import photometric_loss
from sadgs_ns.method.quantization import quantize
from sadgs_ns.method.screen_gradients import accumulate_gradients, empty_gradients
from sadgs_ns.method.statistics import empty_statistics, observe
from sadgs_ns.method.structure_tensor import multiscale_structure_tensor
from sadgs_ns.render.activations import activate
from sadgs_ns.render.rasterization import rasterize
from sadgs_ns.render.types import Cameras, Gaussians, RenderOptions
from sadgs_ns.training.step.nonfinite import MAX_GRADIENT
from sadgs_ns.training.step.poses import corrected_views
from sadgs_ns.training.step.row_adam import RowUpdate, empty_moments, move_rows

# Number of Gaussians, and width and height in px, with which the kernels are tried
_GAUSSIANS = 64
_SIZE = 64
_DRAWING = RenderOptions(backend="triton")


@dataclass(frozen=True)
class KernelChoice:
    """What decides which kernels a run launches and how they are specialised; the defaults are the method's."""

    device: torch.device
    views: int = 2  # Views of a step
    sh_degree: int = 3
    is_black: bool = True  # Whether nothing is drawn behind the Gaussians
    has_color_matrices: bool = False
    has_gains: bool = False  # Whether photos are compared with renderings at their exposure
    moves_cameras: bool = False  # Whether the cameras' poses have gradients
    single_process: bool = True  # Whether one process holds all Gaussians
    size: tuple[int, int] = (_SIZE, _SIZE)  # Largest width and height of the images, in px
    drawing: RenderOptions = _DRAWING  # With the backend that draws, and a near plane before Gaussians that are tried
    updates: tuple[tuple[tuple[int, ...], ...], ...] = (((3,), (15, 3), (3,), (1,), (4,), (3,)),)
    """Of each launch of Adam the shapes of its parameters, without their first dimension."""
    structure_tensor: Callable[[Tensor], Tensor] = field(default=multiscale_structure_tensor, compare=False)


class Stages:
    """The stages of a training step on a few Gaussians, each a method that launches its kernels."""

    def __init__(self, choice: KernelChoice) -> None:
        self.choice = choice
        self.drawing = choice.drawing
        self.views = choice.views
        n = _GAUSSIANS
        self.device = choice.device
        ramp = torch.linspace(-0.5, 0.5, n, device=self.device)
        self.means = torch.stack([ramp, ramp.flip(0), torch.full_like(ramp, 2.0)], dim=-1)
        quats = self.means.new_tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1)
        self.scales = torch.full_like(self.means, 0.05)
        self.opacities = torch.full_like(ramp, 0.5)
        self.gaussians = Gaussians(self.means, quats, self.scales, self.opacities, self.means)
        viewmats = torch.eye(4, device=self.device).repeat(self.views, 1, 1)
        intrinsics = [[_SIZE, 0.0, _SIZE / 2], [0.0, _SIZE, _SIZE / 2], [0.0, 0.0, 1.0]]
        Ks = self.means.new_tensor(intrinsics).repeat(self.views, 1, 1)
        self.image = torch.linspace(0.0, 1.0, 3 * _SIZE * _SIZE, device=self.device).view(1, _SIZE, _SIZE, 3)
        self.cameras = Cameras(viewmats, Ks, _SIZE, _SIZE)
        self.info: dict[str, Any] = {}  # the rasterizer's, once `project` was called

    def without_projection(self) -> dict[str, Callable[[], None]]:
        """Return the stages that need no projection, by their names for users."""
        stages: dict[str, Callable[[], None]] = {
            "the loss": partial(self.loss, torch.uint8),
            "S̄": self.structure,
            "Adam": self.update,
            "the loss of masked images": partial(self.loss, torch.float32),
            "activations": self.activations,
        }
        if self.choice.moves_cameras:
            stages["poses"] = self.poses
        return stages

    def after_projection(self) -> dict[str, Callable[[], None]]:
        """Return the stages that read what `project` has computed."""
        stages: dict[str, Callable[[], None]] = {
            "η": self.observation,
            "compositing with AbsGS": partial(self.composite, True),
        }
        if self.drawing.backend == "triton":
            stages |= {
                "projection and spherical harmonics": self.projection,
                "tile lists": self.tile_lists,
                "compositing": partial(self.composite, False),
            }
        if not self.choice.single_process:
            stages["what travels between devices"] = self.exchange
        return stages

    def project(self) -> None:
        _, _, self.info = rasterize(self.gaussians, self.cameras, self.drawing)

    def tile_lists(self) -> None:
        # The images' size decides between tile numbers of 16 and 32 bits; lists of given length have one row more.
        width, height = self.choice.size
        cameras = self.cameras._replace(width=width, height=height)
        for capacity in (None, 2**20):
            rasterize(self.gaussians, cameras, replace(self.drawing, tile_capacity=capacity))

    def structure(self) -> None:
        quantize(self.choice.structure_tensor(self.image))

    def loss(self, dtype: torch.dtype) -> None:  # Images are bytes; a mask or transparency makes them floats.
        predicted = self.image.repeat(self.views, 1, 1, 1).requires_grad_()
        clipped_from = None
        if self.choice.has_gains:
            clipped_from = 1.0
        target = torch.zeros_like(predicted, dtype=dtype)
        photometric_loss(predicted, target, clipped_from=clipped_from)[0].backward()

    def poses(self) -> None:
        table = torch.zeros((self.views, 6), device=self.device, requires_grad=True)
        view_ids = torch.arange(self.views, device=self.device)
        corrected_views(self.cameras.viewmats, table, view_ids).sum().backward()
        moved = RowUpdate(torch.zeros(self.views, dtype=torch.bool, device=self.device), torch.zeros_like(table))
        rate = torch.zeros(1, device=self.device)[0]
        state = empty_moments(table.detach())
        flag = torch.zeros(1, device=self.device)
        move_rows(table.detach(), torch.zeros_like(table), state, moved, rate, (0.9, 0.999), 1e-15, flag)

    def update(self) -> None:
        from sadgs_ns.kernels.adam import adam_step

        num_parameters = sum(map(len, self.choice.updates))
        factors = torch.zeros((2, num_parameters), device=self.device)
        flags = ()
        if self.choice.single_process:  # Several wait for the lengths of tile lists, which then cannot overflow.
            flags = (torch.zeros(1, dtype=torch.int64, device=self.device),)
        begin = 0
        nonfinite_flag = torch.zeros(1, device=self.device)
        for shapes in self.choice.updates:
            end = begin + len(shapes)
            part = slice(begin, end)
            begin = end
            # Gradients and both moments may be the parameters themselves: they are all zero.
            values = tuple(self.means.new_zeros((_GAUSSIANS, *shape)) for shape in shapes)
            adam_step(
                values, values, values, values, factors[:, part], nonfinite_flag, flags,
                betas=(0.9, 0.999), eps=1e-15, max_gradient=MAX_GRADIENT,
            )  # fmt: skip

    def composite(self, absgrad: bool) -> None:
        gaussians = self.gaussians._replace(means=self.means.clone().requires_grad_())
        renders, alphas, info = rasterize(gaussians, self.cameras, replace(self.drawing, absgrad=absgrad))
        result = renders.sum()
        if not self.choice.is_black or self.choice.has_color_matrices:  # Then alphas have a gradient, too.
            result = result + alphas.sum()
        # The projection is differentiated elsewhere.
        (info["means2d"].grad2d,) = torch.autograd.grad(result, info["means2d"])
        if absgrad:
            accumulate_gradients(empty_gradients(_GAUSSIANS, self.device), info, self.views)

    def activations(self) -> None:
        for weight in (0.0, 1.0):  # The loss has its opacity term only while densification runs.
            scales = self.scales.clone().requires_grad_()
            opacities = self.opacities[:, None].clone().requires_grad_()
            values = activate(scales, opacities, weight)
            torch.autograd.backward([value.sum() for value in values if value is not None])

    def projection(self) -> None:
        from sadgs_ns.kernels.harmonics import colors_from_harmonics
        from sadgs_ns.kernels.projection import project

        means, quats, scales = (value.clone().requires_grad_() for value in self.gaussians[:3])
        viewmats = self.cameras.viewmats.clone().requires_grad_(self.choice.moves_cameras)
        cameras = self.cameras._replace(viewmats=viewmats)
        radii, means2d, _, conics, centres = project(means, quats, scales, self.opacities, *cameras)
        results = [means2d, conics]
        degree = self.choice.sh_degree
        if degree > 0:
            num_rest = (degree + 1) ** 2 - 1
            rest = self.means.new_zeros((_GAUSSIANS, num_rest, 3))
            results.append(colors_from_harmonics(degree, centres, self.means, rest, viewmats, radii))
        torch.autograd.backward([value.sum() for value in results])

    def observation(self) -> None:
        params: Any = {"means": self.means, "quats": self.gaussians.quats, "scales": self.scales.log()}
        tensors = self.image.byte().repeat(self.views, 1, 1, 1)
        info = self.info | {"structure_tensors": tensors, "viewmats": self.cameras.viewmats, "Ks": self.cameras.Ks}
        observe(empty_statistics(_GAUSSIANS, self.device), params, info, torch.zeros_like(info["means2d"]))

    def exchange(self) -> None:
        from sadgs_ns.kernels.exchange import pack, unpack

        seen = [self.info[name].detach() for name in ("radii", "means2d", "depths", "conics", "opacities")]
        places = torch.arange(self.views * _GAUSSIANS, device=self.device)
        colors = self.means.expand(self.views, _GAUSSIANS, 3)
        unpack(pack(*(value.contiguous() for value in (*seen, colors)), places=places), 0)
