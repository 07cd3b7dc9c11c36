"""Signatures, names and shapes in the installed gsplat on which gsplat_compat.py relies; no test needs a GPU."""

from __future__ import annotations

import ast
import importlib.util
import inspect
from collections.abc import Callable
from pathlib import Path
from types import FunctionType
from typing import Any

import gsplat
import gsplat.rendering
import pytest
import torch
from gsplat.cuda import _torch_impl

from sadgs_ns import gsplat_compat

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
    gsplat_compat.torch_quat_scale_to_covar_preci: (
        "quats scales compute_covar compute_preci", {"compute_covar": True, "compute_preci": True, "triu": False}
    ),
    gsplat_compat.torch_world_to_cam: ("means covars viewmats", {}),
    gsplat_compat.torch_persp_proj: ("means covars Ks width height", {}),
    gsplat_compat.update_param_with_optimizer: ("param_fn optimizer_fn params optimizers", {"names": None}),
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
    assert {name: parameters[name].default for name in defaults} == defaults
    required = [name for name, parameter in parameters.items() if parameter.default is inspect.Parameter.empty]
    assert leading.startswith(" ".join(required)), "a parameter without a default is new"


def test_harmonics_in_torch_take_three_arguments_by_their_places():
    parameters = inspect.signature(gsplat_compat.torch_spherical_harmonics).parameters.values()
    assert len(parameters) == 3
    assert all(parameter.kind is inspect.Parameter.POSITIONAL_OR_KEYWORD for parameter in parameters)


@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_the_projection_gets_what_gsplats_rasterization_gives_it(monkeypatch: pytest.MonkeyPatch, mode: Any):
    """In a gsplat that passes more, `project` would draw something else than `gsplat.rasterization` does."""
    signature = inspect.signature(gsplat.fully_fused_projection)
    viewmats, Ks = cameras()
    scene = gaussians()
    geometry = scene["means"], scene["quats"], scene["scales"], scene["opacities"]
    expected, found = (
        first_call(monkeypatch, signature, call)
        for call in (
            lambda: gsplat.rasterization(
                *geometry, torch.ones(N, 3), viewmats, Ks, 40, 30, near_plane=0.7, packed=False, rasterize_mode=mode
            ),
            lambda: gsplat_compat.project(*geometry, viewmats, Ks, 40, 30, mode == "antialiased", 0.7),
        )
    )
    assert found.keys() == expected.keys()
    assert all(found[name] is expected[name] or found[name] == expected[name] for name in found)


def test_two_kernels_get_their_arguments_in_their_places(monkeypatch: pytest.MonkeyPatch):
    values = [object() for _ in range(10)]
    for name, count in (("spherical_harmonics", 4), ("rasterize_to_pixels", 10)):
        signature = inspect.signature(getattr(gsplat, name))
        monkeypatch.setattr(gsplat, name, lambda *args, s=signature, **options: s.bind(*args, **options).arguments)
        found = getattr(gsplat_compat, name)(*values[:count])
        last = "masks" if count == 4 else "absgrad"
        assert list(found.values()) == values[:count] and list(found)[-1] == last


def test_radii_of_the_installed_gsplat_have_the_layout_that_is_stated():
    viewmats, Ks = cameras()
    scene = gaussians()
    covars, precis = gsplat_compat.torch_quat_scale_to_covar_preci(scene["quats"], scene["scales"], compute_preci=False)
    assert covars is not None and covars.shape == (N, 3, 3) and precis is None
    radii, means2d, *_ = _torch_impl._fully_fused_projection(scene["means"], covars, viewmats, Ks, 40, 30)
    assert radii.dtype == torch.int32
    assert radii.shape == ((2, N, 2) if gsplat_compat.RADII_PER_AXIS else (2, N))
    assert gsplat_compat.has_radius_per_axis(radii, means2d) is gsplat_compat.RADII_PER_AXIS
    assert gsplat_compat.drawn(radii, means2d).tolist() == [[True] * N] * 2


def test_the_functions_in_torch_return_the_shapes_that_are_stated():
    viewmats, Ks = cameras()
    scene = {name: value.double() for name, value in gaussians().items()}
    covars, _ = gsplat_compat.torch_quat_scale_to_covar_preci(scene["quats"], scene["scales"], compute_preci=False)
    assert covars is not None
    means_c, covars_c = gsplat_compat.torch_world_to_cam(scene["means"], covars, viewmats.double())
    means2d, covars2d = gsplat_compat.torch_persp_proj(means_c, covars_c, Ks.double(), 40, 30)
    shapes = [tuple(value.shape) for value in (means_c, covars_c, means2d, covars2d)]
    assert shapes == [(2, N, 3), (2, N, 3, 3), (2, N, 2), (2, N, 2, 2)]
    colors = gsplat_compat.torch_spherical_harmonics(1, means_c, torch.ones(2, N, 4, 3, dtype=torch.float64))
    assert colors.shape == (2, N, 3) and colors.dtype == torch.float64


def test_gsplats_rasterization_finds_the_projection_among_its_modules_names():
    function = gsplat.rendering.rasterization
    assert isinstance(function, FunctionType) and function.__closure__ is None
    assert function.__globals__["fully_fused_projection"] is gsplat.fully_fused_projection
    assert "fully_fused_projection" in function.__code__.co_names


def test_width_and_height_are_the_seventh_and_eighth_that_the_projection_gets(monkeypatch: pytest.MonkeyPatch):
    sizes = []

    def project(*args: Any, **options: Any) -> tuple[Any, ...]:
        return torch.ones(2, N), torch.ones(2, N, 2), None, None, None

    def change(radii: torch.Tensor, means2d: torch.Tensor, width: int, height: int) -> torch.Tensor:
        sizes.append((width, height))
        raise _Called

    monkeypatch.setattr(gsplat.rendering, "fully_fused_projection", project)
    rasterization = gsplat_compat.with_changed_radii(gsplat.rendering.rasterization, change)
    with pytest.raises(_Called):
        rasterization(*gaussians().values(), torch.ones(N, 3), *cameras(), 40, 30, packed=False)
    assert sizes == [(40, 30)]


def test_an_optimizer_whose_moments_were_being_changed_has_no_state():
    def fail(key: str, moment: torch.Tensor) -> torch.Tensor:
        raise MemoryError

    params = {"means": torch.nn.Parameter(torch.zeros(N, 3))}
    optimizers: dict[str, torch.optim.Optimizer] = {"means": torch.optim.Adam(params.values())}
    params["means"].sum().backward()
    optimizers["means"].step()
    assert optimizers["means"].state
    with pytest.raises(MemoryError):
        gsplat_compat.update_param_with_optimizer(lambda name, p: p, fail, params, optimizers)
    assert not optimizers["means"].state


def test_the_module_of_the_cuda_extension_has_it():
    """The module is not imported: without a GPU it may begin to compile."""
    spec = importlib.util.find_spec("gsplat.cuda._backend")
    assert spec is not None and spec.origin is not None
    body = ast.parse(Path(spec.origin).read_text("utf8")).body
    assert any(isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "_C" for node in body)
