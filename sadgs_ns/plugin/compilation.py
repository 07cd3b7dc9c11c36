"""Compiles a run's Triton kernels side by side before training starts, instead of one by one on the way."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait

import torch
from nerfstudio.utils.rich_utils import CONSOLE
from rich.markup import escape
from torch import Tensor

from sadgs_ns.errors import reason
from sadgs_ns.kernels import use_triton
from sadgs_ns.method.absgs import accumulate_gradients, empty_gradients
from sadgs_ns.method.codes import encode
from sadgs_ns.method.color_matrices import correct_colors, identities
from sadgs_ns.method.losses import photometric_loss
from sadgs_ns.method.statistics import empty_statistics, observe
from sadgs_ns.plugin.nonfinite import NonFiniteLog
from sadgs_ns.plugin.optimizers import FusedAdam, RepeatedUpdate, step_together
from sadgs_ns.plugin.pipeline import SadgsPipeline
from sadgs_ns.render.activations import activate
from sadgs_ns.render.rasterization import rasterize

_GAUSSIANS, _SIZE = 64, 64
"""Number of Gaussians, and width and height in px, of the picture on which the kernels are tried."""
_PATIENCE = 2.0
"""Seconds after which the user is told what the run is waiting for."""


def compile_kernels(
    pipeline: SadgsPipeline, optimizers: Mapping[str, torch.optim.Optimizer], cuda_graphs: bool = False
) -> None:
    """Launch the kernels of training once, on a few Gaussians and in threads, whose compilations then overlap.

    Triton keeps what it compiled on the disk: a machine's first run takes seconds here, a later one none. The run
    itself is left as it was, random numbers included.

    A kernel that fails here does not stop the run, which may never need it: the user is told which ones failed and why,
    in one sentence, and training tries them again where it needs them.

    Args:
        pipeline: A pipeline whose model and data are set up.
        optimizers: The run's optimizers, by the names of their parameters.
        cuda_graphs: Whether steps may be captured as CUDA graphs, whose Adam reads its rates from the device.
    """
    model, device = pipeline.model, pipeline.device
    config = model.config
    if not use_triton(device):
        return
    views, n = pipeline.views_per_iteration, _GAUSSIANS
    ramp = torch.linspace(-0.5, 0.5, n, device=device)
    means = torch.stack([ramp, ramp.flip(0), torch.full_like(ramp, 2.0)], dim=-1)
    quats = means.new_tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1)
    scales, opacities = torch.full_like(means, 0.05), torch.full_like(ramp, 0.5)
    viewmats = torch.eye(4, device=device).repeat(views, 1, 1)
    half = _SIZE / 2
    Ks = means.new_tensor([[_SIZE, 0.0, half], [0.0, _SIZE, half], [0.0, 0.0, 1.0]]).repeat(views, 1, 1)
    image = torch.linspace(0.0, 1.0, 3 * _SIZE * _SIZE, device=device).view(1, _SIZE, _SIZE, 3)
    camera = viewmats, Ks, _SIZE, _SIZE
    cameras = pipeline.datamanager.train_dataset.cameras

    def tile_lists() -> None:
        # The size is the run's: whether tiles are numbered in 16 or in 32 bits depends on how many there are, and lists
        # of a given length have one more row of them.
        width, height = int(cameras.width.max()), int(cameras.height.max())
        for capacity in (None, 2**20):
            rasterize(
                means, quats, scales, opacities, means, viewmats, Ks, width, height,
                tile_capacity=capacity, max_off_axis=config.max_off_axis,
            )  # fmt: skip

    def blank(name: str) -> Tensor:
        return means.new_zeros((n, *model.gauss_params[name].shape[1:]))

    def structure() -> None:
        encode(pipeline.structure_maps.of_images(image))

    def loss(dtype: torch.dtype) -> None:  # Images are bytes; behind a mask or with transparency they become floats.
        predicted = image.repeat(views, 1, 1, 1).requires_grad_()
        photometric_loss(predicted, torch.zeros_like(predicted, dtype=dtype))[0].backward()

    def colors() -> None:
        renders, alphas = (torch.zeros((views, _SIZE, _SIZE, k), device=device, requires_grad=True) for k in (3, 1))
        correct_colors(renders, alphas, identities(views).to(device).requires_grad_()).sum().backward()

    def update() -> None:
        log, twins = NonFiniteLog(device, capacity=1), {}
        for name, optimizer in optimizers.items():
            if name in model.trained_params and isinstance(optimizer, FusedAdam) and optimizer.triton:
                # Matrices of colours are fewer than the Gaussians, and so updated in a launch of their own.
                of_gaussians = name in model.gauss_params
                parameter = torch.nn.Parameter(blank(name) if of_gaussians else torch.zeros((1, 3, 4), device=device))
                parameter.grad = torch.zeros_like(parameter)
                twins[name] = FusedAdam([parameter], **{key: optimizer.defaults[key] for key in ("betas", "eps")})
                twins[name].log = log  # all share one log, like the run's, and are stepped in one launch
        step_together(twins.values())
        if cuda_graphs and twins and (repeated := RepeatedUpdate(twins)).begun:
            gradients = {name: torch.zeros_like(parameter) for name, parameter in repeated.parameters.items()}
            repeated.launch(gradients, log.gradients, repeated.factors().to(device))

    def composite(absgrad: bool) -> None:
        centres = means.clone().requires_grad_()
        renders, alphas, info = rasterize(
            centres, quats, scales, opacities, means, *camera, absgrad=absgrad, **model.drawing
        )  # fmt: skip
        black = config.background_color == "black" and model.color_matrices is None
        result = renders.sum() if black else renders.sum() + alphas.sum()
        # The projection is differentiated elsewhere.
        (info["means2d"].grad2d,) = torch.autograd.grad(result, info["means2d"])
        if absgrad:
            accumulate_gradients(empty_gradients(n, device), info, views)

    def activations() -> None:
        for weight in (0.0, 1.0):  # The loss has a part with the mean opacity, but not to the end.
            parameters = scales.clone().requires_grad_(), opacities[:, None].clone().requires_grad_()
            some = activate(*parameters, weight)
            torch.autograd.backward([value.sum() for value in some if value is not None])

    def projection() -> None:
        from sadgs_ns.kernels.harmonics import colors_from_harmonics
        from sadgs_ns.kernels.projection import project

        antialiased = config.rasterize_mode == "antialiased"
        centres, rotations, sizes = (value.clone().requires_grad_() for value in (means, quats, scales))
        radii, means2d, _, conics, compensations, centres = project(
            centres, rotations, sizes, opacities, *camera, antialiased
        )
        results = [means2d, conics] if compensations is None else [means2d, conics, compensations]
        if config.sh_degree > 0:
            coefficients = blank("features_dc"), blank("features_rest")
            results.append(colors_from_harmonics(config.sh_degree, centres, *coefficients, viewmats, radii))
        torch.autograd.backward([value.sum() for value in results])

    def observation() -> None:
        params = {"means": means, "quats": quats, "scales": scales.log()}
        observe(
            empty_statistics(n, device),
            params,  # type: ignore[arg-type]
            info | {"structure_tensors": image.byte().repeat(views, 1, 1, 1), "viewmats": viewmats, "Ks": Ks},
            generator=torch.Generator(device).manual_seed(0),
        )

    def exchange() -> None:
        from sadgs_ns.kernels.exchange import pack, unpack

        seen = [info[name].detach() for name in ("radii", "means2d", "depths", "conics", "opacities")]
        places = torch.arange(views * n, device=device)
        unpack(pack(*(value.contiguous() for value in (*seen, means.expand(views, n, 3))), places=places), 0)

    failures: dict[str, BaseException] = {}
    pending: dict[str, Future[None]] = {}

    def take_device() -> None:
        if device.type == "cuda":  # A new thread has the first device, and Triton launches on a thread's own.
            torch.cuda.set_device(device)

    with ThreadPoolExecutor(initializer=take_device) as pool:  # which waits for its threads, whatever happens
        pending |= {
            "the loss": pool.submit(loss, torch.uint8),
            "S̄": pool.submit(structure),
            "Adam": pool.submit(update),
            "the loss of masked images": pool.submit(loss, torch.float32),
            "activations": pool.submit(activations),
        }
        if model.color_matrices is not None:
            pending["colour matrices"] = pool.submit(colors)
        try:  # the other stages read this projection
            _, _, info = rasterize(means, quats, scales, opacities, means, *camera, max_off_axis=config.max_off_axis)
        except Exception as error:
            failures["rasterization"] = error
        else:
            pending |= {
                "projection and spherical harmonics": pool.submit(projection),
                "η": pool.submit(observation),
                "tile lists": pool.submit(tile_lists),
                "compositing with AbsGS": pool.submit(composite, True),
                "compositing": pool.submit(composite, False),
            }
            if not pipeline.world.alone:
                pending["what travels between devices"] = pool.submit(exchange)
        if wait(pending.values(), timeout=_PATIENCE).not_done:
            CONSOLE.print("Compiling kernels for this GPU, once …")
    failures |= {name: error for name, future in pending.items() if (error := future.exception()) is not None}
    if failures:
        why = escape(reason(next(iter(failures.values()))))
        CONSOLE.print(
            f"[yellow]The kernels of {', '.join(failures)} could not be compiled and tried before training ({why}): "
            "training tries them again, and stops with an error of its own if it cannot do without them.[/]",
            soft_wrap=True,
        )
