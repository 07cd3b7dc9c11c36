"""S̄ in three bytes a pixel."""

from __future__ import annotations

import pytest
import torch

from helpers.closeness import assert_within_share
from helpers.generators import seeded
from sadgs_ns.method.eta import principal_eigenvalue, sample_map
from sadgs_ns.method.quantization import HIGHEST_FREQUENCY, INVALID, OCTAVES, dequantize, quantize
from sadgs_ns.method.structure_tensor import multiscale_structure_tensor


@pytest.mark.hard_case("S̄ kept in 8 bits", "the wavelength is kept within 1.9 %, S̄ stays positive semidefinite")
@pytest.mark.parametrize("frequency_constant", [0.01, 0.4, HIGHEST_FREQUENCY])
def test_every_wavelength_is_kept_within_two_percent_and_s_stays_semidefinite(frequency_constant: float):
    images = torch.rand((1, 48, 64, 3), generator=seeded(0))
    images[:, :, 32:] = images[:, :1, 32:]  # lines: rank one
    tensor = multiscale_structure_tensor(images, frequency_constant=frequency_constant)
    quantized = quantize(tensor)
    decoded = dequantize(quantized)
    assert quantized.dtype == torch.uint8
    assert quantized.shape == tensor.shape
    xx, xy, yy = decoded.double().unbind(-1)
    assert (xx * yy - xy * xy).min() >= -1e-6 * decoded.double().square().max()
    # Half a step is 2^(12/254/2), 1.65 %, of either frequency; the correlation's half step of 1/254 adds 0.2 %.
    ratio = (principal_eigenvalue(decoded) / principal_eigenvalue(tensor)).sqrt()
    assert (ratio - 1).abs().max() < 0.019


def test_nothing_the_ends_of_the_range_and_what_lies_beyond():
    nothing = quantize(torch.zeros(1, 3))
    assert nothing.tolist() == [[0, 127, 0]]
    assert dequantize(nothing).eq(0).all()
    largest = HIGHEST_FREQUENCY**2
    ends = torch.tensor([[largest, 0.0, largest * 4.0**-OCTAVES], [largest / 2, -largest / 2, largest / 2]])
    actual = dequantize(quantize(ends))
    assert_within_share(actual, ends, 0.035)
    actual = dequantize(quantize(torch.tensor([[4 * largest, 0.0, largest * 4.0 ** (-OCTAVES - 1)]]))).tolist()
    assert actual == [[largest, 0.0, 0.0]]


@pytest.mark.hard_case("S̄ of a masked pixel in its three bytes", "has a value of its own, which no valid pixel gets")
def test_masked_pixels_have_a_value_of_their_own():
    """NaN stays NaN, and no tensor of a valid pixel reads as one, whatever its correlation."""
    tensor = torch.tensor([[1.0, 0.5, 1.0], [1.0, 1.0, 1.0], [1.0, -1.0, 1.0], [0.0, 0.0, 0.0]])
    masked = tensor.clone()
    masked[0] = torch.nan
    masked[1, 0] = torch.nan
    masked[2, 1] = torch.nan
    actual = quantize(masked)[:3].tolist()
    expected = [[0, INVALID, 0]] * 3
    assert actual == expected
    assert dequantize(quantize(masked))[:3].isnan().all()
    assert torch.equal(quantize(masked)[3], quantize(tensor)[3])
    assert dequantize(quantize(tensor)).isfinite().all()


def test_samples_of_quantized_tensors_are_samples_of_what_they_stand_for():
    tensor = torch.rand((2, 5, 7, 3), generator=seeded(0)) * torch.tensor([1.0, 0.1, 1.0])
    tensor[1, 4, 0] = torch.nan
    quantized = quantize(tensor)
    points = torch.tensor([[0.5, 0.5], [6.9, 4.9], [7.1, 1.0], [0.5, 4.5]])
    cameras = torch.tensor([0, 1, 1, 1])
    for actual, expected in zip(
        sample_map(quantized, cameras, points), sample_map(dequantize(quantized), cameras, points), strict=True
    ):
        assert torch.equal(actual, expected)
