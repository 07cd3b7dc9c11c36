"""Gaussians far off a view's axis are not drawn."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch

from helpers.gsplat_like import rasterization
from helpers.rendered_scene import random_scene
from sadgs_ns.render.off_axis import cull_off_axis
from sadgs_ns.render.rasterization import visible

WIDTH = 40
HEIGHT = 30


def test_the_distance_counts_in_half_images_along_each_axis():
    # The centre, then points just within and just beyond two half images along x and along y, then no point at all.
    points = [(20, 15), (59.9, 15), (60.1, 15), (-19.9, 15), (20, 44.9), (20, 45.1), (20, -15.1), (math.nan, 15)]
    means2d = torch.tensor([points], dtype=torch.float32)
    expected = [True, True, False, True, True, False, False, False]
    for radii in (torch.full((1, 8), 3, dtype=torch.int32), torch.full((1, 8, 2), 3, dtype=torch.int32)):
        culled = cull_off_axis(radii, means2d, WIDTH, HEIGHT, 2.0)
        assert culled.dtype == torch.int32
        assert culled.shape == radii.shape
        assert visible({"radii": culled, "means2d": means2d})[0].tolist() == expected


def scene() -> dict[str, Any]:
    """Make 200 Gaussians, of which 40 lie far to the side, and two cameras that see these differently."""
    arguments: dict[str, Any] = random_scene(200, 40, seed=0)
    del arguments["weights"]
    arguments["means"][:40, 0] += 6.0 * torch.linspace(-1, 1, 40).sign()
    arguments["scales"][:40] *= 60.0
    arguments["viewmats"] = arguments["viewmats"].repeat(2, 1, 1)
    arguments["viewmats"][1, 0, 3] = -3.0
    arguments["Ks"] = arguments["Ks"].repeat(2, 1, 1)
    return arguments


def test_what_is_left_is_drawn_as_if_the_culled_were_not_there():
    arguments = scene()
    colors, alphas, info = rasterization(**arguments, width=40, height=40, sh_degree=3, max_off_axis=2.0)
    _, everything, all_info = rasterization(**arguments, width=40, height=40, sh_degree=3)
    drawn = visible(info)
    assert (visible(all_info) & ~drawn).sum(dim=1).min() > 0, "the cameras should both lose Gaussians"
    assert (drawn[0] != drawn[1]).any()
    assert (everything - alphas).max() > 0.1
    for view in range(2):
        rest = {name: value[drawn[view]] for name, value in arguments.items() if name not in ("viewmats", "Ks")}
        cameras = {name: arguments[name][view : view + 1] for name in ("viewmats", "Ks")}
        expected, _, _ = rasterization(**rest, **cameras, width=40, height=40, sh_degree=3)
        assert torch.equal(colors[view], expected[0])


def test_what_is_not_drawn_has_no_gradient():
    arguments = scene()
    means = arguments["means"].requires_grad_()
    colors, _, info = rasterization(**arguments, width=40, height=40, sh_degree=3, max_off_axis=2.0)
    colors.sum().backward()
    nowhere = ~visible(info).any(dim=0)
    assert means.grad is not None
    assert (means.grad[nowhere] == 0).all()
    assert (means.grad[~nowhere] != 0).any()


@pytest.mark.hard_case(
    "a Gaussian far beside the view, whose image would be haze over all of it",
    "is not drawn beyond 4 half images (`max_off_axis`)",
)
def test_a_giant_beside_the_view_covers_none_of_it():
    # As on a capture of 30 photos (tests/geometry/test_scale_limits.py): 30 units to the side, an axis of 324 units.
    K = torch.tensor([[[40.0, 0.0, 20.0], [0.0, 40.0, 15.0], [0.0, 0.0, 1.0]]])
    for max_off_axis, covered in ((0.0, True), (4.0, False)):
        _, alphas, _ = rasterization(
            torch.tensor([[30.0, 0.0, 0.85]]), torch.tensor([[1.0, 0.0, 0.0, 0.0]]), torch.tensor([[324.0, 26.0, 1.6]]),
            torch.tensor([0.97]), torch.ones((1, 3)), torch.eye(4)[None], K, WIDTH, HEIGHT, max_off_axis=max_off_axis,
        )  # fmt: skip
        assert bool((alphas > 0.5).all()) is covered
        assert bool((alphas == 0).all()) is not covered
