"""`python -m examples.drawn_scene.split FOLDER`: two pictures of a structure step, by the method's own functions.

`split.png` has one Gaussian in front of a grating: its axes beside the wavelength, and its children. `eta-step.png` has
η of equal Gaussians in front of the drawn scene, before and after a step. A unit of the world is a pixel.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from torch import Tensor

from examples.drawn_scene.drawing import render
from examples.drawn_scene.scene import arc_views, room_surfaces
from sadgs_ns.atomic import atomic_path
from sadgs_ns.errors import WriteError
from sadgs_ns.method.eta import eta, projected_axes, wavelength
from sadgs_ns.method.split import children_per_axis, grid_split
from sadgs_ns.method.statistics import consistent, empty_statistics, observe
from sadgs_ns.method.structure_tensor import FREQUENCY_CONSTANT, multiscale_structure_tensor
from sadgs_ns.plugin.color_scales import ETA, PERIOD, Panel, draw, to_picture
from sadgs_ns.plugin.gaussian_maps import eta_map
from sadgs_ns.plugin.texture import texture_period
from sadgs_ns.render.rasterization import rasterize

Gaussians = dict[str, torch.nn.Parameter]
"""gsplat's parameters by name, each with leading dimension N."""

DISTANCE = 300.0
"""Of the Gaussians from the camera, and its focal length in px."""
SIDE, PITCH, ANGLE = 96, 16.0, math.radians(20)
"""Of the grating: its image in px, its period in px, and the direction in which it varies."""
AXES, TURN = (26.0, 10.0, 0.5), math.radians(-15)
"""Standard deviations of the Gaussian in front of it in px, and the direction of its longest axis."""
WIDTH, HEIGHT, SPACING = 216, 144, 18
"""Of the drawn scene's image, and between the Gaussians in front of it, in px; half of that is their deviation."""
LOOKS, TAU_SPLIT = 8, 0.8
"""Observations of each Gaussian, and the share of them that must violate."""
PARENT, CHILD = "#D55E00", "#0072B2"
"""Colours, of Okabe and Ito."""
CHILD_SCALE = 1.5
"""Of `sadgs`; the paper's is 1."""


def camera(width: int, height: int) -> tuple[Tensor, Tensor]:
    """World-to-camera matrix [1, 4, 4] and intrinsics [1, 3, 3] of a camera that looks along z at an image's middle."""
    K = torch.tensor([[DISTANCE, 0, width / 2], [0, DISTANCE, height / 2], [0, 0, 1]])
    return torch.eye(4)[None], K[None]


def gaussians(means: Tensor, scales: Sequence[float], turn: float = 0.0) -> Gaussians:
    """Equal Gaussians at that distance.

    Args:
        means: Right and down from the image's middle, in px. [N, 2]
        scales: Standard deviations along the three axes, in px.
        turn: Of their axes in the image's plane, in radians.
    """
    number = len(means)
    parameters = {
        "means": torch.cat([means, torch.full((number, 1), DISTANCE)], dim=1),
        "quats": torch.tensor([[math.cos(turn / 2), 0, 0, math.sin(turn / 2)]]).repeat(number, 1),
        "scales": torch.tensor([scales]).log().repeat(number, 1),
        "opacities": torch.full((number,), 2.0),
    }
    return {name: torch.nn.Parameter(value, requires_grad=False) for name, value in parameters.items()}


def split(params: Gaussians, counts: Tensor, child_scale: float = 1.0) -> Gaussians:
    """The Gaussians after a split; those that are given stay as they are.

    Args:
        counts: n per axis. int64 [N, 3]
        child_scale: As for `grid_split`.
    """
    after = {name: torch.nn.Parameter(value.clone(), requires_grad=False) for name, value in params.items()}
    optimizers: dict[str, torch.optim.Optimizer] = {name: torch.optim.SGD([value]) for name, value in after.items()}
    grid_split(after, optimizers, {}, counts, child_scale)
    return after


def axes_of(params: Gaussians, width: int, height: int) -> Tensor:
    """The axes of Gaussians in the image, in px. [N, 3, 2]"""
    viewmats, Ks = (matrix.expand(len(params["means"]), -1, -1) for matrix in camera(width, height))
    return projected_axes(params["means"], params["quats"], params["scales"].exp(), viewmats, Ks, width, height)


def grating() -> Tensor:
    """A grey sine. [SIDE, SIDE, 3]"""
    pixels = torch.arange(SIDE) + 0.5
    phase = (pixels[None] * math.cos(ANGLE) + pixels[:, None] * math.sin(ANGLE)) * (2 * math.pi / PITCH)
    return (0.5 + 0.4 * phase.sin())[..., None].expand(-1, -1, 3)


def draw_ellipses(axes: Axes, params: Gaussians, **looks: Any) -> None:
    """Draw the image of each Gaussian, one standard deviation to all sides, and its centre."""
    for mean, vectors in zip(params["means"], axes_of(params, SIDE, SIDE), strict=True):
        variances, directions = torch.linalg.eigh(vectors.T @ vectors)
        (height, width), (x, y) = (2 * variances.sqrt()).tolist(), (mean[:2] + SIDE / 2).tolist()
        angle = math.degrees(math.atan2(directions[1, 1], directions[0, 1]))
        axes.add_patch(Ellipse((x, y), width, height, angle=angle, fill=False, **looks))
        axes.plot(x, y, ".", color=looks["color"])


def draw_split() -> Figure:
    """A Gaussian in front of a grating, and its children as the paper and as `sadgs` have them."""
    image, middle = grating(), SIDE / 2
    tensor = multiscale_structure_tensor(image[None])[0, SIDE // 2, SIDE // 2]
    parent = gaussians(torch.zeros(1, 2), AXES, TURN)
    violations = eta(axes_of(parent, SIDE, SIDE), tensor[None])  # [1, 3]
    counts = children_per_axis(violations, violations > 1)
    n_x, n_y, _ = counts[0].tolist()
    shown = {
        "a Gaussian": parent,  # Its η is that of S̄ under its centre.
        f"its {n_x} × {n_y} children": split(parent, counts),
        f"the same, {CHILD_SCALE:g} times as long": split(parent, counts, CHILD_SCALE),
    }
    start = torch.tensor([0.08, 0.12]) * SIDE
    end = start + float(wavelength(tensor)) * torch.tensor([math.cos(ANGLE), math.sin(ANGLE)])
    figure = Figure(figsize=(7.2, 2.2), layout="constrained")
    for axes, (title, params) in zip(figure.subplots(1, 3), shown.items(), strict=True):
        violations = eta(axes_of(params, SIDE, SIDE)[:1], tensor[None])[0].tolist()
        axes.imshow(0.75 + 0.25 * image, extent=(0, SIDE, SIDE, 0))
        axes.set_title(f"{title}\nη = {violations[0]:.1f} and {violations[1]:.1f}", fontsize=9)
        axes.set(xticks=[], yticks=[], ylim=(0.8 * SIDE, 0.05 * SIDE))
        axes.plot(*zip(start.tolist(), end.tolist(), strict=True), color="black", linewidth=4, solid_capstyle="butt")
        axes.text(float(end[0]) + 2, float(end[1]), "Λ", va="center", fontsize=9)
        if params is parent:
            draw_ellipses(axes, params, color=PARENT, linewidth=2)
            for name, vector in zip(("v₁", "v₂"), axes_of(parent, SIDE, SIDE)[0], strict=False):
                tip, arrow = (vector + middle).tolist(), {"arrowstyle": "->", "shrinkA": 0, "shrinkB": 0}
                axes.annotate("", tip, (middle, middle), arrowprops=arrow)
                axes.annotate(name, tip, (4, 0), textcoords="offset points", fontsize=9)
        else:
            draw_ellipses(axes, parent, color=PARENT, linestyle=":")
            draw_ellipses(axes, params, color=CHILD, linewidth=2)
    return figure


def observed(params: Gaussians, structure_tensor: Tensor) -> dict[str, Tensor]:
    """η's statistics of Gaussians, each of which is looked at several times from one place.

    Args:
        structure_tensor: Of the image. [HEIGHT, WIDTH, 3]
    """
    generator = torch.Generator().manual_seed(0)
    statistics = empty_statistics(len(params["means"]), generator.device)
    viewmats, Ks = camera(WIDTH, HEIGHT)
    scales, opacities = params["scales"].exp(), params["opacities"].sigmoid()
    values = torch.zeros(len(scales), 3)
    _, _, info = rasterize(params["means"], params["quats"], scales, opacities, values, viewmats, Ks, WIDTH, HEIGHT)
    info |= {"viewmats": viewmats, "Ks": Ks, "structure_tensors": structure_tensor[None]}
    for _ in range(LOOKS):
        observe(statistics, params, info, generator=generator)
    return statistics


def eta_panels() -> list[Panel]:
    """The drawn scene, and η of Gaussians in front of it before and after a step."""
    photo = torch.from_numpy(render(room_surfaces(), arc_views(40, WIDTH, HEIGHT)[4])) / 255
    structure_tensor = multiscale_structure_tensor(photo[None])[0]
    x, y = torch.arange(SPACING / 2, WIDTH, SPACING), torch.arange(SPACING / 2, HEIGHT, SPACING)
    means = torch.cartesian_prod(x - WIDTH / 2, y - HEIGHT / 2)
    before = gaussians(means, (SPACING / 2, SPACING / 2, 0.5))
    statistics = observed(before, structure_tensor)
    violates = consistent(statistics["n_high"], statistics["n_total"], TAU_SPLIT)
    after = split(before, children_per_axis(statistics["eta_max"], violates))
    (viewmat,), (K,) = camera(WIDTH, HEIGHT)
    period = texture_period(structure_tensor, FREQUENCY_CONSTANT)
    panels = [Panel("the image", to_picture(photo)), Panel("local wavelength", PERIOD(period), PERIOD)]
    for title, params in (("before", before), ("after one structure step", after)):
        eta_now = eta_map(params, observed(params, structure_tensor), viewmat, K, WIDTH, HEIGHT)
        panels.append(Panel(f"η {title}: {len(params['means']):,} Gaussians", ETA(eta_now), ETA))
    return panels


def main(arguments: Sequence[str] | None = None) -> int:
    """Draw both pictures and return the exit code, 2 if they cannot be written."""
    parser = argparse.ArgumentParser(
        prog="python -m examples.drawn_scene.split", description="Draw what a structure step does."
    )
    parser.add_argument("folder", type=Path, help="takes split.png and eta-step.png")
    folder = parser.parse_args(arguments).folder
    try:
        with atomic_path(folder / "split.png") as partial:
            draw_split().savefig(partial, dpi=200, metadata={"Software": None})
        draw(folder / "eta-step.png", eta_panels(), columns=2)
    except WriteError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
