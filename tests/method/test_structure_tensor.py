"""Image → S̄: gratings of known wavelength and orientation, exposure, borders, masks, and a float64 reference."""

from __future__ import annotations

import math
from functools import partial

import pytest
import torch
from scipy import ndimage
from torch import Tensor
from torch.testing import assert_close

from helpers.closeness import assert_within
from helpers.generators import seeded
from sadgs_ns.method.eta import wavelength
from sadgs_ns.method.structure_tensor import NOISE_FLOOR, NUM_LEVELS, gaussian_kernel, multiscale_structure_tensor

PERIOD_CONSTANT = 1 / (2 * math.pi)
"""With this c the wavelength reads as a period: a blur of σ px is a quarter-turn-per-radian low-pass at 2πσ px."""

unit_tensor = partial(multiscale_structure_tensor, frequency_constant=1.0)
"""S̄ in units of c², so that no test depends on the constant that the sweeps chose."""


def grating(period: float, angle: float = 0.0, size: int = 128, amplitude: float = 0.5, offset: float = 0.5) -> Tensor:
    """Grey sine grating. [1, size, size, 3]"""
    y, x = torch.meshgrid(torch.arange(size) + 0.5, torch.arange(size) + 0.5, indexing="ij")
    phase = 2 * math.pi / period * (x * math.cos(angle) + y * math.sin(angle))
    return (offset + amplitude * torch.sin(phase))[None, ..., None].expand(-1, -1, -1, 3).contiguous()


def relative_change(tensor: Tensor, reference: Tensor) -> float:
    """Average relative change of the tensor map, as in the paper's supplement."""
    return float((tensor - reference).norm(dim=-1).mean() / reference.norm(dim=-1).mean())


def reference_structure_tensor(
    image: Tensor, gamma: float = 3.0, energy_blur: float = 2.0, epsilon: float | None = None
) -> Tensor:
    """Eq. 2–5 for the interior of one float64 image [H, W, C], level by level with scipy's filters. [H, W, 3]"""
    array = image.double().numpy()
    if epsilon is None:
        array = array / abs(array).max()
    contrast = math.sqrt((array - array.mean((0, 1))).var(axis=(0, 1)).sum())
    noise = max(NOISE_FLOOR * contrast, 1e-5)
    numerator = 0.0
    denominator = noise**gamma if epsilon is None else epsilon
    previous = array

    def blur(values, sigma, order=""):  # scipy's taps: truncated where ours are
        radius = math.ceil(3 * sigma)
        taps_0 = gaussian_kernel(sigma, 0, torch.float64).numpy()
        taps_1 = gaussian_kernel(sigma, 1, torch.float64).numpy()
        assert len(taps_0) == 2 * radius + 1
        along_x = taps_1 if order == "x" else taps_0
        along_y = taps_1 if order == "y" else taps_0
        values = ndimage.correlate1d(values, along_y, axis=0, mode="constant")
        return ndimage.correlate1d(values, along_x, axis=1, mode="constant")

    for level in range(NUM_LEVELS):
        sigma = 1.5**level
        smoothed = blur(array, sigma)
        g_x = blur(array, sigma, "x")
        g_y = blur(array, sigma, "y")
        xx = blur((g_x * g_x).sum(-1), 3 * sigma)
        xy = blur((g_x * g_y).sum(-1), 3 * sigma)
        yy = blur((g_y * g_y).sum(-1), 3 * sigma)
        energy = blur(((previous - smoothed) ** 2).sum(-1), energy_blur * sigma) ** (gamma / 2)
        scale = energy / sigma**2 / (xx + yy + ((noise / sigma) ** 2 if epsilon is None else epsilon))
        numerator = numerator + torch.stack([torch.from_numpy(scale * s) for s in (xx, xy, yy)], -1)
        denominator = denominator + energy
        previous = smoothed
    return numerator / torch.from_numpy(denominator)[..., None]


@pytest.mark.parametrize("epsilon", [None, 1e-6, 1e-2])
def test_agrees_with_the_float64_reference_in_the_interior(epsilon: float | None):
    generator = seeded(0)
    image = torch.rand((160, 170, 3), generator=generator, dtype=torch.float64)
    image = image + grating(9.0, 0.4, 170)[0, :160].double()  # texture over noise
    image = 0.7 * image  # the brightest value is not 1
    expected = reference_structure_tensor(image, epsilon=epsilon)
    interior = (slice(70, -70), slice(70, -70))  # beyond the reach of the largest kernels, where borders play no part
    for dtype, tolerance in ((torch.float64, 1e-9), (torch.float32, 2e-5)):
        # The reference does not centre the image, so its own contrast is used for both.
        actual = unit_tensor(image[None].to(dtype), epsilon=epsilon)[0].double()
        assert_close(actual[interior], expected[interior], rtol=tolerance, atol=tolerance)


def test_an_absolute_epsilon_makes_the_wavelength_depend_on_contrast():
    """As the paper prints it, ε hides a faint texture: at an amplitude of 0.01, E_l^3 is below 1e-6."""
    period = {
        (amplitude, epsilon): float(wavelength(unit_tensor(grating(8.0, amplitude=amplitude), epsilon=epsilon)).mean())
        for amplitude in (0.5, 0.01)
        for epsilon in (None, 1e-6)
    }
    assert period[0.01, None] == pytest.approx(period[0.5, None], rel=1e-3)
    assert period[0.5, 1e-6] == pytest.approx(period[0.5, None], rel=0.05)
    assert period[0.01, 1e-6] > 1.5 * period[0.5, 1e-6]


@pytest.mark.parametrize("scale", [0.0, 1e-30, 1e-12, 1e9, 1e30])
def test_an_absolute_epsilon_keeps_every_exposure_finite(scale: float):
    tensor = unit_tensor(scale * grating(8.0), epsilon=1e-6)
    assert tensor.isfinite().all()
    assert (tensor[..., 0] + tensor[..., 2] <= 1 + 1e-5).all()
    flat = unit_tensor(torch.full((1, 20, 20, 3), scale), epsilon=1e-6)
    assert flat.isfinite().all()


@pytest.mark.parametrize("epsilon", [0.0, -1.0, math.nan])
def test_an_epsilon_that_is_not_positive_is_refused(epsilon: float):
    with pytest.raises(ValueError, match="epsilon must be positive, or None"):
        unit_tensor(grating(8.0), epsilon=epsilon)


@pytest.mark.parametrize("period", [4.0, 6.0, 8.0, 12.0, 16.0, 24.0, 32.0])
def test_wavelength_of_a_grating_follows_its_period(period: float):
    tensor = multiscale_structure_tensor(grating(period, size=192), frequency_constant=PERIOD_CONSTANT)
    estimate = wavelength(tensor[0, 64:128, 64:128])
    assert 0.8 * period < estimate.min()
    assert estimate.max() < 1.7 * period
    assert estimate.max() < 1.12 * estimate.min(), "the estimate must not follow the phase of the texture"


def test_wavelength_grows_with_the_period():
    periods = (3.0, 5.0, 9.0, 14.0, 22.0, 34.0)
    estimates = [float(wavelength(unit_tensor(grating(p, size=192))[0, 96, 96])) for p in periods]
    assert estimates == sorted(estimates)
    assert estimates[-1] > 4 * estimates[0]


@pytest.mark.parametrize("degrees", [0, 10, 22.5, 45, 60, 90, 135])
@pytest.mark.parametrize("period", [3.5, 8.0, 20.0])
def test_principal_direction_is_the_grating_s(degrees: float, period: float):
    xx, xy, yy = unit_tensor(grating(period, math.radians(degrees)))[0, 64, 64].tolist()
    measured = 0.5 * math.degrees(math.atan2(2 * xy, xx - yy)) % 180
    assert min(abs(measured - degrees % 180), 180 - abs(measured - degrees % 180)) < 1.0


def test_channels_are_summed_after_di_zenzo():
    """Two channels with opposite gradients cancel in a grey image, not in the structure tensor."""
    image = grating(8.0)
    image[..., 1] = 1 - image[..., 0]
    image[..., 2] = 0.5
    grey = unit_tensor(grating(8.0))
    assert_close(unit_tensor(image), grey, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("amplitude", [0.5, 0.05, 0.01])
def test_exposure_changes_less_than_the_supplement_allows(amplitude: float):
    generator = seeded(1)
    texture = grating(7.0, 0.3, amplitude=1.0, offset=0.0) + grating(19.0, 1.2, amplitude=1.0, offset=0.0)
    texture = texture + 0.2 * torch.randn(texture.shape, generator=generator)
    image = 0.5 + amplitude * texture / texture.abs().max()
    base = unit_tensor(image)
    assert base.abs().mean() > 0.05, "the texture must be seen at all"
    assert relative_change(unit_tensor(0.5 * image), base) <= 0.05
    assert relative_change(unit_tensor(1.5 * image), base) <= 0.08
    assert relative_change(unit_tensor((1.5 * image).clamp(max=1.0)), base) <= 0.08 or amplitude > 0.2


def test_wavelength_does_not_depend_on_contrast():
    strong = unit_tensor(grating(8.0, amplitude=0.5))
    weak = unit_tensor(grating(8.0, amplitude=0.005))
    assert relative_change(weak, strong) < 1e-3


def test_a_constant_image_has_no_structure():
    for value in (0.0, 0.7, 1e4):
        assert unit_tensor(torch.full((1, 40, 50, 3), value)).abs().max() < 1e-6


@pytest.mark.parametrize("size", [(1, 1), (1, 7), (7, 1), (2, 3), (9, 40), (33, 15)])
def test_images_smaller_than_the_kernels(size: tuple[int, int]):
    image = torch.rand((2, *size, 3), generator=seeded(2))
    tensor = unit_tensor(image)
    xx, xy, yy = tensor.unbind(-1)
    assert tensor.shape == (2, *size, 3)
    assert tensor.isfinite().all()
    assert (xx * yy - xy * xy).min() >= -1e-6
    assert (xx + yy).max() <= 1 + 1e-5


def test_the_border_adds_no_structure():
    """A grating cut anywhere keeps its direction and wavelength up to the border."""
    tensor = unit_tensor(grating(8.0, 0.0))[0]
    assert tensor[:, :, 2].max() < 0.02 * tensor[:, :, 0].max(), "no vertical structure at the upper and lower border"
    assert wavelength(tensor).max() < 1.35 * wavelength(tensor[64, 64])


def test_flips_and_quarter_turns_are_exact():
    image = torch.rand((1, 37, 52, 3), generator=seeded(3), dtype=torch.float64)
    tensor = unit_tensor(image)
    flipped = unit_tensor(image.flip(2)).flip(2)
    actual = flipped * torch.tensor([1.0, -1.0, 1.0])
    assert_within(actual, tensor, 1e-12)
    turned = unit_tensor(image.rot90(1, (1, 2))).rot90(-1, (1, 2))
    actual = turned.flip(-1) * torch.tensor([1.0, -1.0, 1.0])
    assert_within(actual, tensor, 1e-12)


def test_a_mask_makes_no_edge_and_no_difference_far_from_it():
    """Valid pixels do not see what lies under the mask: black there or anything else, the result is the same."""
    image = grating(8.0, 0.0)
    mask = torch.ones(1, 128, 128, dtype=torch.bool)
    mask[:, 40:90, 50:80] = False
    painted = torch.where(mask[..., None], image, 0.0)
    masked = unit_tensor(painted, mask)
    expected = unit_tensor(image, mask)
    assert_close(masked, expected, rtol=0, atol=0, equal_nan=True)
    assert masked[~mask].isnan().all()
    assert masked[mask].isfinite().all()
    plain = unit_tensor(image)
    assert relative_change(masked[mask], plain[mask]) < 0.05
    edge = unit_tensor(painted)[mask][:, 2].max()  # yy, which a vertical grating does not have
    assert edge > 0.3
    assert masked[mask][:, 2].max() < 0.05 * edge


def test_batch_equals_one_by_one_and_a_full_mask_equals_none():
    images = torch.rand((3, 30, 41, 3), generator=seeded(4))
    batch = unit_tensor(images)
    for image, tensor in zip(images, batch, strict=True):
        actual = unit_tensor(image[None])[0]
        assert_close(actual, tensor, rtol=1e-5, atol=1e-6)
    full = torch.ones(images.shape[:3], dtype=torch.bool)
    actual = unit_tensor(images, full)
    assert_close(actual, batch, rtol=1e-4, atol=1e-5)


def test_energy_window_removes_the_zero_crossings_of_eq_4():
    """With E_l per pixel, S̄ of a fine grating falls to nothing where the band passes through zero."""
    image = grating(3.0, size=96)
    per_pixel = wavelength(unit_tensor(image, energy_blur=0.0)[0, 32:64, 32:64])
    windowed = wavelength(unit_tensor(image, energy_blur=2.0)[0, 32:64, 32:64])
    assert per_pixel.max() > 1000 * per_pixel.min()
    assert windowed.max() < 1.05 * windowed.min()


def test_derivative_kernel_is_exact_on_ramps():
    for sigma in (1.0, 2.25, 5.0625):
        kernel = gaussian_kernel(sigma, order=1, dtype=torch.float64)
        position = torch.arange(len(kernel), dtype=torch.float64) - len(kernel) // 2
        assert abs(float((kernel * position).sum()) - 1) < 1e-12
        assert abs(float(kernel.sum())) < 1e-12


def test_wrong_shapes_are_named():
    with pytest.raises(ValueError, match=r"floating point \[B, H, W, C\]"):
        unit_tensor(torch.zeros((4, 4, 3)))
    with pytest.raises(ValueError, match=r"masks must be \[B, H, W\]"):
        unit_tensor(torch.zeros((1, 4, 4, 3)), torch.ones((1, 4, 5), dtype=torch.bool))
