"""The gsplat backend, with torch functions in gsplat's place on a CPU, and Triton's, which needs none of them."""

from __future__ import annotations

import sys
from typing import Any

import gsplat
import pytest
import torch
from torch import Tensor
from torch.testing import assert_close

from helpers.gsplat_stub import stub_gsplat
from helpers.refusals import refusal
from helpers.rendered_scene import random_scene
from sadgs_ns import kernels
from sadgs_ns.method.screen_gradients import keep_gradient
from sadgs_ns.render import backend_gsplat, backend_torch, rasterization
from sadgs_ns.render.rasterization import visible
from sadgs_ns.render.types import Cameras, Gaussians, RenderOptions

CASES = {
    "harmonics": (RenderOptions(sh_degree=3, absgrad=True), 1),
    "two views": (RenderOptions(sh_degree=2, absgrad=True), 2),
    "depth": (RenderOptions(sh_degree=1, expected_depth=True), 2),
    "off the axis": (RenderOptions(sh_degree=3, max_off_axis=0.7, absgrad=True), 2),
    "near plane": (RenderOptions(sh_degree=3, near_plane=2.9, absgrad=True), 1),
    "features": (RenderOptions(absgrad=True), 2),
}


def drawn_by(
    module: Any, options: RenderOptions, views: int, size: int, device: str, dtype: torch.dtype, pose: bool = False
) -> dict[str, Tensor]:
    """Images, absolute and plain gradients of a random scene, and what was drawn, in float64 on the CPU."""
    values = {name: value.to(device, dtype) for name, value in random_scene(800, size, seed=0).items()}
    viewmats = values["viewmats"].repeat(views, 1, 1)
    Ks = values["Ks"].repeat(views, 1, 1)
    viewmats[-1, 0, 3] = 0.4
    viewmats.requires_grad_(pose)
    leaves = {name: values[name].clone().requires_grad_() for name in ("means", "quats", "scales", "opacities")}
    leaves |= {"first": values["colors"][:, 0].clone().requires_grad_()}
    leaves |= {"rest": values["colors"][:, 1:].clone().requires_grad_()} if options.sh_degree is not None else {}
    colors: Any = (leaves["first"], leaves["rest"]) if "rest" in leaves else leaves["first"]
    gaussians = Gaussians(leaves["means"], leaves["quats"], leaves["scales"], leaves["opacities"], colors)
    rasterize = rasterization.rasterize
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rasterization, "_backend", lambda wanted, place: module)
        colors, alphas, info = rasterize(gaussians, Cameras(viewmats, Ks, size, size), options)
    if options.absgrad:
        keep_gradient(info["means2d"])
    weights = values["weights"].repeat(views, 1, 1, 1)
    loss = (weights * colors[..., :3].square()).mean() + (weights[..., :1] * alphas).mean()
    (loss + (alphas.detach() * colors[..., 3:]).sum() / alphas.numel()).backward()
    found: dict[str, Any] = {"colors": colors, "alphas": alphas} | {
        f"gradient of {name}": leaf.grad for name, leaf in leaves.items()
    }
    if options.absgrad:
        means2d: Any = info["means2d"]
        gradient = getattr(means2d, "grad2d", None)
        found |= {"absgrad": means2d.absgrad, "grad2d": means2d.grad if gradient is None else gradient}
    # Of rotations, an inverse and a transpose are differentiated differently.
    found |= {"gradient of translations": viewmats.grad[:, :3, 3]} if viewmats.grad is not None else {}
    assert len(info["flatten_ids"]) > 100
    return {"visible": visible(info).cpu()} | {name: value.detach().cpu().double() for name, value in found.items()}


@pytest.mark.parametrize("per_axis_radii", [False, True], ids=["gsplat 1.4", "gsplat 1.5"])
@pytest.mark.parametrize("case", CASES)
def test_it_draws_what_the_torch_backend_draws(case: str, per_axis_radii: bool, monkeypatch: pytest.MonkeyPatch):
    options, views = CASES[case]
    stub_gsplat(monkeypatch, per_axis_radii)
    ours = drawn_by(backend_gsplat, options, views, 40, "cpu", torch.float64, pose=True)
    expected = drawn_by(backend_torch, options, views, 40, "cpu", torch.float64, pose=True)
    seen = expected.pop("visible")
    assert seen.any()
    assert torch.equal(ours.pop("visible"), seen)
    if case in ("off the axis", "near plane"):
        assert not seen.all()
    assert ours.keys() == expected.keys()
    assert "gradient of translations" in ours
    for name, value in expected.items():
        assert_close(ours[name], value, rtol=1e-9, atol=1e-12, msg=name)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="gsplat's kernels need CUDA")
@pytest.mark.parametrize("case", CASES)
def test_it_draws_what_the_triton_backend_draws(case: str, monkeypatch: pytest.MonkeyPatch):
    backend_triton = pytest.importorskip("sadgs_ns.render.backend_triton", reason="Triton is not installed")
    monkeypatch.setattr(backend_gsplat, "TILE_SIZE", kernels.TILE_SIZE)  # gsplat 1.4 cuts off at borders of tiles
    options, views = CASES[case]
    theirs = drawn_by(backend_gsplat, options, views, 128, "cuda", torch.float32)
    ours = drawn_by(backend_triton, options, views, 128, "cuda", torch.float32)
    assert (ours.pop("visible") != theirs.pop("visible")).sum() <= 3
    assert ours.keys() == theirs.keys()
    for name, expected in theirs.items():
        # Rounding moves a few pairs over a cut-off, so single values may differ by more than rounding: compare norms.
        assert (ours[name] - expected).norm() < 2e-3 * expected.norm(), name


@pytest.fixture
def hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    """Hide gsplat's CUDA code, as where it was never compiled: calling it is an ImportError."""
    monkeypatch.setitem(sys.modules, "gsplat.cuda._backend", None)
    with pytest.raises(ImportError, match="_backend"):
        gsplat.spherical_harmonics(0, torch.ones(1, 3), torch.ones(1, 1, 3))


@pytest.mark.hard_case("gsplat's CUDA code was never compiled", "the Triton backend draws")
@pytest.mark.parametrize("case", ["depth", "near plane", "features"])
def test_the_triton_backend_draws_without_gsplats_kernels(
    case: str, hidden: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    backend_triton = pytest.importorskip("sadgs_ns.render.backend_triton", reason="Triton is not installed")
    options, views = CASES[case]
    device = "cuda" if torch.cuda.is_available() else "cpu"
    with kernels.triton_switched(True):
        ours = drawn_by(backend_triton, options, views, 24, device, torch.float32)
    expected = drawn_by(backend_torch, options, views, 24, "cpu", torch.float64)
    assert (ours.pop("visible") != expected.pop("visible")).sum() <= 1
    assert ours.keys() == expected.keys()
    for name, value in expected.items():
        # Rounding moves a few pairs over a cut-off.
        assert (ours[name] - value).norm() < 2e-3 * value.norm(), name


@pytest.mark.parametrize("of_each_view", [False, True])
def test_the_triton_backend_takes_coefficients_in_one_tensor(of_each_view: bool, hidden: None) -> None:
    scene = {name: value.float() for name, value in random_scene(40, 16, seed=0).items()}
    pytest.importorskip("triton", reason="Triton is not installed")
    device = "cuda" if torch.cuda.is_available() else "cpu"
    means = scene["means"].to(device)
    quats = scene["quats"].to(device)
    scales = scene["scales"].to(device)
    opacities = scene["opacities"].to(device)
    colors = scene["colors"].to(device)
    cameras = Cameras(scene["viewmats"].to(device), scene["Ks"].to(device), 16, 16)
    one_tensor = colors[None] if of_each_view else colors
    images = []
    with kernels.triton_switched(True):
        for coefficients in (one_tensor, (colors[:, 0], colors[:, 1:])):
            gaussians = Gaussians(means, quats, scales, opacities, coefficients)
            options = RenderOptions(sh_degree=3, backend="triton")
            images.append(rasterization.rasterize(gaussians, cameras, options)[0])
    assert_close(images[0], images[1], rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (RenderOptions(expected_depth=True, absgrad=True), "sums absolute gradients of 3 channels, and these are 4: "),
        (RenderOptions(sh_degree=4), "draws spherical harmonics up to degree 3, and these have 4"),
    ],
    ids=["absolute gradients of depth", "degree 4"],
)
def test_what_the_triton_backend_cannot_draw_is_refused(options: RenderOptions, problem: str) -> None:
    backend_triton = pytest.importorskip("sadgs_ns.render.backend_triton", reason="Triton is not installed")
    device = "cuda" if torch.cuda.is_available() else "cpu"
    with refusal(f"^The backend triton {problem}"), kernels.triton_switched(True):
        drawn_by(backend_triton, options, 1, 16, device, torch.float32)
