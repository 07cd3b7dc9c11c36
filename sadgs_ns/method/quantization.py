"""S̄ in three bytes a pixel, as many as its image takes."""

from __future__ import annotations

import torch
from torch import Tensor

from sadgs_ns.kernels import use_triton

INVALID = 255  # Second byte of a pixel whose S̄ is NaN, such as a masked one; those of correlations end at 254
HIGHEST_FREQUENCY = 4.0  # 1/px. S̄'s trace is at most c²/px², so this is the largest c that can be stored
OCTAVES = 12.0  # Frequencies from 2⁻¹² of the highest one on, so wavelengths of 0.25 to 1,024 px, are told apart.


def quantize(tensor: Tensor) -> Tensor:
    """Round √xx and √yy on a logarithmic scale, and the correlation xy / √(xx yy) on a linear one, to a byte each.

    A logarithm keeps the relative error of every wavelength the same (at most 1.7 %), and a correlation within ±1 keeps
    S̄ positive semidefinite. S̄ is (xx, xy, yy) in 1/px², finite or NaN; a pixel with a NaN, such as a masked one,
    becomes (0, INVALID, 0). [..., 3] → uint8 [..., 3]
    """
    if use_triton(tensor):
        from sadgs_ns.kernels import quantization as kernel

        return kernel.quantize(tensor, HIGHEST_FREQUENCY, OCTAVES, INVALID)
    xx, xy, yy = tensor.unbind(-1)
    frequencies = torch.stack([xx, yy], -1).clamp_min(0).sqrt()  # [..., 2] in 1/px
    logarithms = 1 + (frequencies / HIGHEST_FREQUENCY).log2() / OCTAVES  # (−∞, 1]
    rounded = (1 + 254 * logarithms).round().clamp(0, 255)
    product = frequencies[..., 0] * frequencies[..., 1]
    correlation = torch.where(product > 0, xy / product.clamp_min(torch.finfo(product.dtype).tiny), 0.0)
    invalid = tensor.isnan().any(-1)
    rounded = torch.where(invalid[..., None], 0.0, rounded)
    correlation = torch.where(invalid, INVALID, (127 + 127 * correlation.clamp(-1, 1)).round())
    return torch.stack([rounded[..., 0], correlation, rounded[..., 1]], -1).byte()


def dequantize(quantized: Tensor) -> Tensor:
    """Read S̄ back from what `quantize` made of it, in float32; NaN at masked pixels. uint8 [..., 3] → [..., 3]"""
    x, correlation, y = quantized.float().unbind(-1)

    def frequency(byte: Tensor) -> Tensor:
        return torch.where(byte > 0, HIGHEST_FREQUENCY * torch.exp2(OCTAVES * ((byte - 1) / 254 - 1)), 0.0)

    x, y = frequency(x), frequency(y)
    decoded = torch.stack([x * x, x * y * (correlation - 127) / 127, y * y], -1)
    return torch.where(quantized[..., 1:2] == INVALID, torch.nan, decoded)
