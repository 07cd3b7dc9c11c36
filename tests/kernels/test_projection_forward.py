"""The forward projection against float64, also where float32 cancels, and on CUDA beside gsplat's."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from helpers import gsplat_stub
from helpers.closeness import assert_within_share
from helpers.generators import seeded
from helpers.random_gaussians import nearly_aligned_viewmats
from sadgs_ns import gsplat_compat
from sadgs_ns.render import backend_torch

projection_forward = pytest.importorskip("sadgs_ns.kernels.projection_forward", reason="Triton is not installed")

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
WIDTH = 400
HEIGHT = 300
N = 300  # More than the Gaussians of two programs
LAYOUTS = pytest.mark.parametrize("per_axis_radii", [False, True], ids=["gsplat 1.4", "gsplat 1.5"])
OUTPUTS = ("means2d", "depths", "conics")
Scene = dict[str, Tensor]


def random_scene(num_views: int) -> Scene:
    """N Gaussians of all forms; some are faint, beside, behind or too near to the cameras. In float64."""
    generator = seeded(0)

    def random(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    viewmats = nearly_aligned_viewmats(num_views, generator)
    opacities = torch.rand((N,), generator=generator, dtype=torch.float64)
    opacities[::7] = 0.002  # less than 1/255
    means = random(N, 3) * torch.tensor([1.5, 1.5, 1.0]) + torch.tensor([0.0, 0.0, 3.0])
    K = torch.tensor([[350.0, 0.0, 190.0], [0.0, 450.0, 160.0], [0.0, 0.0, 1.0]])
    scene = {
        "means": means,
        "quats": 3 * random(N, 4),
        "scales": (random(N, 3) - 2.5).exp(),
        "opacities": opacities,
        "viewmats": viewmats,
        "Ks": K.repeat(num_views, 1, 1),
    }
    return rounded(scene)


def rounded(scene: Scene) -> Scene:
    """Round values to float32, so that every type of number projects the same ones."""
    return {name: value.float().double() for name, value in scene.items()}


def use_layout(monkeypatch: pytest.MonkeyPatch, per_axis_radii: bool) -> None:
    """Let the kernel and its twin write radii as gsplat 1.5 does, or as 1.4 does."""
    for module in (gsplat_compat, backend_torch):
        monkeypatch.setattr(module, "RADII_PER_AXIS", per_axis_radii)


def by_the_kernel(scene: Scene, width: int, height: int, near_plane: float = 0.01) -> tuple[Tensor, ...]:
    """Project in float32 with the kernel. Its results on the CPU"""
    inputs = {name: value.float().to(DEVICE).contiguous() for name, value in scene.items()}
    with np.errstate(all="ignore"):  # Triton's interpreter computes with numpy.
        results = projection_forward.project_forward(**inputs, width=width, height=height, near_plane=near_plane)
    return tuple(value.cpu() for value in results)


def by_the_twin(scene: Scene, dtype: torch.dtype, width: int, height: int) -> tuple[Tensor, ...]:
    """Project in torch."""
    inputs: dict[str, Any] = {name: value.to(dtype) for name, value in scene.items()}
    return gsplat_stub.project(**inputs, width=width, height=height)


def relative_errors(conics: Tensor, true: Tensor) -> Tensor:
    """Largest error of a conic's entries, relative to the largest entry. [...]"""
    return (conics.double() - true).abs().amax(dim=-1) / true.abs().amax(dim=-1)


@LAYOUTS
@pytest.mark.parametrize("num_views", [1, 3])
def test_it_projects_as_its_twin_does_in_float64(num_views: int, per_axis_radii: bool, monkeypatch: Any):
    use_layout(monkeypatch, per_axis_radii)
    scene = random_scene(num_views)
    radii, *found = by_the_kernel(scene, WIDTH, HEIGHT)
    true_radii, *true = by_the_twin(scene, torch.float64, WIDTH, HEIGHT)
    assert radii.dtype == torch.int32
    assert radii.shape == true_radii.shape
    assert radii.shape == ((num_views, N, 2) if per_axis_radii else (num_views, N))
    seen = gsplat_compat.drawn(true_radii, true[0])
    assert 0.2 < seen.float().mean() < 0.8
    # Rounding may move a radius over a whole number.
    assert (radii - true_radii).abs().max() <= 1
    assert (radii != true_radii).sum() <= 2 * num_views
    seen = seen & gsplat_compat.drawn(radii, found[0])
    for name, value, expected in zip(OUTPUTS, found, true, strict=True):
        assert value.dtype == torch.float32
        assert value.shape == expected.shape
        error = (value[seen] - expected[seen]).abs().max() / expected[seen].abs().max()
        assert error < 1e-6, (name, float(error))
    assert relative_errors(found[2][seen], true[2][seen]).max() < 1e-5


def rotated_from_x(directions: Tensor) -> Tensor:
    """Quaternions that turn the x axis to unit vectors. [N, 4]"""
    x, y, z = directions.unbind(dim=-1)
    return torch.stack([1 + x, torch.zeros_like(x), -z, y], dim=-1)


def needles(angles: Tensor, sigma: float, thickness: float, focal: float, tilt: float = 0.0) -> Scene:
    """Make needles at depth 1 whose footprints' long axes have some angles in the image.

    Args:
        angles: In radians. [N]
        sigma: Standard deviation along the needle, in px at the image's centre.
        thickness: That of its other axes, in px.
        focal: In px.
        tilt: Component along the viewing axis of the needles' directions, before they are normalized.
    """
    directions = torch.stack([angles.cos(), angles.sin(), torch.full_like(angles, tilt)], dim=-1)
    directions = torch.nn.functional.normalize(directions, dim=-1)
    n = len(angles)
    scales = torch.tensor([sigma, thickness, thickness], dtype=torch.float64) / focal
    K = torch.tensor([[focal, 0.0, 800.0], [0.0, focal, 530.0], [0.0, 0.0, 1.0]])
    return {
        "means": torch.tensor([0.0, 0.0, 1.0]).double().repeat(n, 1),
        "quats": rotated_from_x(directions),
        "scales": scales.repeat(n, 1),
        "opacities": torch.full((n,), 0.9).double(),
        "viewmats": torch.eye(4).double()[None],
        "Ks": K[None].double(),
    }


ANGLES = torch.linspace(math.radians(40), math.radians(50), 101, dtype=torch.float64)


def hard_scenes() -> dict[str, Scene]:
    """Scenes of 1,600 × 1,060 px whose determinants cancel, or whose numbers are small or large."""
    scenes = {
        "needles of 1,600 px at 45°": needles(ANGLES, 1600.0, 0.1, 1300.0),
        "needles of 1,600 px that lean": needles(ANGLES, 1600.0, 0.1, 1300.0, tilt=0.5),
        "needles of 40,000 px": needles(ANGLES, 40_000.0, 0.1, 1300.0),
        "tiny Gaussians": needles(ANGLES, 1e-9, 1e-12, 1300.0),
        "scales that underflow": needles(ANGLES, 1e-20, 1e-30, 1300.0),
    }
    # The Jacobian is taken 0.3 half images beyond the border, and these reach into the image.
    off_axis = needles(ANGLES, 1600.0, 0.1, 1300.0)
    off_axis["means"] = off_axis["means"] + torch.tensor([1.5, 1.2, 0.0])
    scenes["needles far off the axis"] = off_axis
    wide = needles(ANGLES, 1600.0, 0.1, 200.0)
    wide["means"] = wide["means"] + torch.tensor([3.5, 2.2, 0.0])
    scenes["needles at the border of a wide image"] = wide
    near = needles(ANGLES, 1600.0, 0.1, 1300.0)
    near["means"] = near["means"] * 0.02
    near["scales"] = near["scales"] * 0.02
    scenes["needles at the near plane"] = near
    return {name: rounded(scene) for name, scene in scenes.items()}


@pytest.mark.hard_case(
    "Gaussians as thin needles across 1,600 px, far off the axis, or tiny",
    "the inverse of Σ2D errs by less than 1e-5, where that by `ac − b²` in float32 errs by a tenth and more",
)
@pytest.mark.parametrize("name", hard_scenes())
def test_conics_are_exact_where_the_determinant_cancels(name: str):
    scene = hard_scenes()[name]
    radii, means2d, _, conics = by_the_kernel(scene, 1600, 1060)
    true_radii, true_means2d, _, true_conics = by_the_twin(scene, torch.float64, 1600, 1060)
    seen = gsplat_compat.drawn(radii, means2d)
    assert torch.equal(seen, gsplat_compat.drawn(true_radii, true_means2d))
    assert seen.all()
    assert relative_errors(conics, true_conics).max() < 1e-5


def test_of_needles_of_1600_px_the_usual_determinant_loses_a_tenth():
    """Otherwise the test above would not show what the minors bring."""
    scene = hard_scenes()["needles of 1,600 px at 45°"]
    *_, conics = by_the_twin(scene, torch.float32, 1600, 1060)
    *_, true_conics = by_the_twin(scene, torch.float64, 1600, 1060)
    assert relative_errors(conics, true_conics).max() > 0.1


def sound_scene(n: int) -> Scene:
    """n Gaussians that all are drawn: spheres before one camera, beside its axis."""
    scene = needles(torch.zeros(n, dtype=torch.float64), 20.0, 20.0, 350.0)
    scene["means"] = scene["means"] * 3 + torch.tensor([0.2, 0.1, 0.0])
    scene["Ks"] = torch.tensor([[[350.0, 0.0, 190.0], [0.0, 450.0, 160.0], [0.0, 0.0, 1.0]]]).double()
    return rounded(scene)


BROKEN = {
    "NaN": ("means scales quats opacities", math.nan),
    "infinity": ("means scales", math.inf),
    "−infinity": ("means", -math.inf),
    "3e38": ("means scales", 3e38),
    "a quaternion of zeros": ("quats", 0.0),
    "a quaternion whose length underflows": ("quats", 1e-30),
}


@LAYOUTS
@pytest.mark.hard_case(
    "NaN, infinity or 3e38 in a Gaussian's parameters, or a quaternion of zeros",
    "it is not drawn, as in gsplat; the others are",
)
@pytest.mark.parametrize("value", BROKEN)
def test_what_has_no_finite_projection_is_not_drawn(value: str, per_axis_radii: bool, monkeypatch: Any):
    use_layout(monkeypatch, per_axis_radii)
    names, number = BROKEN[value]
    for name in names.split():
        if name == "opacities" and not per_axis_radii:
            continue  # gsplat 1.4's projection does not read them.
        scene = sound_scene(9)
        columns = scene[name].reshape(9, -1).shape[1]
        for column in range(columns):
            of_gaussian = scene[name].reshape(9, -1)[column]
            if name == "quats" and not math.isnan(number):
                of_gaussian[:] = number
            else:
                of_gaussian[column] = number
        radii, *found = by_the_kernel(scene, WIDTH, HEIGHT)
        seen = gsplat_compat.drawn(radii, found[0])[0]
        assert seen.tolist() == [False] * columns + [True] * (9 - columns), name
        for output in found:
            assert output[0][seen].isfinite().all()


@LAYOUTS
@pytest.mark.hard_case(
    "parameters of all sizes that float32 holds", "what is drawn has a finite centre, depth and inverse of Σ2D"
)
def test_what_is_drawn_is_finite(per_axis_radii: bool, monkeypatch: Any):
    use_layout(monkeypatch, per_axis_radii)
    generator = seeded(0)

    def numbers(*shape: int) -> Tensor:
        exponents = 38 * (2 * torch.rand(shape, generator=generator) - 1)
        return 10.0 ** exponents.double() * torch.randn(shape, generator=generator).sign()

    scene = random_scene(2)
    for name in ("means", "quats", "scales"):
        chosen = torch.rand(scene[name].shape, generator=generator) < 0.3
        scene[name] = torch.where(chosen, numbers(*scene[name].shape), scene[name])
    scene["scales"] = scene["scales"].abs()
    radii, *found = by_the_kernel(rounded(scene), WIDTH, HEIGHT)
    seen = gsplat_compat.drawn(radii, found[0])
    assert seen.sum() > 20
    for name, output in zip(OUTPUTS, found, strict=True):
        assert output[seen].isfinite().all(), name
    assert (found[1][seen] >= 0.01).all()
    assert (radii >= 0).all()


def test_scales_of_zero_leave_the_blur():
    scene = sound_scene(2)
    scene["scales"][:] = 0.0
    radii, _, _, conics = by_the_kernel(scene, WIDTH, HEIGHT)
    assert (radii > 0).all()
    blur = 1 / gsplat_compat.SCREEN_BLUR
    expected = torch.tensor([blur, 0.0, blur]).expand(1, 2, 3)
    assert_within_share(conics, expected, 1e-6)


@pytest.mark.hard_case("a Gaussian behind, at and before the near plane", "it is drawn from the near plane on")
def test_gaussians_are_drawn_from_the_near_plane_on():
    scene = sound_scene(6)
    scene["means"][:, 2] = torch.tensor([-3.0, 0.0, 0.4999, 0.5, 0.5001, 2e10])
    scene["means"][:, :2] = 0.0
    scene["scales"][:] = 0.001
    radii, means2d, depths, _ = by_the_kernel(scene, WIDTH, HEIGHT, near_plane=0.5)
    seen = gsplat_compat.drawn(radii, means2d)[0]
    assert seen.tolist() == [False, False, False, True, True, False]
    assert torch.equal(depths[0][seen], scene["means"][seen, 2].float())


@pytest.mark.hard_case("no Gaussians", "the projection has no rows")
@LAYOUTS
def test_no_gaussians_have_no_rows(per_axis_radii: bool, monkeypatch: Any):
    use_layout(monkeypatch, per_axis_radii)
    scene = random_scene(2)
    for name in ("means", "quats", "scales", "opacities"):
        scene[name] = scene[name][:0]
    radii, *found = by_the_kernel(scene, WIDTH, HEIGHT)
    assert radii.shape == ((2, 0, 2) if per_axis_radii else (2, 0))
    expected = [(2, 0, 2), (2, 0), (2, 0, 3)]
    shapes = [output.shape for output in found]
    assert shapes == expected


@pytest.mark.skipif(not torch.cuda.is_available(), reason="gsplat's kernels need CUDA")
@pytest.mark.parametrize("num_views", [1, 3])
def test_it_is_as_close_to_float64_as_gsplat(num_views: int):
    scene = random_scene(num_views)
    true_radii, *true = by_the_twin(scene, torch.float64, WIDTH, HEIGHT)
    inputs: dict[str, Any] = {name: value.float().to(DEVICE) for name, value in scene.items()}
    gsplats = [value.cpu() for value in gsplat_compat.project(**inputs, width=WIDTH, height=HEIGHT)]
    ours = by_the_kernel(scene, WIDTH, HEIGHT)
    assert ours[0].shape == gsplats[0].shape
    assert ours[0].dtype == gsplats[0].dtype
    # Rounding may move a radius over a whole number.
    assert (ours[0] - gsplats[0]).abs().max() <= 1
    assert (ours[0] != gsplats[0]).sum() <= 4 * num_views
    seen = gsplat_compat.drawn(true_radii, true[0])
    for projected in (ours, gsplats):
        seen = seen & gsplat_compat.drawn(projected[0], projected[1])
    assert seen.float().mean() > 0.2
    for name, value, gsplats_value, expected in zip(OUTPUTS, ours[1:], gsplats[1:], true, strict=True):
        scale = expected[seen].abs().max()
        error = (value[seen] - expected[seen]).abs().max() / scale
        gsplats_error = (gsplats_value[seen] - expected[seen]).abs().max() / scale
        assert error <= max(2 * float(gsplats_error), 1e-6), (name, float(error), float(gsplats_error))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="gsplat's kernels need CUDA")
def test_conics_of_hard_cases_are_closer_to_float64_than_gsplats():
    for name, scene in hard_scenes().items():
        *_, true = by_the_twin(scene, torch.float64, 1600, 1060)
        inputs: dict[str, Any] = {name: value.float().to(DEVICE) for name, value in scene.items()}
        radii, means2d, _, gsplats = (v.cpu() for v in gsplat_compat.project(**inputs, width=1600, height=1060))
        drawn = gsplat_compat.drawn(radii, means2d)
        gsplats_error = math.inf  # gsplat culls what has a determinant ≤ 0.
        if drawn.all():
            gsplats_error = float(relative_errors(gsplats, true).max())
        error = float(relative_errors(by_the_kernel(scene, 1600, 1060)[3], true).max())
        print(name, error, gsplats_error)
        assert error <= max(gsplats_error, 1e-6), (name, error, gsplats_error)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="CUDA graphs need CUDA")
def test_a_cuda_graph_replays_it():
    scene = random_scene(2)
    inputs: dict[str, Any] = {name: value.float().to(DEVICE) for name, value in scene.items()}
    expected = projection_forward.project_forward(**inputs, width=WIDTH, height=HEIGHT)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):  # An error where anything waits for the GPU
        results = projection_forward.project_forward(**inputs, width=WIDTH, height=HEIGHT)
    graph.replay()
    seen = gsplat_compat.drawn(expected[0], expected[1])
    assert torch.equal(results[0], expected[0])
    assert seen.any()
    for value, of_launch in zip(results[1:], expected[1:], strict=True):
        assert torch.equal(value[seen], of_launch[seen])
