"""Gradients by the cameras' matrices: Triton's projection and harmonics against float64 autograd through torch code."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from helpers.generators import seeded
from sadgs_ns import gsplat_compat
from sadgs_ns.render import backend_torch
from sadgs_ns.render.types import Cameras, Gaussians, Projected, RenderOptions

backend_triton = pytest.importorskip("sadgs_ns.render.backend_triton", reason="Triton is not installed")

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
N = 300
WIDTH = 40
HEIGHT = 30
OUTPUTS = ("means2d", "depths", "conics", "colors")
OPTIONS = RenderOptions(sh_degree=3, near_plane=0.2)


def scene(num_views: int) -> dict[str, Tensor]:
    """Gaussians before, beside and behind cameras, with harmonics; float64 values that float32 holds."""
    generator = seeded(3)

    def random(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    viewmats = torch.eye(4, dtype=torch.float64).repeat(num_views, 1, 1)
    rotations = torch.linalg.qr(torch.eye(3, dtype=torch.float64) + 0.1 * random(num_views, 3, 3))[0]
    viewmats[:, :3, :3] = rotations * rotations.diagonal(dim1=1, dim2=2).sign()[:, None]
    viewmats[:, :3, 3] = 0.2 * random(num_views, 3)
    means = random(N, 3) * torch.tensor([2.0, 2.0, 1.0]) + torch.tensor([0.0, 0.0, 3.0])
    means[::10, 2] = -1.0
    values = {
        "means": means,
        "quats": random(N, 4),
        "scales": (0.5 * random(N, 3) - 1.5).exp(),
        "opacities": torch.full((N,), 0.5, dtype=torch.float64),
        "first": random(N, 3),
        "rest": 0.3 * random(N, 15, 3),
        "viewmats": viewmats,
    }
    return {name: value.float().double() for name, value in values.items()}


def inputs_of(values: dict[str, Tensor], poses: bool) -> dict[str, Tensor]:
    leaves = {name: value.clone().requires_grad_() for name, value in values.items()}
    leaves["viewmats"].requires_grad_(poses)
    return leaves


def project(backend: Any, leaves: dict[str, Tensor]) -> Projected:
    means, quats, scales, opacities, first, rest, viewmats = leaves.values()
    K = viewmats.new_tensor([[35.0, 0.0, 19.0], [0.0, 45.0, 16.0], [0.0, 0.0, 1.0]])
    cameras = Cameras(viewmats, K.repeat(len(viewmats), 1, 1), WIDTH, HEIGHT)
    return backend.project(Gaussians(means, quats, scales, opacities, (first, rest)), cameras, OPTIONS, False)


def differentiate(projected: Projected, seen: Tensor, names: tuple[str, ...]) -> None:
    """Call backward with gradients of some outputs, 0 where no backend draws."""
    generator = seeded(4)
    outputs = []
    gradients = []
    for name in OUTPUTS:
        output = getattr(projected, name)
        # It is drawn for every output, so that it does not depend on which of them have one.
        upstream = torch.randn(output.shape, generator=generator, dtype=torch.float64)
        if name in names:
            mask = seen.to(output.device).view(*seen.shape, *[1] * (output.dim() - 2))
            outputs.append(output)
            gradients.append(torch.where(mask, upstream.to(output), 0.0))
    torch.autograd.backward(outputs, gradients)


def project_exactly_and_fast(values: dict[str, Any]) -> tuple[Any, Any, Projected, Projected, Tensor]:
    """Project a scene in float64 by torch, and by the kernels.

    Returns the inputs of both, what both project, and what both draw, bool [C, N].
    """
    exact = inputs_of(values, poses=True)
    fast = inputs_of({name: value.float().to(DEVICE) for name, value in values.items()}, poses=True)
    expected = project(backend_torch, exact)
    found = project(backend_triton, fast)
    seen = gsplat_compat.drawn(expected.radii, expected.means2d)
    seen &= gsplat_compat.drawn(found.radii, found.means2d).cpu()
    return exact, fast, expected, found, seen


@pytest.mark.parametrize("names", [OUTPUTS, ("means2d", "conics"), ("conics",), ("colors",)], ids="-".join)
@pytest.mark.parametrize("num_views", [1, 3])
def test_gradients_by_the_cameras_equal_float64_autograd(num_views: int, names: tuple[str, ...]):
    values = scene(num_views)
    exact, fast, expected, found, seen = project_exactly_and_fast(values)
    assert 0.3 < seen.float().mean() < 0.95
    differentiate(expected, seen, names)
    differentiate(found, seen, names)
    for name in ("viewmats", "means"):
        gradient = fast[name].grad
        reference = exact[name].grad
        assert gradient is not None
        assert reference is not None
        difference = gradient.double().cpu() - reference
        if name == "viewmats":
            # Torch's backend inverts the matrices, ours transposes: these derivatives agree along rigid motions alone.
            difference = tangent(difference, values["viewmats"])
            reference = tangent(reference, values["viewmats"])
        error = float(difference.norm() / reference.norm())
        assert error < 2e-5, (name, error)


def tangent(gradient: Tensor, viewmats: Tensor) -> Tensor:
    """Return the derivatives [C, 6] by a rotation and a translation in each camera's frame."""
    columns = []
    for axis in range(3):
        direction = torch.zeros(3, dtype=torch.float64)
        direction[axis] = 1.0
        cross = torch.linalg.cross(direction[None, :, None].expand(len(viewmats), 3, 4), viewmats[:, :3], dim=1)
        columns.append((gradient[:, :3] * cross).sum(dim=(1, 2)))
    return torch.cat([torch.stack(columns, dim=1), gradient[:, :3, 3]], dim=1)


def test_projection_s_gradients_by_each_entry_of_a_matrix_equal_float64_autograd():
    exact, fast, expected, found, seen = project_exactly_and_fast(scene(2))
    for projected in (expected, found):
        differentiate(projected, seen, ("means2d", "conics", "depths"))
    reference = exact["viewmats"].grad
    gradient = fast["viewmats"].grad
    assert reference is not None
    assert gradient is not None
    assert not gradient[:, 3].any()
    actual = gradient.double().cpu()
    assert_close(actual, reference, rtol=1e-4, atol=2e-5 * float(reference.abs().max()))


def test_other_gradients_do_not_depend_on_whether_cameras_have_one():
    values = {name: value.float().to(DEVICE) for name, value in scene(3).items()}
    results = []
    for poses in (False, True):
        leaves = inputs_of(values, poses)
        projected = project(backend_triton, leaves)
        differentiate(projected, gsplat_compat.drawn(projected.radii, projected.means2d).cpu(), OUTPUTS)
        results.append(leaves)
    without, having = results
    assert without["viewmats"].grad is None
    assert having["viewmats"].grad is not None
    for name in ("means", "quats", "scales", "first", "rest"):
        assert without[name].grad is not None
        actual = without[name].grad
        expected = having[name].grad
        assert_close(actual, expected, rtol=1e-6, atol=1e-6)


def test_what_is_not_drawn_moves_no_camera_whatever_its_numbers_are():
    gradients = []
    for broken in (False, True):
        values = {name: value.float().to(DEVICE) for name, value in scene(2).items()}
        leaves = inputs_of(values, poses=True)
        if broken:
            with torch.no_grad():
                leaves["means"][:50] = torch.nan
                leaves["scales"][50:100] = torch.inf
        with np.errstate(all="ignore"):
            projected = project(backend_triton, leaves)
        projected.radii.data[:, :100] = 0
        seen = gsplat_compat.drawn(projected.radii, projected.means2d).cpu()
        assert seen.any()
        assert not seen[:, :100].any()
        with np.errstate(all="ignore"):  # Triton's interpreter computes with numpy.
            differentiate(projected, seen, OUTPUTS)
        gradients.append(leaves["viewmats"].grad)
    assert gradients[0] is not None
    assert gradients[0].abs().sum() > 0
    assert_close(gradients[1], gradients[0], rtol=1e-5, atol=1e-5)
