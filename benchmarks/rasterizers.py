"""How far the torch splatter is from gsplat: `python -m benchmarks rasterizers` on a CUDA machine.

Renders one random scene with gsplat on CUDA in float32, with gsplat's parts and our tile lists, and with the splatter
on the CPU in float32 and float64, and prints the largest deviations of the images, projections and gradients from
gsplat's as a markdown table.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gsplat
import torch
from torch import Tensor

from benchmarks import command_lines
from sadgs_ns.render.rasterization import rasterize, visible

_PARAMETERS = ("means", "quats", "scales", "opacities", "colors")


def random_scene(gaussians: int, size: int, seed: int) -> dict[str, Tensor]:
    """A cube of Gaussians with SH of degree 3 in front of one camera, with random weights for a loss.

    Args:
        gaussians: Number N of Gaussians.
        size: Width and height S of the image in pixels.
        seed: Of the random numbers.

    Returns:
        float64 CPU tensors: the arguments of `rasterize` by name, and `weights` [1, S, S, 3].
    """
    generator = torch.Generator().manual_seed(seed)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)

    scene = {
        "means": uniform(-1.0, 1.0, gaussians, 3),
        "quats": torch.randn(gaussians, 4, generator=generator, dtype=torch.float64),
        "scales": uniform(0.01, 0.08, gaussians, 3),
        "opacities": uniform(0.05, 0.95, gaussians),
        "colors": 0.3 * torch.randn(gaussians, 16, 3, generator=generator, dtype=torch.float64),
        "viewmats": torch.eye(4, dtype=torch.float64)[None],
        "Ks": torch.tensor([[[1.2 * size, 0.0, 0.5 * size], [0.0, 1.2 * size, 0.5 * size], [0.0, 0.0, 1.0]]]).double(),
        "weights": uniform(0.5, 1.5, 1, size, size, 3),
    }
    scene["viewmats"][0, 2, 3] = 3.0
    # Rounded once, so that every dtype renders the same numbers.
    return {name: tensor.float().double() for name, tensor in scene.items()}


def render_with_gradients(
    scene: dict[str, Tensor], device: str, dtype: torch.dtype, fused: bool = False
) -> dict[str, Tensor]:
    """Images, projections and gradients of mean(weights * colour^2), as float64 CPU tensors.

    Args:
        scene: From `random_scene`.
        device: "cuda" renders with gsplat, "cpu" with the splatter.
        dtype: Floating-point type to render in; gsplat needs float32.
        fused: On CUDA, give gsplat exact tile lists.

    Returns:
        `visible` bool [1, N]; `colour`, `alpha`, `means2d`, `conics`, `absgrad`, and `gradient of ...` per parameter.
    """
    arguments: dict[str, Any] = {name: tensor.to(device, dtype, copy=True) for name, tensor in scene.items()}
    weights = arguments.pop("weights")  # [1, S, S, 3]
    for name in _PARAMETERS:
        arguments[name].requires_grad_()
    height, width = weights.shape[1:3]
    colors, alphas, info = rasterize(
        **arguments, width=width, height=height, sh_degree=3, absgrad=True, fused=fused
    )  # fmt: skip
    (weights * colors.square()).mean().backward()
    results = {"colour": colors, "alpha": alphas, "means2d": info["means2d"], "conics": info["conics"]}
    results |= {f"gradient of {name}": arguments[name].grad for name in _PARAMETERS}
    results["absgrad"] = info["means2d"].absgrad
    return {"visible": visible(info).cpu()} | {name: value.detach().cpu().double() for name, value in results.items()}


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table; returns the exit code, 1 where there is no CUDA device."""
    options = command_lines.rasterizers().parse_args(argv)
    if not torch.cuda.is_available():
        print("This comparison needs a CUDA device for gsplat, and torch finds none.")
        return 1

    scene = random_scene(options.gaussians, options.size, options.seed)
    reference = render_with_gradients(scene, "cuda", torch.float32)
    others = {
        "splatter, float32": render_with_gradients(scene, "cpu", torch.float32),
        "splatter, float64": render_with_gradients(scene, "cpu", torch.float64),
        "exact lists": render_with_gradients(scene, "cuda", torch.float32, fused=True),
    }
    print(f"gsplat {gsplat.__version__}, torch {torch.__version__}, {torch.cuda.get_device_name()}; ", end="")
    print(f"{options.gaussians} Gaussians, {options.size} x {options.size} px, seed {options.seed}. ", end="")
    changed = (f"{int((one['visible'] != reference['visible']).sum())} ({name})" for name, one in others.items())
    print(f"Gaussians visible in one only: {'; '.join(changed)}.\n")
    print("Largest deviation from gsplat, absolute and divided by gsplat's largest absolute value.\n")
    print(f"| quantity | {' | '.join(others)} |")
    print(f"| --- |{' --- |' * len(others)}")
    for name in [key for key in reference if key != "visible"]:
        cells = []
        for one in others.values():
            expected, actual = reference[name], one[name]
            if name in ("means2d", "conics"):
                # gsplat leaves these uninitialised for culled Gaussians.
                drawn = reference["visible"] & one["visible"]
                expected, actual = expected[drawn], actual[drawn]
            deviation = (actual - expected).abs().max().item()
            cells.append(f"{deviation:.1e}, {deviation / expected.abs().max().item():.1e}")
        print(f"| {name} | {' | '.join(cells)} |")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
