"""Image → multi-scale structure tensor map S̄ (paper, section 3.2, eq. 2–5).

Pure tensor functions. Borders and masks are handled in one way, by normalised convolution: every blur is a weighted
mean over the valid pixels that the kernel reaches, and the derivative is the exact derivative of that mean. Nothing is
invented outside the image, no edge appears at a mask, and an image may be smaller than the largest kernel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import torch
import torch.nn.functional as F
from torch import Tensor

from sadgs_ns import kernels

NUM_LEVELS = 5
"""L + 1 levels, l = 0 … L with L = 4 (paper, section 3.2)."""
SCALE_STEP = 1.5
"""σ_l = SCALE_STEP^l px (paper, section 3.2)."""
INTEGRATION_FACTOR = 3.0
"""ρ_l = INTEGRATION_FACTOR · σ_l px (paper, section 3.2)."""
GAMMA = 3.0
"""Exponent of the scale weights E_l^γ (paper, eq. 5)."""
FREQUENCY_CONSTANT = 0.4
"""c of ω_l = c / σ_l in 1/px. The paper leaves it open; docs/measurements.md holds the sweeps that settled it."""
NOISE_FLOOR = 0.02
"""Amplitude, relative to the image's own contrast, under which structure counts as noise: the ε of eq. 3 and 5."""
ENERGY_BLUR = 2.0
"""E_l² is averaged over a Gaussian window of ENERGY_BLUR · σ_l px before its root; 0 is eq. 4 as printed."""
TRUNCATION = 3.0
"""Kernels end at this many standard deviations; what is cut off is 0.3 % of the mass."""

_ROUNDING_FLOOR = 1e-5
"""Amplitude relative to the brightest pixel under which float32 rounding, not the image, makes the differences."""


def gaussian_kernel(
    sigma: float, order: int = 0, dtype: torch.dtype = torch.float32, truncation: float = TRUNCATION
) -> Tensor:
    """Sampled 1-D Gaussian, or its derivative, ready for cross-correlation.

    Args:
        sigma: Standard deviation in px, > 0.
        order: 0 for the Gaussian (sums to 1), 1 for its first derivative (a unit ramp gives exactly 1).
        dtype: Of the kernel, which is computed in float64.
        truncation: Radius in standard deviations, > 0.

    Returns:
        Kernel of odd length 2·⌈truncation · σ⌉ + 1. [K]
    """
    radius = math.ceil(truncation * sigma)
    x = torch.arange(-radius, radius + 1, dtype=torch.float64)  # [K]
    kernel = torch.exp(-0.5 * (x / sigma) ** 2)
    kernel = kernel / kernel.sum()
    if order == 1:
        kernel = x * kernel
        kernel = kernel / (x * kernel).sum()
    return kernel.to(dtype)


@lru_cache(maxsize=256)
def _kernel(sigma: float, order: int, dtype: torch.dtype, device: torch.device, truncation: float) -> Tensor:
    """`gaussian_kernel`, kept on the device: made anew for each batch of images, it would take most of the time."""
    return gaussian_kernel(sigma, order, dtype, truncation).to(device)


@dataclass(frozen=True)
class _Filters:
    """Separable filters with zeros outside the image."""

    truncation: float
    """Radius of every kernel, in multiples of its standard deviation."""
    fused: bool
    """Convolve with our Triton kernel."""

    def convolve(self, image: Tensor, sigma: float, order: int, axis: int) -> Tensor:
        """Correlate with a Gaussian or its derivative along one image axis.

        Args:
            image: [B, C, H, W]
            sigma: px.
            order: 0 or 1.
            axis: 2 for rows (y), 3 for columns (x).
        """
        kernel = _kernel(sigma, order, image.dtype, image.device, self.truncation)
        if self.fused:
            from sadgs_ns.kernels.convolution import correlate

            return correlate(image, kernel, axis)
        channels, size, radius = image.shape[1], image.shape[axis], kernel.numel() // 2
        if radius >= size:  # taps that can only ever meet zeros
            kernel = kernel[radius - size + 1 : radius + size]
            radius = size - 1
        shape = (1, 1, -1, 1) if axis == 2 else (1, 1, 1, -1)
        padding = (radius, 0) if axis == 2 else (0, radius)
        weight = kernel.view(shape).expand(channels, -1, -1, -1)
        # Full float32, and no search for the fastest algorithm: each of dozens of kernel sizes is used a few times.
        with torch.backends.cudnn.flags(enabled=True, benchmark=False, deterministic=False, allow_tf32=False):
            return F.conv2d(image, weight, padding=padding, groups=channels)

    def blur(self, image: Tensor, sigma: float) -> Tensor:
        """Separable Gaussian blur. [B, C, H, W] → [B, C, H, W]"""
        return self.convolve(self.convolve(image, sigma, 0, 2), sigma, 0, 3)

    def blur_and_gradient(self, image: Tensor, sigma: float) -> tuple[Tensor, Tensor, Tensor]:
        """Gaussian blur, and its exact x and y derivatives. Each [B, C, H, W], per px."""
        rows = self.convolve(image, sigma, 0, 2)
        derived_rows = self.convolve(image, sigma, 1, 2)
        return (
            self.convolve(rows, sigma, 0, 3),
            self.convolve(rows, sigma, 1, 3),
            self.convolve(derived_rows, sigma, 0, 3),
        )


@dataclass(frozen=True)
class _Reach:
    """What the filters make of the pixels' weights, by which their results are divided."""

    filters: _Filters
    weight: Tensor
    """[B, 1, H, W], or [1, 1, H, W] of ones without masks."""
    masked: bool

    def blur(self, sigma: float) -> Tensor:
        """Of `_Filters.blur`, positive. [1 or B, 1, H, W]"""
        if self.masked:
            blurred = self.filters.blur(self.weight, sigma)
        else:  # a row of ones and a column tell all
            blurred = self._along(sigma, 0, 2) * self._along(sigma, 0, 3)
        return blurred.clamp_min(torch.finfo(blurred.dtype).tiny)

    def blur_and_gradient(self, sigma: float) -> tuple[Tensor, Tensor, Tensor]:
        """Of `_Filters.blur_and_gradient`, the blur positive. Each [1 or B, 1, H, W]"""
        if self.masked:
            blurred, blurred_x, blurred_y = self.filters.blur_and_gradient(self.weight, sigma)
        else:
            down, across = self._along(sigma, 0, 2), self._along(sigma, 0, 3)
            blurred, blurred_x, blurred_y = (
                down * across,
                down * self._along(sigma, 1, 3),
                self._along(sigma, 1, 2) * across,
            )
        return blurred.clamp_min(torch.finfo(blurred.dtype).tiny), blurred_x, blurred_y

    def _along(self, sigma: float, order: int, axis: int) -> Tensor:
        return self.filters.convolve(self.weight[..., :1] if axis == 2 else self.weight[..., :1, :], sigma, order, axis)


def multiscale_structure_tensor(
    images: Tensor,
    masks: Tensor | None = None,
    *,
    frequency_constant: float = FREQUENCY_CONSTANT,
    gamma: float = GAMMA,
    noise_floor: float = NOISE_FLOOR,
    energy_blur: float = ENERGY_BLUR,
    num_levels: int = NUM_LEVELS,
    truncation: float = TRUNCATION,
    incremental: bool = False,
    fused: bool = True,
) -> Tensor:
    """Aggregate the per-scale structure tensors of a batch of images of one size (paper, eq. 2–5).

    S̄ = Σ_l E_l^γ ω_l² Ŝ_l / (Σ_l E_l^γ + ε), with Ŝ_l = S_l / (tr S_l + ε), at full resolution on every level.
    Both ε are relative to the image's own contrast (`noise_floor`), so S̄ does not depend on exposure. Channels are
    summed after Di Zenzo. I_{−1} is the unsmoothed image.

    Args:
        images: Linear in the pixel value, any non-negative range, any floating dtype (computed in at least float32).
            [B, H, W, C]
        masks: Valid pixels; the others, which may hold anything, NaN too, neither contribute nor receive a tensor.
            bool [B, H, W] or None for all.
        frequency_constant: c of ω_l = c / σ_l, in 1/px.
        gamma: Exponent of the scale weights.
        noise_floor: Amplitude relative to the image's contrast under which S̄ fades to 0.
        energy_blur: Window, in multiples of σ_l, over which the band energy E_l² is averaged. E_l crosses zero twice a
            period; without the window S̄ follows the phase of the texture instead of its frequency.
        num_levels: L + 1.
        truncation: Radius of every kernel, in multiples of its standard deviation.
        incremental: Blur level l − 1 by √(σ_l² − σ_{l−1}²) instead of the image by σ_l: shorter kernels, but each
            level inherits what the one before it lost at borders and by truncation.
        fused: Use our Triton kernels where they run: CUDA, float32.

    Returns:
        S̄ as (xx, xy, yy) in 1/px², positive semidefinite, trace ≤ (c / σ_0)²; NaN at masked pixels, where it is not
        known. [B, H, W, 3]

    Raises:
        ValueError: If the images or masks have another shape, the images are empty or not floating point, or a valid
            pixel is NaN or infinite.
    """
    if images.dim() != 4 or not images.is_floating_point():
        raise ValueError(f"images must be floating point [B, H, W, C], got {images.dtype} {tuple(images.shape)}")
    if 0 in images.shape:
        raise ValueError(f"images must have pixels and channels, got [B, H, W, C] = {tuple(images.shape)}")
    if masks is not None and masks.shape != images.shape[:3]:
        raise ValueError(f"masks must be [B, H, W] = {tuple(images.shape[:3])}, got {tuple(masks.shape)}")
    image = images.permute(0, 3, 1, 2).contiguous()  # [B, C, H, W]; with channels-last strides cuDNN is slower
    image = image.to(torch.promote_types(image.dtype, torch.float32))
    # [B, 1, H, W]; a transposed mask would stay so, and hand its strides on to whatever it is combined with.
    valid = torch.ones_like(image[:, :1]) if masks is None else masks[:, None].to(image).contiguous()
    # Without a mask the weights of all images are the same: keep one.
    weight = valid[:1] if masks is None else valid
    image = torch.where(valid > 0, image, 0.0)  # a product would let NaN through
    if not image.isfinite().all():  # one would spread over the whole image: its contrast scales everything
        broken = (~image.isfinite()).flatten(1).any(dim=1).nonzero().flatten().tolist()
        raise ValueError(f"images {broken} of the batch hold NaN or infinite pixels; mask or replace those")
    brightest = image.abs().amax(dim=(1, 2, 3), keepdim=True).clamp_min(torch.finfo(image.dtype).tiny)
    image = image / brightest  # now in [-1, 1]: HDR and tiny exposures behave alike
    count = valid.sum(dim=(2, 3), keepdim=True).clamp_min(1)
    mean = image.sum(dim=(2, 3), keepdim=True) / count
    # Centring costs nothing (every operator below is blind to a constant) and keeps float32 rounding relative to
    # the contrast, not to the brightness.
    image = (image - mean) * valid
    contrast = (image.square().sum(dim=1, keepdim=True).sum(dim=(2, 3), keepdim=True) / count).sqrt()  # [B, 1, 1, 1]
    noise = (noise_floor * contrast).clamp_min(_ROUNDING_FLOOR)  # [B, 1, 1, 1]

    fused = fused and image.dtype == torch.float32 and kernels.available(image.device)
    if fused:
        from sadgs_ns.kernels import limits, scale_space

        limits.check_batch(*image.shape)
    filters = _Filters(truncation, fused)
    reach = _Reach(filters, weight, masks is not None)
    numerator = torch.zeros_like(image[:, :1]).repeat(1, 3, 1, 1)  # [B, 3, H, W]
    denominator = (noise**gamma).expand_as(valid).contiguous()  # [B, 1, H, W]
    previous = image
    for level in range(num_levels):
        sigma = SCALE_STEP**level
        source, step = image, sigma
        if incremental and level > 0:
            source, step = previous * valid, math.sqrt(sigma**2 - SCALE_STEP ** (2 * level - 2))
        blurs, reaches = filters.blur_and_gradient(source, step), reach.blur_and_gradient(step)
        if fused:
            smoothed, products, energy = scale_space.differentiate(blurs, reaches, weight, previous)
        else:
            smoothed = blurs[0] / reaches[0]
            # The derivative of the quotient.
            gradient_x = (blurs[1] - smoothed * reaches[1]) / reaches[0]
            gradient_y = (blurs[2] - smoothed * reaches[2]) / reaches[0]
            products = torch.stack(
                [gradient_x.square().sum(1), (gradient_x * gradient_y).sum(1), gradient_y.square().sum(1)], dim=1
            )  # [B, 3, H, W]
            products = products * weight
            energy = (previous - smoothed).square().sum(1, keepdim=True) * weight
        rho, window = INTEGRATION_FACTOR * sigma, energy_blur * sigma
        products, integrated = filters.blur(products, rho), reach.blur(rho)
        total = torch.ones_like(weight)
        if energy_blur > 0:
            energy, total = filters.blur(energy, window), reach.blur(window)
        if fused:
            sums = numerator, denominator
            scale_space.accumulate(
                (products, integrated), (energy, total), noise, sums, gamma / 2, frequency_constant / sigma, sigma
            )
        else:
            tensor = products / integrated  # S_l, eq. 2
            normalised = tensor / (tensor[:, :1] + tensor[:, 2:] + (noise / sigma) ** 2)  # Ŝ_l, eq. 3
            scale_weight = (energy / total).clamp_min(0) ** (0.5 * gamma)  # E_l^γ, eq. 4
            numerator += scale_weight * (frequency_constant / sigma) ** 2 * normalised
            denominator += scale_weight
        previous = smoothed
    tensor = numerator / denominator
    if masks is not None:
        tensor = torch.where(valid > 0, tensor, torch.nan)
    return tensor.permute(0, 2, 3, 1).contiguous()
