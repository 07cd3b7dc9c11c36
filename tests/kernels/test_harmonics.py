"""The kernels of spherical harmonics against gsplat's torch code in float64."""

from __future__ import annotations

import math

import pytest
import torch
from gsplat.cuda._torch_impl import _spherical_harmonics

from helpers import small_scenes

harmonics = pytest.importorskip("sadgs_ns.kernels.harmonics", reason="Triton is not installed")

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")


@pytest.mark.parametrize("per_axis_radii", [False, True], ids=["gsplat 1.4", "gsplat 1.5"])
@pytest.mark.parametrize(("degree", "num_others"), [(0, 15), (1, 15), (2, 15), (3, 15), (3, 24)])
def test_colours_and_gradients_equal_gsplats_float64_harmonics(monkeypatch, degree, num_others, per_axis_radii):
    generator = torch.Generator().manual_seed(degree)
    shapes = (40, 3), (40, 3), (40, num_others, 3), (3, 3), (3, 40, 3)
    *values, centres, weights = (torch.randn(shape, generator=generator) for shape in shapes)
    viewmats = small_scenes.cameras_at(centres)
    radii = torch.randint(-1, 9, (3, 40, 2), generator=generator)
    radii = radii if per_axis_radii else radii[..., 0].contiguous()
    drawn = (radii > 0).all(dim=-1) if per_axis_radii else radii > 0
    fast = [value.to(DEVICE, copy=True).requires_grad_() for value in values]
    colors = harmonics.colors_from_harmonics(degree, *fast, viewmats.to(DEVICE), radii.to(DEVICE))
    v_colors = (weights * drawn[..., None]).to(DEVICE)
    if per_axis_radii:  # as compositing returns them
        v_colors = torch.nn.functional.pad(v_colors, (6, 3))[..., 6:9]
    # What is not written keeps what was in the memory before.
    monkeypatch.setattr(torch, "empty_like", lambda tensor: torch.full_like(tensor, math.nan))
    colors.backward(v_colors)
    positions = small_scenes.centres_of(viewmats)
    torch.testing.assert_close(positions[:, 0].float(), centres, atol=1e-5, rtol=1e-5)
    slow = means, first, rest = [value.double().requires_grad_() for value in values]
    coefficients = torch.cat([first[:, None], rest], dim=1).expand(3, -1, -1, -1)
    expected = (_spherical_harmonics(degree, means - positions, coefficients) + 0.5).clamp_min(0)
    (expected * weights * drawn[..., None]).sum().backward()
    torch.testing.assert_close(colors[drawn.to(DEVICE)].double().cpu(), expected[drawn], atol=2e-6, rtol=2e-6)
    assert (expected == 0).any()
    assert (expected > 0).any()
    for actual, reference in zip(fast, slow, strict=True):
        assert actual.grad is not None
        gradient = torch.zeros_like(reference) if reference.grad is None else reference.grad
        torch.testing.assert_close(actual.grad.double().cpu(), gradient, atol=2e-5, rtol=2e-5)
