"""The torch splatter against a renderer that loops over pixels and Gaussians, and against finite differences."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from torch import Tensor
from torch.testing import assert_close
from torch.utils._python_dispatch import TorchDispatchMode

from helpers.closeness import assert_within
from helpers.generators import seeded
from helpers.gsplat_like import splatted
from helpers.rendered_scene import random_scene
from sadgs_ns.render import backend_torch

NEAR = 0.01


def look_from(angle: float, distance: float) -> Tensor:
    """World-to-camera transform [1, 4, 4] of a camera that looks at the origin."""
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[0, 0] = viewmat[2, 2] = math.cos(angle)
    viewmat[0, 2] = math.sin(angle)
    viewmat[2, 0] = -math.sin(angle)
    viewmat[2, 3] = distance
    return viewmat[None]


def small_scene(gaussians: int = 24, seed: int = 0) -> dict[str, Any]:
    """float64 arguments of `rasterization` that reach all of its cut-offs, for an image of 37 x 29 px."""
    generator = seeded(seed)
    means = torch.rand(gaussians, 3, generator=generator, dtype=torch.float64) * 2.0 - 1.0
    means[:, 1] *= 0.6
    scales = 0.02 + 0.3 * torch.rand(gaussians, 3, generator=generator, dtype=torch.float64) ** 2
    opacities = 0.05 + 0.9 * torch.rand(gaussians, generator=generator, dtype=torch.float64)
    # Opaque, so that what is behind is not drawn. The first is so wide that alpha is cut off at several pixels around
    # its middle, in a corner of the image where nothing stands before it.
    opacities[::3] = 1.0
    scales[::3] += 0.1
    scales[0] = 3.0
    opacities[1] = 0.003
    culled = [[0.3, 0.1, -4.0], [9.0, 0.0, 0.0]]
    for index, mean in zip((0, 2, 4, 5), [[-1.77, -1.2, 1.17], *culled, [2.2, 0.2, -0.5]], strict=True):
        means[index] = torch.tensor(mean)
    return {
        "means": means,
        "quats": torch.randn(gaussians, 4, generator=generator, dtype=torch.float64),
        "scales": scales,
        "opacities": opacities,
        "colors": torch.rand(gaussians, 3, generator=generator, dtype=torch.float64),
        "viewmats": look_from(0.2, 2.5),
        "Ks": torch.tensor([[[40.0, 0.0, 18.0], [0.0, 42.0, 15.5], [0.0, 0.0, 1.0]]], dtype=torch.float64),
        "width": 37,
        "height": 29,
    }


def render(scene: dict[str, Any], **changes: Any) -> tuple[Tensor, Tensor, dict[str, Any]]:
    return splatted(**{**scene, **changes})


def reference_gaussian(scene: dict[str, Any], index: int, per_axis: bool) -> dict[str, Any] | None:
    """Projection of one Gaussian by the first camera, or None if it is culled."""
    quat = scene["quats"][index].numpy()
    scale = scene["scales"][index].numpy()
    viewmat = scene["viewmats"][0].numpy()
    K = scene["Ks"][0].numpy()
    size = np.array([scene["width"], scene["height"]])
    w, x, y, z = quat / np.linalg.norm(quat)
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    center = viewmat[:3, :3] @ scene["means"][index].numpy() + viewmat[:3, 3]
    if center[2] < NEAR:
        return None
    focal = K.diagonal()[:2]
    principal = K[:2, 2]
    slopes = center[:2] / center[2]
    margin = 0.15 * size / focal
    clamped = np.clip(slopes, -principal / focal - margin, (size - principal) / focal + margin)
    jacobian = np.concatenate([np.diag(focal), -(focal * clamped)[:, None]], axis=1) / center[2]
    axes = jacobian @ viewmat[:3, :3] @ rotation @ np.diag(scale)
    blurred = axes @ axes.T + 0.3 * np.eye(2)
    opacity = scene["opacities"][index].item()
    if per_axis:
        if opacity < 1 / 255:
            return None
        radii = np.ceil(min(3.33, math.sqrt(2 * math.log(opacity * 255))) * np.sqrt(blurred.diagonal()))
    else:
        half_trace = blurred.trace() / 2
        gap = max(0.01, half_trace**2 - np.linalg.det(blurred))
        radii = np.full(2, math.ceil(3 * math.sqrt(half_trace + math.sqrt(gap))))
    mean = focal * slopes + principal
    if (mean + radii <= 0).any() or (mean - radii >= size).any():
        return None
    return {
        "mean": mean,
        "precision": np.linalg.inv(blurred),
        "radii": radii,
        "opacity": opacity,
        "color": np.append(scene["colors"][index].numpy(), center[2]),
        "depth": center[2],
    }


def reference_render(scene: dict[str, Any], *, per_axis: bool, tile_size: int = 16) -> tuple[np.ndarray, np.ndarray]:
    """Colour and depth [H, W, 4], and alpha [H, W, 1]."""
    projected = [reference_gaussian(scene, index, per_axis) for index in range(len(scene["means"]))]
    gaussians = sorted([one for one in projected if one is not None], key=lambda one: one["depth"])
    image = np.zeros((scene["height"], scene["width"], 4))
    alphas = np.zeros((scene["height"], scene["width"], 1))
    for row, column in np.ndindex(scene["height"], scene["width"]):
        tile = np.array([column // tile_size, row // tile_size])
        transmittance = 1.0
        for one in gaussians:
            first = np.floor((one["mean"] - one["radii"]) / tile_size)
            end = np.ceil((one["mean"] + one["radii"]) / tile_size)
            if (tile < first).any() or (tile >= end).any():
                continue
            offset = one["mean"] - [column + 0.5, row + 0.5]
            alpha = min(0.999, one["opacity"] * math.exp(-0.5 * offset @ one["precision"] @ offset))
            if alpha < 1 / 255:
                continue
            if transmittance * (1 - alpha) <= 1e-4:
                break
            image[row, column] += alpha * transmittance * one["color"]
            transmittance *= 1 - alpha
        alphas[row, column] = 1 - transmittance
    return image, alphas


@pytest.fixture(params=[128, 3], ids=["one segment", "many segments"])
def segment(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backend_torch, "_SEGMENT", request.param)


@pytest.mark.usefixtures("segment")
@pytest.mark.parametrize("per_axis", [False, True])
def test_agrees_with_the_reference(per_axis: bool) -> None:
    scene = small_scene()
    colors, alphas, info = render(scene, render_mode="RGB+ED", per_axis_radii=per_axis)
    expected_colors, expected_alphas = reference_render(scene, per_axis=per_axis)
    expected_colors[..., 3:] /= np.maximum(expected_alphas, 1e-10)
    assert colors.dtype == torch.float64
    actual = colors[0].numpy()
    assert_allclose(actual, expected_colors, rtol=0, atol=1e-12)
    actual = alphas[0].numpy()
    assert_allclose(actual, expected_alphas, rtol=0, atol=1e-12)
    for index in range(len(scene["means"])):
        one = reference_gaussian(scene, index, per_axis)
        radii = np.zeros(2) if one is None else one["radii"]
        actual = info["radii"][0, index].tolist()
        expected = radii.tolist() if per_axis else radii[0]
        assert actual == (expected)
    # The scene reaches the cut-offs: pixels that are done, and Gaussians that are culled.
    assert alphas.max() > 0.999
    assert (info["radii"] == 0).any()


@pytest.mark.parametrize("tile_size", [8, 16, 64])
def test_tile_size(tile_size: int) -> None:
    scene = small_scene()
    colors, _, _ = render(scene, tile_size=tile_size, per_axis_radii=False)
    expected, _ = reference_render(scene, per_axis=False, tile_size=tile_size)
    actual = colors[0].numpy()
    assert_allclose(actual, expected[..., :3], rtol=0, atol=1e-12)


def test_spherical_harmonics() -> None:
    scene = small_scene()
    coefficients = torch.randn(len(scene["means"]), 9, 3, dtype=torch.float64, generator=seeded(1))
    camera = -scene["viewmats"][0, :3, :3].T @ scene["viewmats"][0, :3, 3]
    directions = torch.nn.functional.normalize(scene["means"] - camera, dim=-1)
    basis = torch.cat([torch.full_like(directions[:, :1], 0.28209479177), -0.48860251190292 * directions], dim=-1)
    basis = basis[:, [0, 2, 3, 1]] * torch.tensor([1.0, 1.0, -1.0, 1.0])  # y, z, x, and only z is positive
    scene["colors"] = (torch.einsum("nk,nkd->nd", basis, coefficients[:, :4]) + 0.5).clamp_min(0.0)
    expected, _ = reference_render(scene, per_axis=False)
    for given in (coefficients, (coefficients[:, 0], coefficients[:, 1:])):
        colors, _, _ = render(scene, colors=given, sh_degree=1, per_axis_radii=False)
        actual = colors[0].numpy()
        assert_allclose(actual, expected[..., :3], rtol=0, atol=1e-10)


@pytest.mark.usefixtures("segment")
def test_gradients_agree_with_finite_differences() -> None:
    scene = small_scene(gaussians=6, seed=3)
    # Keep away from the cut-offs, at which the image jumps.
    scene["means"] *= 0.3
    scene["scales"] = 0.15 + 0.5 * scene["scales"]
    scene["opacities"] = torch.linspace(0.3, 0.9, 6, dtype=torch.float64)
    scene["colors"] = torch.randn(6, 4, 3, dtype=torch.float64, generator=seeded(2))
    scene |= {"width": 6, "height": 5, "Ks": scene["Ks"] / 6.0}
    scene["Ks"][0, 2, 2] = 1.0
    names = ["means", "quats", "scales", "opacities", "colors", "viewmats"]

    def images(*values: Tensor) -> tuple[Tensor, Tensor]:
        arguments: dict[str, Any] = dict(zip(names, values, strict=True))
        colors, alphas, _ = render(scene | arguments, sh_degree=1, render_mode="RGB+ED", tile_size=4)
        return colors, alphas

    inputs = [scene[name].clone().requires_grad_() for name in names]
    assert torch.autograd.gradcheck(images, inputs, eps=1e-6, atol=1e-6, rtol=1e-5)


def pixel_losses(
    info: dict[str, Any], means2d: Tensor, colors: Tensor, weights: Tensor, width: int, height: int
) -> list[Tensor]:
    """The terms of sum(weights * colour^2), pixel by pixel, as functions of means2d [N, 2]."""
    conics = info["conics"][0].detach()
    opacities = info["opacities"][0].detach()
    radii = info["radii"][0]
    losses = []
    for row, column in np.ndindex(height, width):
        tile = torch.tensor([column // 16, row // 16])
        transmittance = torch.ones((), dtype=torch.float64)
        color = torch.zeros(3, dtype=torch.float64)
        for index in info["depths"][0].argsort().tolist():
            low = ((means2d[index] - radii[index]) / 16).floor()
            high = ((means2d[index] + radii[index]) / 16).ceil()
            if radii[index] == 0 or (tile < low).any() or (tile >= high).any():
                continue
            dx, dy = means2d[index] - torch.tensor([column + 0.5, row + 0.5], dtype=torch.float64)
            a, b, c = conics[index]
            alpha = (opacities[index] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)).clamp_max(0.999)
            if alpha < 1 / 255:
                continue
            if transmittance * (1 - alpha) <= 1e-4:
                break
            color = color + alpha * transmittance * colors[index]
            transmittance = transmittance * (1 - alpha)
        losses.append((weights[row, column] * color.square()).sum())
    return losses


@pytest.mark.usefixtures("segment")
def test_absgrad_sums_the_absolute_gradients_of_the_pixels() -> None:
    scene: dict[str, Any] = {**small_scene(gaussians=8), "width": 21, "height": 18}
    scene["means"].requires_grad_()
    weights = torch.rand(18, 21, 3, dtype=torch.float64, generator=seeded(4)) - 0.3
    colors, _, info = render(scene, absgrad=True, per_axis_radii=False)
    info["means2d"].retain_grad()
    (weights * colors[0].square()).sum().backward()

    means2d = info["means2d"][0].detach().requires_grad_()
    total = torch.zeros_like(means2d)
    absolute = torch.zeros_like(means2d)
    for loss in pixel_losses(info, means2d, scene["colors"], weights, 21, 18):
        if loss.requires_grad:
            (gradient,) = torch.autograd.grad(loss, means2d)
            total += gradient
            absolute += gradient.abs()
    actual = info["means2d"].grad[0]
    assert_close(actual, total)
    actual = info["means2d"].absgrad[0]
    assert_close(actual, absolute)
    assert (absolute > total.abs() + 1e-3).any()


def test_without_absgrad_nothing_is_attached() -> None:
    scene = small_scene()
    scene["means"].requires_grad_()
    colors, _, info = render(scene)
    colors.sum().backward()
    assert not hasattr(info["means2d"], "absgrad")


@pytest.mark.parametrize("per_axis", [False, True])
def test_info_has_keys_and_shapes_of_gsplat(per_axis: bool) -> None:
    scene = small_scene()
    _, _, info = render(scene, per_axis_radii=per_axis)
    n = len(scene["means"])
    shapes = {
        "radii": (1, n, 2) if per_axis else (1, n),
        "means2d": (1, n, 2),
        "depths": (1, n),
        "conics": (1, n, 3),
        "opacities": (1, n),
    }
    numbers = {"width": 37, "height": 29, "n_cameras": 1}
    actual = {name: tuple(info[name].shape) for name in shapes}
    assert actual == shapes
    actual = {name: info[name] for name in numbers}
    assert actual == numbers
    assert info["radii"].dtype == torch.int32
    assert info["flatten_ids"].dim() == 1
    assert set(info) == set(shapes) | set(numbers) | {"flatten_ids"}


def test_isects_agree_with_gsplat() -> None:
    impl = pytest.importorskip("gsplat.cuda._torch_impl")
    scene = small_scene()
    scene |= {"viewmats": torch.cat([scene["viewmats"], look_from(-0.5, 3.0)]), "Ks": scene["Ks"].expand(2, 3, 3)}
    _, _, info = render(scene)
    _, isects, flat = impl._isect_tiles(info["means2d"], info["radii"], info["depths"], 16, 3, 2)
    assert torch.equal(info["flatten_ids"], flat.long())
    extents = info["radii"] if info["radii"].dim() == 3 else info["radii"][..., None].expand_as(info["means2d"])
    tiles = backend_torch._bin_into_tiles(info["means2d"], info["depths"], extents.double(), 37, 29)
    assert torch.equal(tiles.offsets.int(), impl._isect_offset_encode(isects, 2, 3, 2).flatten())
    assert torch.equal(tiles.counts, torch.diff(tiles.offsets, append=torch.tensor([len(flat)])))


def test_culled_gaussians_get_zero_gradients() -> None:
    # Behind the camera, in the camera plane, off the screen, and beyond the far plane.
    means = torch.tensor([[0.0, 0.0, -1.0], [0.0, 0.0, 0.0], [50.0, 0.0, 1.0], [0.0, 0.0, 2e10]]).requires_grad_()
    scales = torch.full((4, 3), 0.1).requires_grad_()
    quats = torch.eye(4)
    opacities = torch.full((4,), 0.8)
    colors = torch.ones(4, 16, 3)
    viewmats = torch.eye(4)[None]
    Ks = torch.tensor([[[20.0, 0, 10], [0, 20.0, 10], [0, 0, 1]]])
    image, alphas, info = splatted(
        means, quats, scales, opacities, colors, viewmats, Ks, 20, 20, sh_degree=3, absgrad=True
    )
    (image.sum() + alphas.sum()).backward()
    assert not image.any()
    assert not alphas.any()
    assert not info["radii"].any()
    for gradient in (means.grad, scales.grad, info["means2d"].absgrad):
        assert gradient is not None
        assert torch.equal(gradient, torch.zeros_like(gradient))


def test_no_gaussians() -> None:
    scene: dict[str, Any] = {
        name: value[:0] for name, value in small_scene().items() if name in ("means", "quats", "scales")
    }
    scene |= {"opacities": torch.zeros(0, dtype=torch.float64), "colors": torch.zeros(0, 4, 3, dtype=torch.float64)}
    scene["means"].requires_grad_()
    camera = {name: small_scene()[name] for name in ("viewmats", "Ks", "width", "height")}
    image, alphas, info = render(scene | camera, sh_degree=1, absgrad=True)
    image.sum().backward()
    assert image.shape == (1, 29, 37, 3)
    assert not image.any()
    assert not alphas.any()
    assert info["means2d"].absgrad.shape == (1, 0, 2)
    assert scene["means"].grad is not None
    assert scene["means"].grad.shape == (0, 3)


def test_two_cameras_equal_two_calls() -> None:
    scene = small_scene()
    views: list[dict[str, Any]] = [
        {"viewmats": look_from(angle, 2.5), "colors": small_scene(seed=seed)["colors"][None]}
        for seed, angle in enumerate((0.2, -0.6))
    ]
    both: dict[str, Any] = {name: torch.cat([view[name] for view in views]) for name in ("viewmats", "colors")}
    colors, alphas, info = render(scene | both, Ks=scene["Ks"].expand(2, 3, 3))
    for index, view in enumerate(views):
        one_colors, one_alphas, one_info = render(scene | view)
        assert_within(colors[index], one_colors[0], 1e-14)
        assert_within(alphas[index], one_alphas[0], 1e-14)
        assert torch.equal(info["radii"][index], one_info["radii"][0])


class LargestTensor(TorchDispatchMode):
    """Records the number of elements of the largest tensor that any operation returns."""

    elements = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = func(*args, **(kwargs or {}))
        for value in result if isinstance(result, (tuple, list)) else [result]:
            # Views own no memory.
            if isinstance(value, Tensor) and value._base is None:
                self.elements = max(self.elements, value.numel())
        return result


def test_no_tensor_grows_with_the_number_of_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(backend_torch, "_CHUNK_PAIRS", 1 << 14)
    monkeypatch.setattr(backend_torch, "_SEGMENT", 32)
    scene: dict[str, Any] = {name: value.float() for name, value in random_scene(1500, 64, seed=0).items()}
    del scene["weights"]
    scene["colors"] = scene["colors"][:, 0].contiguous()
    scene["scales"] = 2.0 * scene["scales"]
    scene["opacities"] = 0.05 * scene["opacities"]  # transparent, so that no tile stops early
    scene["means"].requires_grad_()
    with LargestTensor() as largest:
        colors, _, info = render(scene, width=64, height=64, absgrad=True, per_axis_radii=False)
        colors.square().mean().backward()
    assert len(info["flatten_ids"]) * 16**2 > 100 * backend_torch._CHUNK_PAIRS
    # A chunk has up to `_CHUNK_PAIRS` pairs, and one element more per pixel where transmittances are kept.
    assert largest.elements <= backend_torch._CHUNK_PAIRS * (1 + 1 / 32)


class Operations(TorchDispatchMode):
    """Counts torch's operations."""

    number = 0

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.number += 1
        return func(*args, **(kwargs or {}))


def test_work_grows_with_the_tiles_that_are_reached_and_not_with_gaussians_times_tiles() -> None:
    """3,000 Gaussians, forward and backward, in some 6,000 operations on some 14,000 of 192,000 pairs."""
    scene: dict[str, Any] = {
        name: value.float().requires_grad_() for name, value in random_scene(3000, 128, seed=0).items()
    }
    weights = scene.pop("weights")
    with Operations() as operations:
        colors, _, info = render(scene, width=128, height=128, sh_degree=3, absgrad=True)
        (weights * colors.square()).mean().backward()
    assert 10_000 < len(info["flatten_ids"]) < 20_000
    assert operations.number < 9_000
