"""Hard cases of the frequency analysis: S̄ stays finite, semidefinite and bounded on any image.

S̄ is given in units of c², so its trace is at most 1.
"""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from torch import Tensor
from torch.testing import assert_close

from helpers.closeness import assert_within, assert_within_share
from helpers.generators import seeded
from sadgs_ns.method.eta import principal_eigenvalue, wavelength
from sadgs_ns.method.structure_tensor import multiscale_structure_tensor
from sadgs_ns.training.model import SadgsModel

unit_tensor = partial(multiscale_structure_tensor, frequency_constant=1.0)
"""S̄ in units of c²: its trace is at most 1."""

reproducible = partial(settings, derandomize=True, deadline=None, database=None)
DTYPES = [torch.float16, torch.bfloat16, torch.float32, torch.float64]
SIGNS = torch.tensor([1.0, -1.0, 1.0])
"""What a flip or a quarter turn does to (xx, xy, yy), besides exchanging xx and yy."""


def grating(period: float, degrees: float = 0.0, size: int = 96) -> Tensor:
    """Grey sine grating of one channel. [1, size, size, 1]"""
    y, x = torch.meshgrid(torch.arange(size) + 0.5, torch.arange(size) + 0.5, indexing="ij")
    angle = math.radians(degrees)
    return (0.5 + 0.5 * torch.sin(2 * math.pi / period * (x * math.cos(angle) + y * math.sin(angle))))[None, ..., None]


def noise(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(shape, generator=seeded(seed))


def central(tensor: Tensor) -> Tensor:
    """Mean of the central 16×16 px, where borders play a small part. [3]"""
    height, width = tensor.shape[1:3]
    return tensor[0, height // 2 - 8 : height // 2 + 8, width // 2 - 8 : width // 2 + 8].mean((0, 1))


def degrees_of(tensor: Tensor) -> float:
    xx, xy, yy = tensor.tolist()
    return 0.5 * math.degrees(math.atan2(2 * xy, xx - yy)) % 180


def apart(a: float, b: float) -> float:
    """Between two axes, in degrees."""
    return abs((a - b + 90) % 180 - 90)


def assert_sound(tensor: Tensor, mask: Tensor | None = None) -> None:
    """NaN at masked pixels; finite elsewhere, positive semidefinite up to rounding, with a trace of at most c² = 1."""
    if mask is not None:
        assert tensor[~mask].isnan().all()
        tensor = tensor[mask]
    if len(tensor) == 0:
        return
    assert tensor.isfinite().all()
    xx, xy, yy = tensor.double().unbind(-1)
    smaller = 0.5 * (xx + yy) - torch.hypot(0.5 * (xx - yy), xy)
    assert (xx >= 0).all()
    assert (yy >= 0).all()
    assert (smaller >= -1e-6 * (xx + yy)).all()
    assert (xx + yy).max() <= 1 + 1e-5


# --- single images ---


@pytest.mark.hard_case("a constant image, 0 to 10⁴, every dtype", "S̄ is exactly 0, the wavelength 10⁵ px")
@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("value", [0.0, 1 / 255, 0.7, 1e4])
def test_a_constant_image_has_exactly_no_structure(dtype: torch.dtype, value: float):
    tensor = unit_tensor(torch.full((1, 33, 50, 3), value, dtype=dtype))
    assert tensor.eq(0).all()
    assert wavelength(tensor).min() == pytest.approx(1e5)


@pytest.mark.hard_case(
    "a line of one pixel", "the shortest wavelength, strongest on the line; the direction is exactly across it"
)
def test_a_line_of_one_pixel_is_the_shortest_wavelength_and_points_across():
    image = torch.zeros(1, 65, 65, 3)
    image[:, :, 32] = 1.0
    tensor = unit_tensor(image)
    assert_sound(tensor)
    assert tensor[0, 32, 32, 0] > 0.98
    assert tensor[..., 2].max() < 1e-6
    assert (tensor[0, 32, 32, 0] >= tensor[0, 32, :, 0]).all(), "strongest on the line"


@pytest.mark.hard_case(
    "stripes or a checkerboard at Nyquist (a period of exactly 2 px)",
    "**read as no texture**: a symmetric derivative is 0 there",
)
@pytest.mark.parametrize("pattern", ["stripes", "checkerboard"])
def test_texture_at_the_nyquist_frequency_is_invisible(pattern: str):
    """A symmetric derivative has no answer at a period of exactly 2 px; it reads as no texture, not as garbage."""
    x = torch.arange(64)
    values = (x + (x[:, None] if pattern == "checkerboard" else 0 * x[:, None])) % 2
    tensor = unit_tensor(values.float()[None, ..., None])
    assert_sound(tensor)
    assert tensor[0, 28:36, 28:36].max() < 1e-6
    assert wavelength(tensor[0, 32, 32]) > 1e4


@pytest.mark.hard_case(
    "a period of 2.1 px", "is seen, at up to twice the wavelength of period 3; 2.2 px is within 20 %"
)
def test_texture_just_below_the_nyquist_frequency_is_seen():
    period_3 = wavelength(central(unit_tensor(grating(3.0))))
    assert wavelength(central(unit_tensor(grating(2.1)))) < 2 * period_3
    assert wavelength(central(unit_tensor(grating(2.2)))) < 1.2 * period_3


@pytest.mark.hard_case("amplitudes of 1/255 to HDR 10⁴, and of 10⁻³⁷ to 10³⁸", "the same S̄ within 10⁻⁶")
@pytest.mark.parametrize("scale", [1e-37, 1 / 255, 1.0, 1e4, 1e38])
def test_amplitude_from_one_grey_level_to_hdr_changes_nothing(scale: float):
    image = noise(1, 40, 50, 3)
    actual = unit_tensor(scale * image)
    assert_within(actual, unit_tensor(image), 1e-6)


@pytest.mark.hard_case("two neighbouring grey levels of 8 bits", "the same S̄ as in black and white")
def test_one_grey_level_of_difference_is_a_texture():
    """An 8-bit image of only two neighbouring grey levels reads as the same pattern in black and white."""
    pattern = (grating(8.0) > 0.5).float()
    levels = (128 + pattern) / 255
    assert_within(unit_tensor(levels), unit_tensor(pattern), 2e-3)


@pytest.mark.hard_case(
    "one pixel of 10⁴ in an image of [0, 1]",
    "its surroundings keep their structure, **the rest fades**: ε is relative to the image's contrast",
)
def test_one_hdr_pixel_makes_the_rest_of_the_image_fade():
    """ε is relative to the image's contrast, which one pixel of 10⁴ dominates; away from it nothing is left."""
    image = noise(1, 96, 96, 3)
    image[0, 5, 5] = 1e4
    tensor = unit_tensor(image)
    assert_sound(tensor)
    assert tensor[0, 5, 5].sum() > 0.5
    assert tensor[0, 80:, 80:].max() < 1e-3


@pytest.mark.hard_case(
    "contrast 1 on a pedestal of 100, and of 10⁶",
    "is seen; fades to 0 (under 10⁻⁵ of the brightest pixel only rounding is left)",
)
def test_structure_on_a_pedestal_fades_only_where_float32_loses_it():
    image = noise(1, 40, 50, 3)
    assert unit_tensor(image + 100)[..., 0].min() > 0.25
    drowned = unit_tensor(image + 1e6)
    assert_sound(drowned)
    assert drowned.max() < 1e-6


@pytest.mark.hard_case("white noise", "a short wavelength, nearly isotropic")
def test_noise_is_short_and_nearly_isotropic():
    tensor = unit_tensor(noise(1, 96, 96, 3))
    assert_sound(tensor)
    mean = tensor.mean((0, 1, 2))
    assert abs(float(mean[0] - mean[2])) < 0.05
    assert abs(float(mean[1])) < 0.05
    assert mean[[0, 2]].sum() > 0.95


# --- sizes, masks, alpha, what is not finite ---


@pytest.mark.hard_case(
    "images of 1×1, 1×N and N×1 pixels, smaller than the kernels, of odd sizes",
    "S̄ is sound, and transposed with the image; 1×1 is 0",
)
@pytest.mark.parametrize("height", [1, 2, 5])
@pytest.mark.parametrize("width", [1, 2, 3, 31, 300])
def test_images_of_any_size(height: int, width: int):
    image = noise(2, height, width, 3)
    tensor = unit_tensor(image)
    assert_sound(tensor)
    actual = unit_tensor(image.transpose(1, 2)).transpose(1, 2).flip(-1)
    assert_within(actual, tensor, 1e-6)
    assert height * width > 1 or tensor.eq(0).all()


@pytest.mark.hard_case("one row of a grating", "reads as the whole grating does, within 10⁻⁴")
def test_a_single_row_reads_a_grating_as_a_whole_image_does():
    whole = unit_tensor(grating(9.0, size=192))[:, 96:97, 60:130, 0]
    row = unit_tensor(grating(9.0, size=192)[:, 96:97])[..., 60:130, :]
    assert row[..., 1:].abs().max() < 1e-6
    actual = row[..., 0]
    assert_within_share(actual, whole, 1e-4)


@pytest.mark.hard_case("a mask with 0, 1 or 2 distant valid pixels", "S̄ = 0 there, NaN at masked pixels")
@pytest.mark.parametrize("valid", [0, 1, 2])
def test_masks_that_leave_almost_nothing(valid: int):
    """Nothing, one pixel, or two that no kernel connects: no pair of pixels, no structure."""
    mask = torch.zeros(1, 64, 80, dtype=torch.bool)
    mask[0, 10, 10] = valid > 0
    mask[0, 60, 75] = valid > 1
    tensor = unit_tensor(noise(1, 64, 80, 3), mask)
    assert tensor[mask].eq(0).all()
    assert tensor[~mask].isnan().all()


@pytest.mark.hard_case("NaN, ±inf or 3·10³⁸ under a mask", "bitwise the same S̄ as without")
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 3e38])
def test_what_lies_under_a_mask_does_not_matter(value: float):
    image = noise(1, 40, 50, 3)
    mask = noise(1, 40, 50, seed=1) > 0.3
    painted = torch.where(mask[..., None], image, value)
    expected = unit_tensor(image, mask)
    actual = unit_tensor(painted, mask)
    assert_close(actual, expected, rtol=0, atol=0, equal_nan=True)
    assert_sound(expected, mask)


@pytest.mark.hard_case("alpha", "is composited first: hidden colours leave no trace, the outline is an edge")
def test_transparent_pixels_are_the_background():
    """Alpha is composited before S̄: hidden colours leave no trace, and the outline is an edge, as it is rendered."""
    alpha = torch.zeros(1, 96, 96, 1)
    alpha[:, :, :40] = 1.0
    composite = partial(SadgsModel.composite_with_background, None)  # type: ignore[arg-type]  # no model is read
    hidden = torch.where(alpha > 0, 0.5, noise(1, 96, 96, 3))
    tensor = unit_tensor(composite(torch.cat([hidden, alpha], -1), torch.ones(3)))
    edge = torch.where(alpha > 0, 0.5, torch.ones(1, 96, 96, 3))
    assert torch.equal(tensor, unit_tensor(edge))
    assert tensor[0, 48, 40, 0] > 0.1
    assert tensor[..., 2].max() < 1e-6


@pytest.mark.hard_case("NaN or ±inf in a valid pixel", "ValueError with the image's index")
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_pixels_that_are_not_finite_are_refused_by_image(value: float):
    images = noise(3, 20, 20, 3)
    images[1, 7, 3, 2] = value
    with pytest.raises(ValueError, match=r"images \[1\] of the batch hold NaN or infinite pixels"):
        unit_tensor(images)


@pytest.mark.hard_case("no pixels, no channels, no images", "ValueError")
@pytest.mark.parametrize("shape", [(1, 0, 5, 3), (1, 5, 0, 3), (1, 5, 5, 0), (0, 5, 5, 3)], ids=str)
def test_empty_images_are_refused(shape: tuple[int, ...]):
    with pytest.raises(ValueError, match="images must have pixels and channels"):
        unit_tensor(torch.zeros(shape))


# --- precision ---


@pytest.mark.hard_case(
    "float32, float16 and bfloat16 images against float64",
    "computing adds 3·10⁻⁷; rounding the image before it 8·10⁻⁵ (float16) and 4·10⁻⁴ (bfloat16) on the test image",
)
@pytest.mark.parametrize(
    ("dtype", "computed", "rounded"),
    [(torch.float32, 1e-6, 1e-6), (torch.float16, 1e-6, 2e-4), (torch.bfloat16, 1e-6, 2e-3)],
    ids=str,
)
def test_each_dtype_agrees_with_float64(dtype: torch.dtype, computed: float, rounded: float):
    """`computed`: error of the computation. `rounded`: with that of rounding the image to the dtype before it."""
    image = (0.5 * grating(7.0, 20, size=80) + 0.5 * noise(1, 80, 80, 3)).double()
    given_image = image.to(dtype)
    tensor = unit_tensor(given_image)
    assert tensor.dtype == torch.float32
    assert (tensor - unit_tensor(given_image.double())).abs().max() < computed
    assert (tensor - unit_tensor(image)).abs().max() < rounded


# --- equivariance ---


@pytest.mark.hard_case("gratings every 5°", "wavelength within 1 % (measured: 0.3 %), direction within 0.5° (0.13°)")
@pytest.mark.parametrize("period", [3.0, 7.0, 16.0])
def test_gratings_at_every_angle(period: float):
    """5° apart: wavelength within 1 %, direction within 0.5°, although the pixels are a square grid."""
    tensors = {degrees: central(unit_tensor(grating(period, degrees, size=144))) for degrees in range(0, 180, 5)}
    wavelengths = torch.stack([wavelength(tensor) for tensor in tensors.values()])
    assert wavelengths.max() < 1.01 * wavelengths.min()
    assert max(apart(degrees_of(tensor), degrees) for degrees, tensor in tensors.items()) < 0.5


@pytest.mark.hard_case("a grating of any angle and any period of 2.5 to 16 px", "direction within 1°")
@reproducible(max_examples=20)
@given(period=st.floats(2.5, 16.0), degrees=st.floats(0.0, 180.0))
def test_direction_of_any_grating(period: float, degrees: float):
    assert apart(degrees_of(central(unit_tensor(grating(period, degrees)))), degrees) < 1.0


@pytest.mark.hard_case("periods of 2.3, 2.2 and 2.1 px", "direction within 1.5°, 3.5° and 9°")
@pytest.mark.parametrize(("period", "error"), [(2.1, 9.0), (2.2, 3.5), (2.3, 1.5)])
def test_directions_are_uncertain_near_the_nyquist_frequency(period: float, error: float):
    """There the sampled derivative is smaller along the pixels' axes than between them."""
    for degrees in range(0, 90, 15):
        assert apart(degrees_of(central(unit_tensor(grating(period, degrees)))), degrees) < error


@pytest.mark.hard_case(
    "a grating magnified 1.5 times, periods of 5 to 12 px",
    "the wavelength grows **1.3 to 1.7 times**, not exactly 1.5: the levels end at σ = 1 and 5 px",
)
@pytest.mark.parametrize("period", [5.0, 6.5, 8.0, 10.0, 12.0])
def test_a_magnified_grating_has_a_longer_wavelength(period: float):
    """Times 1.5, the step between levels: nearly that, for the levels end at σ = 1 and 5 px."""
    small = wavelength(central(unit_tensor(grating(period, 20, size=192))))
    large = wavelength(central(unit_tensor(grating(1.5 * period, 20, size=192))))
    assert 1.25 < large / small < 1.75


@pytest.mark.hard_case(
    "periods beyond the levels",
    "the wavelength saturates: periods under 5 px all read alike, and so do those over 48 px",
)
def test_wavelengths_saturate_beyond_the_levels():
    constant = 1 / (2 * math.pi)  # the wavelength then reads as a period
    shortest = 2 * math.pi
    longest = 2 * math.pi * 1.5**4
    for period, size in ((2.5, 96), (4.0, 96), (48.0, 256), (100.0, 256)):
        read = wavelength(central(multiscale_structure_tensor(grating(period, 20, size), frequency_constant=constant)))
        assert read == pytest.approx(shortest if period < 5 else longest, rel=0.12)


@pytest.mark.hard_case("flips and quarter turns, any size and mask", "exact (10⁻¹² in float64)")
@reproducible(max_examples=20)
@given(height=st.integers(1, 40), width=st.integers(1, 40), masked=st.booleans(), seed=st.integers(0, 1000))
def test_flips_and_quarter_turns_are_exact(height: int, width: int, masked: bool, seed: int):
    image = noise(1, height, width, 3, seed=seed).double()
    mask = noise(1, height, width, seed=seed + 1) > 0.2 if masked else torch.ones(1, height, width, dtype=torch.bool)
    tensor = unit_tensor(image, mask)
    for axis in (1, 2):
        flipped = unit_tensor(image.flip(axis), mask.flip(axis)).flip(axis)
        assert_close(flipped * SIGNS, tensor, rtol=0, atol=1e-12, equal_nan=True)
    turned = unit_tensor(image.rot90(1, (1, 2)), mask.rot90(1, (1, 2))).rot90(-1, (1, 2))
    actual = turned.flip(-1) * SIGNS
    assert_close(actual, tensor, rtol=0, atol=1e-12, equal_nan=True)


# --- nearly isotropic tensors ---


@pytest.mark.hard_case(
    "nearly isotropic tensors over 60 decades", "λ₁ within 3·10⁻⁷ in float32: neither of its two terms is negative"
)
@reproducible(max_examples=200)
@given(
    trace=st.floats(-30, 30).map(lambda exponent: 10.0**exponent),
    anisotropy=st.one_of(st.just(0.0), st.floats(-12, 0).map(lambda exponent: 10.0**exponent)),
    angle=st.floats(0, math.pi),
)
def test_the_eigenvalue_of_a_nearly_isotropic_tensor_does_not_cancel(trace: float, anisotropy: float, angle: float):
    """In float32, against float64 of the same float32 numbers, over 60 decades."""
    half = 0.5 * trace
    along = anisotropy * half * math.cos(2 * angle)
    across = anisotropy * half * math.sin(2 * angle)
    tensor = torch.tensor([half + along, across, half - along], dtype=torch.float32)
    xx, xy, yy = tensor.double().tolist()
    expected = 0.5 * (xx + yy) + math.hypot(0.5 * (xx - yy), xy)
    assert float(principal_eigenvalue(tensor)) == pytest.approx(expected, rel=3e-7)
    assert 0 < float(wavelength(tensor)) <= 1e5 * (1 + 1e-6)


# --- any image ---


@pytest.mark.hard_case(
    "any finite pixels up to ±10³⁸ (hypothesis)", "finite, semidefinite within 10⁻⁶ of the trace, trace at most c²"
)
@reproducible(max_examples=60)
@given(
    image=arrays.arrays(
        np.float32,
        st.tuples(st.just(1), st.integers(1, 12), st.integers(1, 12), st.integers(1, 4)),
        elements=st.floats(-(2.0**127), 2.0**127, width=32),
    ),
    dtype=st.sampled_from([torch.float32, torch.float64]),
)
def test_s_is_sound_for_any_finite_pixels(image: np.ndarray, dtype: torch.dtype):
    assert_sound(unit_tensor(torch.from_numpy(image).to(dtype)))


@pytest.mark.hard_case(
    "any texture, exposure, pedestal, mask, `noise_floor` and `energy_blur` (hypothesis)",
    "finite, semidefinite and bounded; NaN at masked pixels",
)
@reproducible(max_examples=60)
@given(
    shape=st.tuples(st.just(2), st.integers(1, 48), st.integers(1, 48), st.integers(1, 4)),
    kind=st.sampled_from(["noise", "spikes", "steps", "ramp", "two levels"]),
    scale=st.floats(-30, 30).map(lambda exponent: 10.0**exponent),
    pedestal=st.sampled_from([0.0, 1.0, 1e3, 1e6]),
    valid=st.sampled_from([1.0, 0.9, 0.3, 0.02, 0.0]),
    noise_floor=st.sampled_from([0.0, 0.02, 1.0]),
    energy_blur=st.sampled_from([0.0, 2.0]),
    seed=st.integers(0, 1000),
)
def test_s_is_sound_for_any_texture_mask_and_setting(
    shape, kind, scale, pedestal, valid, noise_floor, energy_blur, seed
):
    _, height, width, _ = shape
    image = noise(*shape, seed=seed)
    if kind == "spikes":
        image = (image > 0.98) * 1e4
    elif kind == "steps":
        image = (image.cumsum(2) % 3).floor()
    elif kind == "ramp":
        image = torch.arange(height * width).reshape(1, height, width, 1).expand(shape).float()
    elif kind == "two levels":
        image = (image > 0.5).float() / 255
    mask = noise(2, height, width, seed=seed + 1) < valid
    tensor = unit_tensor((image + pedestal) * scale, mask, noise_floor=noise_floor, energy_blur=energy_blur)
    assert_sound(tensor, mask)
