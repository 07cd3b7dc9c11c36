"""S̄ in three bytes a pixel, as many as its image takes."""

from __future__ import annotations

import torch
from torch import Tensor

INVALID = 255
"""Second byte of a pixel whose S̄ is NaN, such as a masked one; those of correlations end at 254."""
HIGHEST_FREQUENCY = 4.0
"""Highest frequency that can be stored, in 1/px. S̄'s trace is at most c²/px², so this is the largest c."""
OCTAVES = 12.0
"""Frequencies from 2⁻¹² of the highest one on, so wavelengths of 0.25 to 1,024 px, are told apart."""


def quantize(
    tensor: Tensor,  # [..., 3]
) -> Tensor:
    """Round √xx and √yy on a logarithmic scale, and the correlation xy / √(xx yy) on a linear one, to a byte each.

    A logarithm keeps the relative error of every wavelength the same (at most 1.7 %), and a correlation within ±1 keeps
    S̄ positive semidefinite. S̄ is (xx, xy, yy) in 1/px², finite or NaN; a pixel with a NaN, such as a masked one,
    becomes (0, INVALID, 0). uint8 [..., 3]
    """
    xx, xy, yy = tensor.unbind(-1)
    frequencies = torch.stack([xx, yy], -1).clamp_min(0).sqrt()  # [..., 2] in 1/px
    logarithms = 1 + (frequencies / HIGHEST_FREQUENCY).log2() / OCTAVES  # (−∞, 1]
    rounded = (1 + 254 * logarithms).round().clamp(0, 255)
    product = frequencies[..., 0] * frequencies[..., 1]  # √(xx yy)
    divisor = product.clamp_min(torch.finfo(product.dtype).tiny)
    correlation = torch.where(product > 0, xy / divisor, 0.0)
    correlation = correlation.clamp(-1, 1)
    middle = 127 + 127 * correlation
    middle = middle.round()
    invalid = tensor.isnan().any(-1)
    first, last = torch.where(invalid[..., None], 0.0, rounded).unbind(-1)
    middle = torch.where(invalid, INVALID, middle)
    return torch.stack([first, middle, last], -1).byte()


def dequantize(
    quantized: Tensor,  # uint8 [..., 3]
) -> Tensor:
    """Read S̄ in 1/px² back from what `quantize` made of it, in float32; NaN at masked pixels. [..., 3]"""
    first, middle, last = quantized.float().unbind(-1)
    x = _decode_frequency(first)  # √xx
    y = _decode_frequency(last)  # √yy
    numerator = middle - 127  # The correlation is this over 127.
    xy = x * y * numerator / 127
    decoded = torch.stack([x * x, xy, y * y], -1)
    is_invalid = quantized[..., 1:2] == INVALID
    return torch.where(is_invalid, torch.nan, decoded)


def _decode_frequency(
    byte: Tensor,  # float32 [...]
) -> Tensor:
    """Frequency in 1/px that a byte stands for; 0 stands for none. [...]"""
    octaves = OCTAVES * ((byte - 1) / 254 - 1)  # [−OCTAVES, 0]
    return torch.where(byte > 0, HIGHEST_FREQUENCY * torch.exp2(octaves), 0.0)
