"""The projection's backward pass against float64 autograd through gsplat's torch code, and on CUDA against gsplat's."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
import torch
from gsplat.cuda._torch_impl import _fully_fused_projection, _quat_scale_to_covar_preci
from torch import Tensor
from torch.testing import assert_close

from helpers.generators import seeded
from helpers.random_gaussians import nearly_aligned_viewmats
from sadgs_ns import gsplat_compat

projection = pytest.importorskip("sadgs_ns.kernels.projection", reason="Triton is not installed")

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
WIDTH = 40
HEIGHT = 30
N = 150
OUTPUTS = ("means2d", "depths", "conics", "passed")


def scene(num_views: int) -> dict[str, Any]:
    """N Gaussians, of which some are beside and some behind the cameras, in float64."""
    generator = seeded(0)

    def random(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    viewmats = nearly_aligned_viewmats(num_views, generator)
    K = torch.tensor([[35.0, 0.0, 19.0], [0.0, 45.0, 16.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    means = random(N, 3) * torch.tensor([2.0, 2.0, 1.0]) + torch.tensor([0.0, 0.0, 3.0])
    means[::10, 2] = -1.0
    values = {
        "means": means,
        "quats": 3 * random(N, 4),
        "scales": (0.5 * random(N, 3) - 1.5).exp(),
        "opacities": torch.full((N,), 0.5, dtype=torch.float64),
        "viewmats": viewmats,
        "Ks": K.repeat(num_views, 1, 1),
    }
    return {name: value.float().double() for name, value in values.items()}


def project_in_torch(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, viewmats: Tensor, Ks: Tensor,
    width: int, height: int, near_plane: float = 0.01,
) -> tuple[Any, ...]:  # fmt: skip
    """Do what `gsplat_compat.project` does, with a radius of 3 px where a Gaussian is drawn."""
    covariances, _ = _quat_scale_to_covar_preci(quats, scales, True, False)
    assert covariances is not None
    radii, *others, _ = _fully_fused_projection(means, covariances, viewmats, Ks, width, height, near_plane=near_plane)
    assert others[0] is not None
    seen = gsplat_compat.drawn(radii, others[0])
    return seen.int() * 3, *others


def gradients_of(
    outputs: Mapping[str, Any], inputs: Mapping[str, Any], upstream: dict[str, Tensor]
) -> dict[str, Tensor]:
    """Gradients by the inputs, in float64 on the CPU, of outputs of which nothing depends on what was not drawn."""
    names = [name for name in outputs if name in upstream]
    gradients = [upstream[name].to(outputs[name]) for name in names]
    torch.autograd.backward([outputs[name] for name in names], gradients)
    return {name: inputs[name].grad.double().cpu() for name in ("means", "quats", "scales")}


def upstream_of(seen: Tensor, names: tuple[str, ...]) -> dict[str, Tensor]:
    """Gradients of the outputs, 0 where a Gaussian was not drawn; two are parts of rows, as compositing makes them."""
    generator = seeded(1)
    rows = torch.randn((*seen.shape, 12), generator=generator, dtype=torch.float64) * seen[..., None]
    passed = torch.randn((N, 3), generator=generator, dtype=torch.float64)
    every = {
        "means2d": rows[..., :2],
        "conics": rows[..., 2:5],
        "depths": rows[..., 5],
        "passed": passed,
    }
    return {name: every[name] for name in names}


@pytest.mark.parametrize("per_axis_radii", [False, True], ids=["gsplat 1.4", "gsplat 1.5"])
@pytest.mark.parametrize(
    ("num_views", "names"),
    [(1, ("means2d", "conics", "passed")), (3, OUTPUTS), (2, ("means2d", "conics")), (1, ("conics",))],
    ids=lambda value: "-".join(value) if isinstance(value, tuple) else str(value),
)
def test_gradients_equal_float64_autograd(monkeypatch, num_views, names, per_axis_radii):
    values = scene(num_views)
    inputs: dict[str, Any] = {name: value.clone().requires_grad_() for name, value in values.items()}
    radii, *in_torch = project_in_torch(**inputs, width=WIDTH, height=HEIGHT)

    monkeypatch.setattr(gsplat_compat, "RADII_PER_AXIS", per_axis_radii)
    passed = {name: value.float().to(DEVICE) for name, value in values.items()}
    for name in ("means", "quats", "scales"):
        passed[name].requires_grad_()
    drawn, *others = projection.project(**passed, width=WIDTH, height=HEIGHT)
    assert not drawn.requires_grad
    seen = gsplat_compat.drawn(drawn, others[0]).cpu()
    # Opacities bound the radii of gsplat 1.5, but not in its torch code.
    assert (seen != (radii > 0)).float().mean() <= (0.1 if per_axis_radii else 0)
    assert 0.3 < seen.float().mean() < 0.9
    ratios = in_torch[0][seen] / torch.tensor([WIDTH, HEIGHT])
    assert ((ratios < -0.15) | (ratios > 1.15)).any(dim=1).sum() > 5, "the Jacobian should be clamped for some"
    upstream = upstream_of(seen, names)
    outputs: dict[str, Any] = dict(zip(OUTPUTS, [*in_torch, 1 * inputs["means"]], strict=True))
    expected = gradients_of(outputs, inputs, upstream)
    found = gradients_of(dict(zip(OUTPUTS, others, strict=True)), passed, upstream)
    for name, value in expected.items():
        error = float((found[name] - value).norm() / value.norm())
        assert error < 2e-5, (name, error)
    if "passed" not in names:
        never = ~seen.any(dim=0)
        assert never.any()
        assert not any(value[never].any() for value in found.values())


def test_what_no_view_draws_has_gradients_of_zero_whatever_its_numbers_are():
    """Also where it is culled, or where tile lists overflow, after the projection."""
    values = {name: value.float().to(DEVICE) for name, value in scene(2).items()}
    results = []
    for broken in (False, True):
        inputs = {name: value.clone() for name, value in values.items()}
        for name in ("means", "quats", "scales"):
            if broken:
                inputs[name][:50] = torch.tensor([torch.nan, torch.inf, 0.0, -1.0, 1e30]).repeat(10)[:, None]
            inputs[name].requires_grad_()
        with np.errstate(all="ignore"):  # Triton's interpreter computes with numpy
            radii, *others = projection.project(**inputs, width=WIDTH, height=HEIGHT)
        radii.data[:, :50] = 0  # as kernels do, of whose changes autograd does not know
        upstream = upstream_of(gsplat_compat.drawn(radii, others[0]).cpu(), ("means2d", "conics"))
        with np.errstate(all="ignore"):
            results.append(gradients_of(dict(zip(OUTPUTS, others, strict=True)), inputs, upstream))
    for name, value in results[1].items():
        assert not value[:50].any()
        assert value[50:].any()
        expected = results[0][name]
        assert_close(value, expected)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="gsplat's kernels need CUDA")
def test_gradients_are_as_close_to_float64_as_gsplats():
    values = scene(3)
    inputs = {name: value.clone().requires_grad_() for name, value in values.items()}
    radii, *others = project_in_torch(**inputs, width=WIDTH, height=HEIGHT)
    upstream = upstream_of(radii > 0, OUTPUTS[:3])
    expected = gradients_of(dict(zip(OUTPUTS, others, strict=False)), inputs, upstream)
    errors = []
    for function in (projection.project, gsplat_compat.project):
        inputs = {name: value.float().to(DEVICE) for name, value in values.items()}
        for name in ("means", "quats", "scales"):
            inputs[name].requires_grad_()
        others = function(**inputs, width=WIDTH, height=HEIGHT)[1:4]
        found = gradients_of(dict(zip(OUTPUTS, others, strict=False)), inputs, upstream)
        errors.append({name: float((found[name] - v).norm() / v.norm()) for name, v in expected.items()})
    for name, error in errors[0].items():
        assert error < max(2 * errors[1][name], 1e-5), (name, *errors)
