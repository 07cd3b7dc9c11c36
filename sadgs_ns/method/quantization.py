"""S̄ in three bytes a pixel, which is as much as the image takes that it was computed from."""

from __future__ import annotations

import torch
from torch import Tensor

from sadgs_ns.kernels import use_triton

MASKED = 255
"""Second byte of a masked pixel, whose S̄ is NaN; the codes of correlations end at 254."""
HIGHEST_FREQUENCY = 4.0
"""1/px. S̄'s trace is at most c²/px² by construction, so this is the largest c that can be stored."""
OCTAVES = 12.0
"""Frequencies down to 2⁻¹² of the highest one, which are wavelengths of 0.25 to 1,024 px, have codes of their own."""


def encode(tensor: Tensor) -> Tensor:
    """Encode √xx and √yy on a logarithmic scale, and the correlation xy / √(xx yy) on a linear one.

    A logarithm keeps the relative error of every wavelength the same (at most 1.7 %), and a correlation within ±1 keeps
    S̄ positive semidefinite. A pixel of which any number is NaN, as `multiscale_structure_tensor` gives masked ones,
    becomes (0, MASKED, 0).

    Args:
        tensor: S̄ as (xx, xy, yy) in 1/px², finite or NaN. [..., 3]

    Returns:
        uint8 [..., 3]
    """
    if use_triton(tensor):
        from sadgs_ns.kernels import quantization as kernel

        return kernel.encode(tensor, HIGHEST_FREQUENCY, OCTAVES, MASKED)
    xx, xy, yy = tensor.unbind(-1)
    frequencies = torch.stack([xx, yy], -1).clamp_min(0).sqrt()  # [..., 2] in 1/px
    logarithms = 1 + (frequencies / HIGHEST_FREQUENCY).log2() / OCTAVES  # (−∞, 1]
    codes = (1 + 254 * logarithms).round().clamp(0, 255)
    product = frequencies[..., 0] * frequencies[..., 1]
    correlation = torch.where(product > 0, xy / product.clamp_min(torch.finfo(product.dtype).tiny), 0.0)
    masked = tensor.isnan().any(-1)
    codes = torch.where(masked[..., None], 0.0, codes)
    correlation = torch.where(masked, MASKED, (127 + 127 * correlation.clamp(-1, 1)).round())
    return torch.stack([codes[..., 0], correlation, codes[..., 1]], -1).byte()


def decode(codes: Tensor) -> Tensor:
    """Read S̄ back from its codes.

    Args:
        codes: As made by `encode`, uint8. [..., 3]

    Returns:
        S̄ as (xx, xy, yy) in 1/px², float32; NaN at masked pixels. [..., 3]
    """
    x, correlation, y = codes.float().unbind(-1)

    def frequency(code: Tensor) -> Tensor:
        return torch.where(code > 0, HIGHEST_FREQUENCY * torch.exp2(OCTAVES * ((code - 1) / 254 - 1)), 0.0)

    x, y = frequency(x), frequency(y)
    decoded = torch.stack([x * x, x * y * (correlation - 127) / 127, y * y], -1)
    return torch.where(codes[..., 1:2] == MASKED, torch.nan, decoded)
