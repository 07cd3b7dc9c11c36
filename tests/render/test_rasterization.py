"""Which backend draws, that gsplat and the torch backend agree, and the functions that read what they return."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import Any

import pytest
import torch

from helpers.closeness import assert_within
from helpers.generators import seeded
from helpers.refusals import refusal
from helpers.rendered_scene import random_scene, render_with_gradients
from helpers.sharded_rendering import color_maps, inputs, splats, weights
from sadgs_ns.render import rasterization
from sadgs_ns.render.rasterization import viewmats_from_camera_to_world, visible
from sadgs_ns.render.types import RenderOptions


def devices_have(monkeypatch: pytest.MonkeyPatch, triton: bool) -> None:
    monkeypatch.setattr(rasterization, "use_triton", lambda place: triton)


@pytest.mark.parametrize(
    ("wanted", "device", "triton", "chosen"),
    [
        ("auto", "cuda", True, "triton"),
        ("auto", "cuda", False, "gsplat"),
        ("auto", "cpu", False, "torch"),
        ("gsplat", "cuda", True, "gsplat"),
        ("torch", "cuda", True, "torch"),
        ("triton", "cuda", True, "triton"),
    ],
)
def test_the_backend_follows_the_device(
    wanted: Any, device: str, triton: bool, chosen: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    devices_have(monkeypatch, triton)
    actual = rasterization.choose_backend(wanted, torch.device(device))
    assert actual == chosen


@pytest.mark.parametrize(("wanted", "device"), [("gsplat", "cpu"), ("triton", "cpu"), ("triton", "cuda")])
def test_a_backend_that_does_not_run_here_is_refused(wanted: Any, device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    devices_have(monkeypatch, triton=False)
    with refusal(rf"^The backend {wanted} [^.]+{device}[^.]*: set [^\n]+\.yml\.$"):
        rasterization.choose_backend(wanted, torch.device(device))


def test_the_cpu_never_loads_gsplats_kernels() -> None:
    program = """
import sys
from helpers.rendered_scene import random_scene, render_with_gradients
import torch
render_with_gradients(random_scene(20, 16, 0), "cpu", torch.float32)
loaded = {"gsplat.cuda._backend", "gsplat.csrc", "gsplat_cuda"} & set(sys.modules)
sys.exit(f"loaded {loaded}" if loaded else 0)
"""
    paths = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([sys.executable, "-c", program], env=paths, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("radii", "means2d", "expected"),
    [
        ([[3, 0], [0, 7]], torch.zeros(2, 2, 2), [[True, False], [False, True]]),
        ([[[3, 2], [0, 0]], [[0, 4], [7, 7]]], torch.zeros(2, 2, 2), [[True, False], [False, True]]),
        ([[3, 2], [0, 4]], torch.zeros(2, 2), [True, False]),
        ([3, 0], torch.zeros(2, 2), [True, False]),
    ],
    ids=["one radius", "radii per axis", "packed radii per axis", "packed radius"],
)
def test_visible(radii: list[Any], means2d: torch.Tensor, expected: list[Any]) -> None:
    info = {"radii": torch.tensor(radii, dtype=torch.int32), "means2d": means2d}
    assert visible(info).tolist() == expected


def test_viewmat_by_hand() -> None:
    # The camera stands at (1, 2, 3) and looks along world +x with world +z up: right is -y, back is -x.
    camera_to_world = torch.tensor([[[0.0, 0.0, -1.0, 1.0], [-1.0, 0.0, 0.0, 2.0], [0.0, 1.0, 0.0, 3.0]]])
    viewmats = viewmats_from_camera_to_world(camera_to_world)
    expected = [[[0.0, -1.0, 0.0, 2.0], [0.0, 0.0, -1.0, 3.0], [1.0, 0.0, 0.0, -1.0], [0.0, 0.0, 0.0, 1.0]]]
    assert viewmats.tolist() == expected


@pytest.mark.filterwarnings("ignore:Using a non-tuple sequence:UserWarning")  # nerfstudio's indexing
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_viewmats_project_nerfstudios_rays_to_their_pixels(dtype: torch.dtype) -> None:
    cameras = pytest.importorskip("nerfstudio.cameras.cameras")
    generator = seeded(0)
    rotations = torch.linalg.qr(torch.randn(3, 3, 3, generator=generator))[0]
    rotations *= torch.linalg.det(rotations)[:, None, None]
    poses = torch.cat([rotations, torch.randn(3, 3, 1, generator=generator)], dim=-1)
    camera = cameras.Cameras(poses, fx=40.0, fy=44.0, cx=15.0, cy=13.0, width=32, height=24)
    viewmats = viewmats_from_camera_to_world(poses.to(dtype))
    assert viewmats.dtype == dtype
    for index in range(3):
        rays = camera.generate_rays(camera_indices=index)
        points = (rays.origins + 2.0 * rays.directions).reshape(-1, 3).to(dtype)  # [H * W, 3]
        seen = points @ viewmats[index, :3, :3].T + viewmats[index, :3, 3]
        assert (seen[:, 2] > 0).all()
        pixels = seen @ camera[index].get_intrinsics_matrices().to(dtype).T
        expected = camera.get_image_coords().flip(-1).reshape(-1, 2).to(dtype)  # pixel centres as (x, y)
        actual = pixels[:, :2] / pixels[:, 2:]
        assert_within(actual, expected, 1e-3)


BACKENDS = ["torch"]
if torch.cuda.is_available():
    BACKENDS += ["gsplat", "triton"]


@pytest.mark.parametrize("backend", BACKENDS)
def test_colour_maps_of_views_do_what_gains_of_their_pictures_do(backend: Any) -> None:
    device = torch.device("cpu" if backend == "torch" else "cuda")
    views = 3
    maps = color_maps(views).to(device)
    results = []
    for of_gaussians in (True, False):
        leaves = {name: value.detach().to(device).requires_grad_() for name, value in inputs().items()}
        options = RenderOptions(sh_degree=1, backend=backend)
        if of_gaussians:
            colors, _, _ = rasterization.rasterize(*splats(leaves, views), options, color_maps=maps)
        else:
            rendered, alphas, _ = rasterization.rasterize(*splats(leaves, views), options)
            factors, offsets = maps[:, :, None, None].unbind(dim=1)
            colors = rendered * factors + alphas * offsets
        (colors * weights(views).to(device)[..., :3]).sum().backward()
        results.append({"colors": colors.detach()} | {name: leaf.grad for name, leaf in leaves.items()})
    for_gaussians, for_pictures = results
    for name, expected in for_pictures.items():
        assert expected is not None
        assert_within(for_gaussians[name], expected, 2e-5 * float(expected.abs().max()))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="gsplat needs a CUDA device")
def test_gsplat_and_the_splatter_agree() -> None:
    scene = random_scene(3000, 128, seed=0)
    theirs = render_with_gradients(scene, "cuda", torch.float32)
    ours = render_with_gradients(scene, "cpu", torch.float32)
    assert (ours.pop("visible") != theirs.pop("visible")).sum() <= 3
    for name in ("means2d", "conics"):
        # gsplat leaves these uninitialised for culled Gaussians; the gradients below test them further.
        del ours[name], theirs[name]
    for name, expected in theirs.items():
        # Rounding moves a few pairs over a cut-off, so single values may differ by more than rounding: compare norms.
        assert (ours[name] - expected).norm() < 2e-3 * expected.norm(), name
