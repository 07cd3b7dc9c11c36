"""Train on 24 drawn photos of a room with the structure-aware strategy, in a plain gsplat loop without nerfstudio.

Run `python -m examples.simple_trainer` in a checkout, on a machine with CUDA.
"""

from collections.abc import Mapping

import numpy as np
import torch
from gsplat import rasterization
from torch import Tensor
from torch.nn import Parameter

from examples.drawn_scene.drawing import render
from examples.drawn_scene.scene import describe_scene
from sadgs_ns.method.strategy import StructureAwareStrategy
from sadgs_ns.method.structure_tensor import multiscale_structure_tensor

RATES = {"means": 5e-4, "scales": 5e-3, "quats": 1e-3, "opacities": 5e-2, "sh0": 2.5e-3, "shN": 1.25e-4}
"""Learning rates of Adam by parameter, named as in gsplat's examples."""


def start_from(points: Tensor, colors: Tensor, scale: float) -> dict[str, Parameter]:
    """Return spheres of one size at points [N, 3], with colours in [0, 1] [N, 3], as gsplat's parameters."""
    number = len(points)
    values = {}
    values["means"] = points
    values["scales"] = torch.full_like(points, scale).log()
    values["quats"] = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(number, 1).to(points)
    values["opacities"] = torch.full_like(points[:, 0], 0.1).logit()
    values["sh0"] = ((colors - 0.5) / 0.2821)[:, None]
    values["shN"] = points.new_zeros((number, 15, 3))
    return {name: Parameter(value) for name, value in values.items()}


def activate(params: Mapping[str, Tensor]) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return means, quaternions, scales, opacities and SH coefficients, as gsplat's rasterization takes them."""
    coefficients = torch.cat([params["sh0"], params["shN"]], dim=1)  # [N, 16, 3]
    return params["means"], params["quats"], params["scales"].exp(), params["opacities"].sigmoid(), coefficients


def train(
    params: dict[str, Parameter],
    images: Tensor,  # [V, H, W, 3] in [0, 1]
    viewmats: Tensor,  # World to camera. [V, 4, 4]
    Ks: Tensor,  # Intrinsics in px. [V, 3, 3]
    scene_scale: float,  # Extent of the cameras, as in 3DGS
    iterations: int,
    strategy: StructureAwareStrategy,
) -> float:
    """Train the parameters, which densification replaces, and return PSNR of the last step's view in dB."""
    optimizers = {}
    for name, rate in RATES.items():
        optimizers[name] = torch.optim.Adam([params[name]], lr=rate, eps=1e-15)
    fitted = strategy.for_run(iterations)
    fitted.check_sanity(params, optimizers)
    state = fitted.initialize_state(scene_scale)
    height, width = images.shape[1:3]
    # This takes 300 bytes a pixel: compute many images in parts.
    tensors = multiscale_structure_tensor(images)
    error = images.new_tensor(1.0)
    for step in range(iterations):
        view = [step % len(images)]  # One view or several; the loss is their mean.
        absgrad = fitted.needs_absgrad(step)
        renders, _, info = rasterization(
            *activate(params), viewmats[view], Ks[view], width, height, sh_degree=3, packed=False, absgrad=absgrad
        )
        # The strategy reads these three beside gsplat's entries.
        info["structure_tensors"] = tensors[view]
        info["viewmats"] = viewmats[view]
        info["Ks"] = Ks[view]
        fitted.step_pre_backward(params, optimizers, state, step, info)
        loss = (renders - images[view]).abs().mean()
        if step < fitted.windows.refine_stop_iter:
            # Gaussians that no image needs fade, and are pruned.
            loss = loss + 0.01 * params["opacities"].sigmoid().mean()
        loss.backward()
        error = (renders.detach() - images[view]).square().mean()
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        fitted.step_post_backward(params, optimizers, state, step, info)
    return float(-10 * error.log10())


def main(device: str = "cuda", width: int = 160, height: int = 120, iterations: int = 1000) -> float:
    """Draw the photos, train on them, print the result, and return its PSNR in dB."""
    scene = describe_scene(width, height, views=24)
    images = np.stack([render(scene.surfaces, view) for view in scene.views])
    viewmats = torch.eye(4).repeat(len(scene.views), 1, 1)
    Ks = torch.eye(3).repeat(len(scene.views), 1, 1)
    for i, view in enumerate(scene.views):
        viewmats[i, :3, :3] = torch.from_numpy(view.rotation)
        viewmats[i, :3, 3] = torch.from_numpy(view.translation)
        Ks[i, :2] = torch.tensor([[view.focal, 0.0, width / 2], [0.0, view.focal, height / 2]])
    points = torch.from_numpy(scene.points).float().to(device)
    colors = torch.from_numpy(scene.colours).to(device) / 255
    params = start_from(points, colors, scale=0.05)
    photos = torch.from_numpy(images).to(device) / 255
    psnr = train(params, photos, viewmats.to(device), Ks.to(device), 1.0, iterations, StructureAwareStrategy())
    print(f"{len(points):,} points became {len(params['means']):,} Gaussians; PSNR {psnr:.2f} dB")
    return psnr


if __name__ == "__main__":
    main()
