"""Colour matrices of training views: their derivatives, their anchor, and what they learn of known gains."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from helpers.closeness import assert_within
from helpers.generators import seeded
from sadgs_ns.training.step.color_matrices import anchored, correct_colors

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")


def random_views(views: int, height: int, width: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Renderings [C, H, W, 3], opacities [C, H, W, 1], matrices [C, 3, 4] and gradients of the result [C, H, W, 3]."""
    generator = seeded(height)
    shapes = ((views, height, width, 3), (views, height, width, 1), (views, 3, 4), (views, height, width, 3))
    render, alpha, changes, upstream = (torch.rand(shape, generator=generator) for shape in shapes)
    return render, alpha, torch.eye(3, 4) + 0.3 * (changes - 0.5), upstream - 0.5


def reference(render: Tensor, alpha: Tensor, matrices: Tensor) -> Tensor:
    """M c + α b with the sum written out."""
    linear = torch.einsum("ckl,chwl->chwk", matrices[..., :3], render)
    return linear + torch.einsum("ck,chw->chwk", matrices[..., 3], alpha[..., 0])


@pytest.mark.parametrize("shape", [(1, 5, 7), (3, 33, 47)], ids=str)
def test_colours_and_all_gradients_equal_the_float64_reference(shape: tuple[int, int, int]):
    *values, upstream = random_views(*shape)
    results = []
    for function, dtype in ((correct_colors, torch.float32), (reference, torch.float64)):
        inputs = [value.to(DEVICE, dtype, copy=True).requires_grad_() for value in values]
        corrected = function(*inputs)
        corrected.backward(upstream.to(DEVICE, dtype))
        results.append([corrected.detach().double(), *[value.grad.double() for value in inputs]])  # type: ignore[union-attr]
    assert_close(*results, atol=2e-5, rtol=2e-5)


def test_matrices_that_are_not_learned_get_no_gradient_and_change_no_other():
    render, alpha, matrices, upstream = (value.to(DEVICE) for value in random_views(2, 33, 47))
    results = []
    for learned in (True, False):
        colors = render.clone().requires_grad_()
        opacity = alpha.clone().requires_grad_()
        of_views = matrices.clone().requires_grad_(learned)
        corrected = correct_colors(colors, opacity, of_views)
        corrected.backward(upstream)
        assert (of_views.grad is not None) == learned
        results.append([corrected.detach(), colors.grad, opacity.grad])
    for expected, found in zip(*results, strict=True):
        assert torch.equal(expected, found)


def test_what_is_not_drawn_stays_black_and_teaches_nothing():
    """A step without enough places in its tile lists draws nothing, which no matrix may learn to brighten."""
    render, alpha, matrices, upstream = (value.to(DEVICE) for value in random_views(2, 6, 9))
    matrices.requires_grad_()
    corrected = correct_colors(torch.zeros_like(render), torch.zeros_like(alpha), matrices)
    corrected.backward(upstream)
    assert not corrected.any()
    assert matrices.grad is not None
    assert not matrices.grad.any()


def test_the_mean_of_all_views_matrices_is_the_identity():
    matrices = (torch.eye(3, 4) + torch.randn((7, 3, 4), generator=seeded(0))).requires_grad_()
    every = anchored(matrices, torch.arange(7))
    actual = every.mean(dim=0)
    expected = torch.eye(3, 4)
    assert_within(actual, expected, 1e-6)
    actual = every - every[:1]
    expected = (matrices - matrices[:1]).detach() + 0 * every
    assert_within(actual, expected, 1e-6)
    chosen = anchored(matrices, torch.tensor([5, 2]))
    assert torch.equal(chosen, every[[5, 2]])
    chosen.sum().backward()
    moved = matrices.grad.flatten(1).any(dim=1)  # type: ignore[union-attr]
    assert moved.tolist() == [False, False, True, False, False, True, False], "a view moves its own matrix alone"


def test_nothing_changes_at_the_start():
    render, alpha, _, _ = random_views(2, 4, 5)
    start = anchored(torch.eye(3, 4).repeat(9, 1, 1), torch.tensor([8, 3]))
    assert torch.equal(correct_colors(render, alpha, start), render)


def test_a_gain_in_linear_light_is_an_affine_map_of_srgb_but_for_the_darkest():
    light = torch.linspace(0.0031308, 0.25, 100)  # Twice and four times as much of it is neither dark nor saturated.
    for gain in (2.0, 4.0):
        bright = 1.055 * (gain * light) ** (1 / 2.4) - 0.055
        dark = 1.055 * light ** (1 / 2.4) - 0.055
        factor = gain ** (1 / 2.4)
        expected = factor * dark + 0.055 * (factor - 1)
        assert_within(bright, expected, 1e-6)


def test_matrices_that_follow_known_gains_leave_the_scene_at_the_mean_exposure():
    """One scene colour a pixel, and views that show it with gains of mean 1: both are found, up to no common factor."""
    generator = seeded(1)
    truth = 0.1 + 0.6 * torch.rand((1, 8, 8, 3), generator=generator)
    gains = torch.tensor([0.6, 0.8, 1.0, 1.2, 1.4])
    scene = torch.nn.Parameter(torch.full_like(truth, 0.4))
    matrices = torch.nn.Parameter(torch.eye(3, 4).repeat(5, 1, 1))
    optimizer = torch.optim.Adam([{"params": [scene], "lr": 0.01}, {"params": [matrices], "lr": 0.005}])
    alpha = torch.ones((1, 8, 8, 1))
    for step in range(4000):
        for group, rate in zip(optimizer.param_groups, (0.01, 0.005), strict=True):
            group["lr"] = rate * 0.01 ** (step / 4000)
        view = step * 2 % 5
        optimizer.zero_grad()
        shown = correct_colors(scene, alpha, anchored(matrices, torch.tensor([view])))
        (shown - gains[view] * truth).square().mean().backward()
        optimizer.step()
    assert_within(scene.detach(), truth, 0.02)
    learned = correct_colors(truth.expand(5, -1, -1, -1), alpha, anchored(matrices, torch.arange(5)).detach())
    expected = gains[:, None, None, None] * truth
    assert_within(learned, expected, 0.03)
