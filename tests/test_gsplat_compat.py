"""Signatures, names and shapes in the installed gsplat on which gsplat_compat.py relies; no test needs a GPU."""

from __future__ import annotations

import inspect
import sys
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import gsplat
import gsplat.rendering
import pytest
import torch
from gsplat.cuda import _torch_impl

from helpers.generators import seeded
from sadgs_ns import gsplat_compat
from sadgs_ns.render import ewa

EXPECTED = {
    # function: its first parameters, which are given by their places; then those with defaults that are relied on
    gsplat.fully_fused_projection: (
        "means covars quats scales viewmats Ks width height",
        {"eps2d": 0.3, "near_plane": 0.01, "far_plane": 1e10, "radius_clip": 0.0, "packed": False,
         "calc_compensations": False, "camera_model": "pinhole"},
    ),
    gsplat.spherical_harmonics: ("degrees_to_use dirs coeffs", {"masks": None}),
    gsplat.rasterize_to_pixels: (
        "means2d conics colors opacities image_width image_height tile_size isect_offsets flatten_ids",
        {"backgrounds": None, "masks": None, "packed": False, "absgrad": False},
    ),
    gsplat.isect_tiles: (
        "means2d radii depths tile_size tile_width tile_height", {"sort": True, "packed": False}
    ),
}  # fmt: skip
N = 5


class _Called(Exception):
    """Raised in place of a CUDA kernel, with the arguments that it got."""


def cameras() -> tuple[torch.Tensor, torch.Tensor]:
    """Two cameras of 40 × 30 px: viewmats [2, 4, 4] and Ks [2, 3, 3]."""
    K = torch.tensor([[40.0, 0.0, 20.0], [0.0, 40.0, 15.0], [0.0, 0.0, 1.0]])
    return torch.eye(4).repeat(2, 1, 1), K.repeat(2, 1, 1)


def gaussians() -> dict[str, torch.Tensor]:
    """N Gaussians in front of both cameras."""
    means = torch.tensor([0.0, 0.0, 4.0]) + torch.linspace(-0.5, 0.5, N)[:, None]
    return {
        "means": means,
        "quats": torch.tensor([1.0, 0.5, 0.0, 0.0]).repeat(N, 1),
        "scales": torch.tensor([0.1, 0.2, 0.3]).repeat(N, 1),
        "opacities": torch.full((N,), 0.5),
    }


def first_call(monkeypatch: pytest.MonkeyPatch, signature: inspect.Signature, call: Callable[[], Any]) -> dict:
    """Arguments, by name and with defaults, that `call` gives to gsplat's projection, which is not run."""

    def record(*args: Any, **options: Any) -> None:
        bound = signature.bind(*args, **options)
        bound.apply_defaults()
        raise _Called(bound.arguments)

    monkeypatch.setattr(gsplat, "fully_fused_projection", record)
    monkeypatch.setattr(gsplat.rendering, "fully_fused_projection", record)
    with pytest.raises(_Called) as caught:
        call()
    return caught.value.args[0]


@pytest.mark.parametrize("function", EXPECTED, ids=lambda function: function.__name__)
def test_signatures(function: Callable[..., Any]):
    leading, defaults = EXPECTED[function]
    parameters = inspect.signature(function).parameters
    assert " ".join(parameters).startswith(leading)
    actual = {name: parameters[name].default for name in defaults}
    assert actual == defaults
    required = [name for name, parameter in parameters.items() if parameter.default is inspect.Parameter.empty]
    assert leading.startswith(" ".join(required)), "a parameter without a default is new"


def test_the_starts_of_tile_lists_take_four_arguments_by_their_places():
    """The second has another name in 1.5, n_images."""
    parameters = list(inspect.signature(gsplat.isect_offset_encode).parameters)
    assert len(parameters) == 4
    assert parameters[0] == "isect_ids"
    assert parameters[2:] == ["tile_width", "tile_height"]


def test_the_projection_gets_what_gsplats_rasterization_gives_it(monkeypatch: pytest.MonkeyPatch):
    """In a gsplat that passes more, `project` would draw something else than `gsplat.rasterization` does."""
    signature = inspect.signature(gsplat.fully_fused_projection)
    viewmats, Ks = cameras()
    scene = gaussians()
    geometry = scene["means"], scene["quats"], scene["scales"], scene["opacities"]
    colors = torch.ones(N, 3)

    def rasterize() -> None:
        gsplat.rasterization(*geometry, colors, viewmats, Ks, 40, 30, near_plane=0.7, packed=False)

    def project() -> None:
        gsplat_compat.project(*geometry, viewmats, Ks, 40, 30, 0.7)

    expected = first_call(monkeypatch, signature, rasterize)
    found = first_call(monkeypatch, signature, project)
    assert found.keys() == expected.keys()
    for name in found:
        assert found[name] is expected[name] or found[name] == expected[name]


def test_radii_of_the_installed_gsplat_have_the_layout_that_is_stated():
    viewmats, Ks = cameras()
    scene = gaussians()
    covars = ewa.covariances(scene["quats"], scene["scales"])
    radii, means2d, *_ = _torch_impl._fully_fused_projection(scene["means"], covars, viewmats, Ks, 40, 30)
    assert radii.dtype == torch.int32
    assert radii.shape == ((2, N, 2) if gsplat_compat.RADII_PER_AXIS else (2, N))
    assert gsplat_compat.has_radius_per_axis(radii, means2d) is gsplat_compat.RADII_PER_AXIS
    assert gsplat_compat.drawn(radii, means2d).tolist() == [[True] * N] * 2


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_projection_and_harmonics_in_torch_are_gsplats_bit_by_bit(dtype: torch.dtype):
    generator = seeded(0)
    means = torch.randn((200, 3), generator=generator, dtype=dtype)
    quats = torch.randn((200, 4), generator=generator, dtype=dtype)
    scales = torch.randn((200, 3), generator=generator, dtype=dtype)
    coefficients = torch.randn((2, 200, 16, 3), generator=generator, dtype=dtype)
    directions = torch.randn((2, 200, 3), generator=generator, dtype=dtype)
    viewmats, Ks = (value.to(dtype) for value in cameras())
    viewmats[1, :3, 3] = torch.tensor([0.3, -0.2, 4.0])
    covars, _ = _torch_impl._quat_scale_to_covar_preci(quats, scales, compute_preci=False)
    assert covars is not None
    assert torch.equal(ewa.covariances(quats, scales), covars)
    seen = _torch_impl._world_to_cam(means, covars, viewmats)
    found = ewa.world_to_camera(means, covars, viewmats)
    assert torch.equal(found[0], seen[0])
    assert torch.equal(found[1], seen[1])
    projected = ewa.perspective(*seen, Ks, 40, 30)
    expected = _torch_impl._persp_proj(*seen, Ks, 40, 30)
    assert torch.equal(projected[0], expected[0])
    assert torch.equal(projected[1], expected[1])
    for degree in range(4):
        gradients = []
        for function in (ewa.spherical_harmonics, _torch_impl._spherical_harmonics):
            leaves = directions.clone().requires_grad_(), coefficients.clone().requires_grad_()
            value = function(degree, *leaves)
            value.square().sum().backward()
            gradients.append([value, *(leaf.grad for leaf in leaves if leaf.grad is not None)])
        for one, other in zip(*gradients, strict=True):
            assert torch.equal(one, other), degree
        assert len(gradients[0]) == (3 if degree else 2), "colours of degree 0 depend on no direction"


def test_a_gsplat_without_its_kernels_is_told(monkeypatch: pytest.MonkeyPatch):
    ones = torch.ones
    monkeypatch.setattr(torch, "ones", lambda shape, device: ones(shape))
    monkeypatch.setitem(sys.modules, "gsplat.cuda._backend", SimpleNamespace(_C=None))
    with pytest.raises(RuntimeError, match=r"^neither prebuilt nor compiled$"):
        gsplat_compat.try_kernels()
