"""η at Gaussians: eq. 1 against finite differences, eq. 6 and 7 against brute force over the footprint."""

from __future__ import annotations

import math

import pytest
import torch
from gsplat.cuda._torch_impl import _persp_proj, _quat_scale_to_covar_preci, _world_to_cam
from torch import Tensor
from torch.testing import assert_close

from helpers.closeness import assert_within, assert_within_share
from helpers.generators import seeded
from helpers.small_scenes import camera, random_params
from sadgs_ns.gsplat_compat import SCREEN_BLUR
from sadgs_ns.method.eta import (
    eta,
    principal_eigenvalue,
    projected_axes,
    sample_footprint,
    sample_map,
    wavelength,
)
from sadgs_ns.method.quantization import quantize
from sadgs_ns.method.structure_tensor import multiscale_structure_tensor

WIDTH = 64
HEIGHT = 48


def view(n: int, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor]:
    """A camera that is neither at the origin nor axis-aligned, once per Gaussian."""
    viewmat, K = camera(WIDTH, HEIGHT, dtype=dtype)
    angle = 0.3
    rotation = torch.tensor(
        [[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]], dtype=dtype
    )
    viewmat = viewmat.clone()
    viewmat[0, :3, :3] = rotation
    viewmat[0, :3, 3] = torch.tensor([0.3, -0.2, 0.5], dtype=dtype)
    K = K.clone()
    K[0, 1, 1] *= 1.2
    return viewmat.expand(n, 4, 4), K.expand(n, 3, 3)


def axes_of(params, n: int) -> Tensor:
    viewmats, Ks = view(n)
    return projected_axes(
        params["means"].detach(), params["quats"].detach(), params["scales"].detach().exp(), viewmats, Ks, WIDTH, HEIGHT
    )


def test_projected_axes_are_the_derivative_of_the_projection():
    """Eq. 1: v_k is where the axis's tip moves on the screen, per unit, for an infinitely small Gaussian."""
    n = 20
    step = 1e-6
    params = random_params(n, dtype=torch.float64)
    viewmats, Ks = view(n)
    axes = axes_of(params, n)
    quats = params["quats"].detach()
    scales = params["scales"].detach().exp()
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True)).unbind(-1)
    columns = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], -1),
        torch.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], -1),
        torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], -1),
    ]

    def project(points: Tensor) -> Tensor:
        local = torch.einsum("mij,mj->mi", viewmats[:, :3, :3], points) + viewmats[:, :3, 3]
        return torch.einsum("mij,mj->mi", Ks, local / local[:, 2:])[:, :2]

    for k, direction in enumerate(columns):
        tip = step * scales[:, k, None] * direction
        means = params["means"].detach()
        moved = (project(means + tip) - project(means - tip)) / (2 * step)
        actual = axes[:, k]
        assert_close(actual, moved, rtol=1e-6, atol=1e-7)


def test_projected_axes_span_gsplat_s_2d_covariance():
    """Σ_k v_k v_kᵀ is the covariance that the forward pass rasterizes, clamp at the frustum's border included."""
    n = 50
    params = random_params(n, dtype=torch.float64)
    params["means"].data[:10, 0] += 8.0  # far outside the image, where the clamp acts
    viewmats, Ks = view(n)
    axes = axes_of(params, n)
    covars, _ = _quat_scale_to_covar_preci(
        torch.nn.functional.normalize(params["quats"].detach(), dim=-1), params["scales"].detach().exp(), True, False
    )
    assert covars is not None
    means_c, covars_c = _world_to_cam(params["means"].detach(), covars, viewmats[:1])
    _, expected = _persp_proj(means_c, covars_c, Ks[:1], WIDTH, HEIGHT)
    actual = axes.transpose(1, 2) @ axes
    assert_close(actual, expected[0], rtol=1e-9, atol=1e-9)


def test_principal_eigenvalue_is_torch_s():
    generator = seeded(0)
    a = torch.rand((100, 2, 2), generator=generator, dtype=torch.float64)
    matrix = a @ a.mT
    packed = torch.stack([matrix[:, 0, 0], matrix[:, 0, 1], matrix[:, 1, 1]], -1)
    expected = torch.linalg.eigvalsh(matrix)[:, 1]
    assert_close(principal_eigenvalue(packed), expected)


@pytest.mark.parametrize("difference", [0.0, 1e-12, 1e-7, 1e-4])
def test_principal_eigenvalue_is_stable_near_isotropy(difference: float):
    tensor = torch.tensor([1.0 + difference, 0.0, 1.0], dtype=torch.float32)
    assert abs(float(principal_eigenvalue(tensor)) - (1.0 + difference)) < 2e-7


def test_wavelength_is_finite_without_texture():
    assert float(wavelength(torch.zeros(3))) == pytest.approx(1e5)
    actual = float(wavelength(torch.tensor([0.25, 0.0, 0.0])))
    expected = pytest.approx(2.0, rel=1e-4)
    assert actual == expected


def test_footprint_samples_have_the_gaussian_s_mean_and_covariance():
    """gsplat's conic holds 0.3 px² of blur; the samples must not."""
    covariance = torch.tensor([[9.0, 4.0], [4.0, 6.0]])
    inverse = torch.linalg.inv(covariance + SCREEN_BLUR * torch.eye(2))
    conics = torch.stack([inverse[0, 0], inverse[0, 1], inverse[1, 1]]).expand(200_000, 3)
    points = sample_footprint(
        torch.tensor([20.0, 30.0]).expand(200_000, 2),
        conics,
        torch.rand((200_000, 2), generator=seeded(0)),
    )
    actual = points.mean(0)
    expected = torch.tensor([20.0, 30.0])
    assert_within(actual, expected, 0.03)
    actual = points.T.cov()
    assert_close(actual, covariance, rtol=0.02, atol=0.05)
    offset = points - torch.tensor([20.0, 30.0])
    distance = (offset @ torch.linalg.inv(covariance) * offset).sum(-1)
    assert distance.max() <= 4.001, "uniform in the 2σ ellipse, nothing outside"


def test_footprint_of_a_gaussian_thinner_than_the_blur_is_a_line_or_a_point():
    conics = torch.tensor([[1 / (4.0 + SCREEN_BLUR), 0.0, 1 / SCREEN_BLUR], [1 / SCREEN_BLUR, 0.0, 1 / SCREEN_BLUR]])
    points = sample_footprint(torch.zeros(2, 2), conics, torch.rand((2, 2), generator=seeded(0)))
    assert points.isfinite().all()
    assert abs(points[0, 1]) < 1e-2
    assert points[1].abs().max() < 1e-2


def test_points_outside_the_image_are_no_observation():
    tensors = torch.ones(2, HEIGHT, WIDTH, 3, dtype=torch.float16)
    points = torch.tensor([[0.0, 0.0], [-0.01, 5.0], [WIDTH - 0.01, HEIGHT - 0.01], [WIDTH, 3.0], [float("nan"), 1.0]])
    values, inside = sample_map(tensors, torch.tensor([0, 1, 1, 0, 0]), points)
    assert inside.tolist() == [True, False, True, False, False]
    assert values.dtype == torch.float32
    assert values[inside].eq(1).all()
    assert values[~inside].eq(0).all()


@pytest.mark.hard_case("a sample on a masked pixel of S̄", "no observation")
@pytest.mark.parametrize("kept", [Tensor.half, quantize], ids=["float16", "8 bits"])
def test_points_on_masked_pixels_are_no_observation(kept):
    """Left half masked: points there are as unknown as those outside the image, and a smooth pixel is known to be."""
    masks = torch.ones((1, HEIGHT, WIDTH), dtype=torch.bool)
    masks[:, :, : WIDTH // 2] = False
    tensors = kept(multiscale_structure_tensor(torch.full((1, HEIGHT, WIDTH, 3), 0.5), masks))
    points = torch.tensor([[WIDTH / 2 - 0.1, 5.0], [WIDTH / 2 + 0.1, 5.0], [WIDTH + 0.1, 5.0]])
    values, known = sample_map(tensors, torch.zeros(3, dtype=torch.long), points)
    assert known.tolist() == [False, True, False]
    assert values.eq(0).all()


def test_eta_equals_the_brute_force_footprint_average():
    """Over many samples, λ_1 of the mean sampled tensor is that of S̄ averaged over the ellipse's pixels."""
    y, x = torch.meshgrid(torch.arange(96) + 0.5, torch.arange(96) + 0.5, indexing="ij")
    image = (0.5 + 0.4 * torch.sin(x * (0.5 + x / 120)) * torch.cos(y / 3))[None, ..., None].expand(1, 96, 96, 3)
    tensors = multiscale_structure_tensor(image.contiguous())
    mean = torch.tensor([50.0, 44.0])
    covariance = torch.tensor([[60.0, 25.0], [25.0, 30.0]])
    offset = torch.stack([x, y], -1) - mean
    in_ellipse = (offset @ torch.linalg.inv(covariance) * offset).sum(-1) <= 4
    expected = tensors[0][in_ellipse].mean(0)
    inverse = torch.linalg.inv(covariance + SCREEN_BLUR * torch.eye(2))
    n = 40_000
    conics = torch.stack([inverse[0, 0], inverse[0, 1], inverse[1, 1]]).expand(n, 3)
    points = sample_footprint(mean.expand(n, 2), conics, torch.rand((n, 2), generator=seeded(1)))
    sampled, inside = sample_map(tensors, torch.zeros(n, dtype=torch.long), points)
    assert inside.all()
    axes = torch.tensor([[[3.0, 0.0], [0.0, 4.0], [1.0, 1.0]]])
    actual = eta(axes, sampled.mean(0)[None])
    assert_within_share(actual, eta(axes, expected[None]), 0.02)


def test_eta_compares_the_axis_with_the_wavelength():
    """A grating along x: every axis is held against the one wavelength."""
    tensor = torch.tensor([[0.25, 0.0, 0.0]])  # Λ = 2 px along x
    axes = torch.tensor([[[4.0, 0.0], [0.0, 4.0], [3.0, 4.0]]])
    actual = eta(axes, tensor)
    expected = torch.tensor([[2.0, 2.0, 2.5]])
    assert_within_share(actual, expected, 1e-4)
