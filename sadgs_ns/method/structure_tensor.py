"""Image → multi-scale structure tensor map S̄ (paper, section 3.2, eq. 2–5).

Borders and masks are handled by normalised convolution: every blur is a weighted mean over the valid pixels that the
kernel reaches, and the derivative is that of this mean. So a mask makes no edge, and images may be small.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import torch
import torch.nn.functional as F
from torch import Tensor

from sadgs_ns.kernels import use_triton

NUM_LEVELS = 5
"""L + 1 levels, l = 0 … L with L = 4 (paper, section 3.2)."""
SCALE_STEP = 1.5
"""σ_l = SCALE_STEP^l px (paper, section 3.2)."""
INTEGRATION_FACTOR = 3.0
"""ρ_l = INTEGRATION_FACTOR · σ_l px (paper, section 3.2)."""
GAMMA = 3.0
"""γ, the exponent of the scale weights E_l^γ (paper, eq. 5)."""
FREQUENCY_CONSTANT = 0.75
"""c of ω_l = c / σ_l, a number without a unit, which the paper leaves open (docs/results.md#why-these-defaults)."""
NOISE_FLOOR = 0.02
"""Amplitude, relative to the image's own contrast, under which structure counts as noise: the ε of eq. 3 and 5."""
ENERGY_BLUR = 2.0
"""E_l² is averaged over a Gaussian window of ENERGY_BLUR · σ_l px before its root; 0 is eq. 4 as printed. E_l crosses
zero twice a period; without the window S̄ follows the phase of the texture instead of its frequency."""
TRUNCATION = 3.0
"""Kernels end at this many standard deviations, without 0.3 % of the mass."""

_ROUNDING_FLOOR = 1e-5  # Amplitude, as a share of the brightest pixel, under which rounding makes the differences


@lru_cache(maxsize=256)
def gaussian_kernel(
    sigma: float, order: int = 0, dtype: torch.dtype = torch.float32, device: torch.device | None = None
) -> Tensor:
    """Sample a 1-D Gaussian, or its derivative, for cross-correlation; it is computed in float64. [2·⌈3σ⌉ + 1]

    Kernels are kept on the device, because making them for each batch of images would take most of the time.

    Args:
        sigma: Standard deviation in px, > 0.
        order: 0 for the Gaussian (sums to 1), 1 for its first derivative (a unit ramp gives exactly 1).
    """
    radius = math.ceil(TRUNCATION * sigma)
    x = torch.arange(-radius, radius + 1, dtype=torch.float64)  # [K]
    kernel = torch.exp(-0.5 * (x / sigma) ** 2)
    kernel = kernel / kernel.sum()
    if order == 1:
        kernel = x * kernel
        slope = (x * kernel).sum()
        kernel = kernel / slope
    return kernel.to(device=device, dtype=dtype)


def multiscale_structure_tensor(
    images: Tensor,
    masks: Tensor | None = None,
    *,
    frequency_constant: float = FREQUENCY_CONSTANT,
    noise_floor: float = NOISE_FLOOR,
    energy_blur: float = ENERGY_BLUR,
    epsilon: float | None = None,
    known_finite: bool = False,
) -> Tensor:
    """Aggregate the per-scale structure tensors of a batch of images of one size (paper, eq. 2–5).

    S̄ = Σ_l E_l^γ ω_l² Ŝ_l / (Σ_l E_l^γ + ε), with Ŝ_l = S_l / (tr S_l + ε), at full resolution on every level.
    Both ε are relative to the image's own contrast (`noise_floor`), so that S̄ does not depend on exposure, unless
    `epsilon` is given. Channels are summed after Di Zenzo. I_{−1} is the unsmoothed image.

    Args:
        images: Linear in pixel values, any range ≥ 0, any floating dtype (computed in at least float32). [B, H, W, C]
        masks: Valid pixels, or None for all; others, even NaN, neither contribute nor receive a tensor. bool [B, H, W]
        frequency_constant: See FREQUENCY_CONSTANT.
        noise_floor: See NOISE_FLOOR.
        energy_blur: See ENERGY_BLUR.
        epsilon: ε > 0 of eq. 3 and 5 as the paper prints it, the same number for every image and level, in the units
            of the pixel values; the released code takes 1e-6 with values in [0, 1]. `noise_floor` then has no effect.
        known_finite: The valid pixels are known to be finite; otherwise the host waits for the device to find out.

    Returns:
        S̄ as (xx, xy, yy) in 1/px², positive semidefinite, trace ≤ (c / σ_0)²; NaN at masked pixels. [B, H, W, 3]

    Raises:
        ValueError: If the images or masks have another shape, the images are empty or not floating point, a valid
            pixel is NaN or infinite, or `epsilon` is not positive.
        InputError: If the images are too large, or too many, for the Triton kernels to address (kernels/limits.py).
    """
    if epsilon is not None and not epsilon > 0:
        raise ValueError(f"epsilon must be positive, or None for one relative to the contrast, got {epsilon:g}")
    _check_shapes(images, masks)
    image, valid = _valid_pixels(images, masks, known_finite)
    image, brightest, contrast = _normalise(image, valid)
    levels = [SCALE_STEP**level for level in range(NUM_LEVELS)]  # σ_l in px
    if epsilon is None:
        trace_floors, weight_floor = _floors_of_contrast(contrast, noise_floor, levels)
    else:
        trace_floors, weight_floor = _floors_of_epsilon(brightest, epsilon)
    operators = _choose_operators(image)
    if masks is None:
        # All images have the same weights.
        sums = _WeightedSums(valid[:1], False, operators.correlate)
    else:
        sums = _WeightedSums(valid, True, operators.correlate)
    numerator = torch.zeros_like(image[:, :1]).repeat(1, 3, 1, 1)  # [B, 3, H, W]
    denominator = weight_floor.expand_as(valid).contiguous()  # [B, 1, H, W]
    previous = image  # I_{l−1}
    for sigma, trace_floor in zip(levels, trace_floors, strict=True):
        # The scale space: I_l and its gradient.
        blurs = sums.blur_and_gradient(image, sigma)
        totals = sums.total_and_gradient(sigma)
        smoothed, products, energy = operators.differentiate(blurs, totals, sums.weight, previous)
        # Eq. 2, the structure tensor: S_l is the mean of the gradient's products over a window of ρ_l.
        rho = INTEGRATION_FACTOR * sigma
        tensor = (sums.blur(products, rho), sums.total(rho))
        # Eq. 4, the band energy: E_l² is (I_{l−1} − I_l)², or its mean over a window.
        window = energy_blur * sigma
        if window > 0:
            energy = sums.blur(energy, window)
            energy_weight = sums.total(window)
        else:
            energy_weight = torch.ones_like(sums.weight)
        # Eq. 3 and 5: normalise S_l, and add it with its weight E_l^γ ω_l².
        frequency = frequency_constant / sigma
        band = (energy, energy_weight)
        operators.aggregate(tensor, band, trace_floor, numerator, denominator, 0.5 * GAMMA, frequency)
        previous = smoothed
    result = numerator / denominator
    if masks is not None:
        result = torch.where(valid > 0, result, torch.nan)
    return result.permute(0, 2, 3, 1).contiguous()


@dataclass(frozen=True)
class _Operators:
    """The three operators of a level, in torch or as Triton kernels."""

    correlate: Callable[[Tensor, Tensor, int], Tensor]  # Arguments as `_correlate`
    differentiate: Callable[..., tuple[Tensor, Tensor, Tensor]]  # Arguments as `_differentiate`
    aggregate: Callable[..., None]  # Arguments as `_aggregate`


def _choose_operators(
    image: Tensor,  # [B, C, H, W]
) -> _Operators:
    """Choose Triton kernels where they work; raises InputError if they cannot address the images."""
    if not use_triton(image):
        return _Operators(_correlate, _differentiate, _aggregate)
    from sadgs_ns.kernels import limits, structure_tensor

    limits.check_batch(*image.shape)
    return _Operators(structure_tensor.correlate, structure_tensor.differentiate, structure_tensor.aggregate)


def _floors_of_contrast(
    contrast: Tensor,  # [B, 1, 1, 1]
    noise_floor: float,
    levels: list[float],  # σ_l in px
) -> tuple[list[Tensor], Tensor]:
    """ε of eq. 3 for each level, and ε of eq. 5, relative to the contrast of each image. [B, 1, 1, 1] each"""
    noise = noise_floor * contrast
    noise = noise.clamp_min(_ROUNDING_FLOOR)
    trace_floors = [(noise / sigma) ** 2 for sigma in levels]
    return trace_floors, noise**GAMMA


def _floors_of_epsilon(
    brightest: Tensor,  # [B, 1, 1, 1]
    epsilon: float,
) -> tuple[list[Tensor], Tensor]:
    """ε of eq. 3 for each level, and ε of eq. 5, as the paper prints them, one number for all. [B, 1, 1, 1] each

    The image was divided by its brightest value, so S_l was by its square, and E_l^γ by its power.
    """
    smallest = torch.finfo(brightest.dtype).tiny
    trace_floor = epsilon / brightest.square()
    trace_floor = trace_floor.clamp_min(smallest)
    weight_floor = epsilon / brightest**GAMMA
    weight_floor = weight_floor.clamp_min(smallest)
    return [trace_floor] * NUM_LEVELS, weight_floor


def _check_shapes(images: Tensor, masks: Tensor | None) -> None:
    """Raise ValueError if images or masks have another type or shape than `multiscale_structure_tensor` takes."""
    if images.dim() != 4 or not images.is_floating_point():
        raise ValueError(f"images must be floating point [B, H, W, C], got {images.dtype} {tuple(images.shape)}")
    if 0 in images.shape:
        raise ValueError(f"images must have pixels and channels, got [B, H, W, C] = {tuple(images.shape)}")
    if masks is not None and masks.shape != images.shape[:3]:
        raise ValueError(f"masks must be [B, H, W] = {tuple(images.shape[:3])}, got {tuple(masks.shape)}")


def _valid_pixels(images: Tensor, masks: Tensor | None, known_finite: bool) -> tuple[Tensor, Tensor]:
    """Return the images with 0 at masked pixels [B, C, H, W], and 1 at valid pixels and 0 at masked ones [B, 1, H, W].

    Raises:
        ValueError: If a valid pixel is NaN or infinite.
    """
    image = images.permute(0, 3, 1, 2).contiguous()  # [B, C, H, W]; with channels-last strides cuDNN is slower
    image = image.to(torch.promote_types(image.dtype, torch.float32))
    valid = torch.ones_like(image[:, :1])
    if masks is not None:
        # A transposed mask would stay so, and hand its strides on to whatever it is combined with.
        valid = masks[:, None].to(image).contiguous()
    image = torch.where(valid > 0, image, 0.0)  # A product would let NaN through.
    # One such pixel would spread over the whole image, since its contrast scales everything.
    if not known_finite and not image.isfinite().all():
        is_broken = ~image.isfinite()
        broken = is_broken.flatten(1).any(dim=1).nonzero().flatten().tolist()
        raise ValueError(f"images {broken} of the batch hold NaN or infinite pixels; mask or replace those")
    return image, valid


def _normalise(
    image: Tensor,  # [B, C, H, W], 0 at masked pixels
    valid: Tensor,  # 1 at valid pixels and 0 at masked ones [B, 1, H, W]
) -> tuple[Tensor, Tensor, Tensor]:
    """Scale and centre the valid pixels of each image.

    Returns:
        The images divided by their largest absolute value, around a mean of 0, and 0 where masked [B, C, H, W]; that
        largest value [B, 1, 1, 1]; and their contrast after the division, the root of the mean squared distance from
        the mean colour [B, 1, 1, 1].
    """
    brightest = image.abs().amax(dim=(1, 2, 3), keepdim=True).clamp_min(torch.finfo(image.dtype).tiny)
    image = image / brightest  # HDR and tiny exposures then behave alike.
    count = valid.sum(dim=(2, 3), keepdim=True).clamp_min(1)
    mean = image.sum(dim=(2, 3), keepdim=True) / count
    # Every operator is blind to a constant, and without it float32 rounds relative to the contrast, not the brightness.
    image = (image - mean) * valid
    squares = image.square().sum(dim=1, keepdim=True)  # [B, 1, H, W]
    variance = squares.sum(dim=(2, 3), keepdim=True) / count
    contrast = variance.sqrt()
    return image, brightest, contrast


@dataclass(frozen=True)
class _WeightedSums:
    """Gaussian blurs of valid pixels and of their weights, 0 outside the image; their quotient is a weighted mean."""

    weight: Tensor  # 1 at valid pixels and 0 at masked ones [B, 1, H, W], or [1, 1, H, W] of ones without masks
    masked: bool
    correlate: Callable[[Tensor, Tensor, int], Tensor]

    def blur(self, image: Tensor, sigma: float) -> Tensor:
        """Separable Gaussian blur. [B, C, H, W] → [B, C, H, W]"""
        down = self._along(image, sigma, order=0, axis=2)
        return self._along(down, sigma, order=0, axis=3)

    def blur_and_gradient(self, image: Tensor, sigma: float) -> tuple[Tensor, Tensor, Tensor]:
        """Gaussian blur, and its exact x and y derivatives per px. [B, C, H, W] → each [B, C, H, W]"""
        down = self._along(image, sigma, order=0, axis=2)
        derived_down = self._along(image, sigma, order=1, axis=2)
        blurred = self._along(down, sigma, order=0, axis=3)
        derivative_x = self._along(down, sigma, order=1, axis=3)
        derivative_y = self._along(derived_down, sigma, order=0, axis=3)
        return blurred, derivative_x, derivative_y

    def total(self, sigma: float) -> Tensor:
        """`blur` of the weights, positive. [1 or B, 1, H, W]"""
        total = self._blurred_weight(sigma)
        return total.clamp_min(torch.finfo(total.dtype).tiny)

    def total_and_gradient(self, sigma: float) -> tuple[Tensor, Tensor, Tensor]:
        """`blur_and_gradient` of the weights, the blur positive. Each [1 or B, 1, H, W]"""
        if self.masked:
            total, total_x, total_y = self.blur_and_gradient(self.weight, sigma)
        else:
            total = self._unmasked(sigma, order_x=0, order_y=0)
            total_x = self._unmasked(sigma, order_x=1, order_y=0)
            total_y = self._unmasked(sigma, order_x=0, order_y=1)
        return total.clamp_min(torch.finfo(total.dtype).tiny), total_x, total_y

    def _blurred_weight(self, sigma: float) -> Tensor:
        if self.masked:
            return self.blur(self.weight, sigma)
        return self._unmasked(sigma, order_x=0, order_y=0)

    def _unmasked(self, sigma: float, order_x: int, order_y: int) -> Tensor:
        """Blur ones, or take a derivative of that: the product of a blurred column and a blurred row. [1, 1, H, W]"""
        column = self._along(self.weight[..., :1], sigma, order_y, axis=2)
        row = self._along(self.weight[..., :1, :], sigma, order_x, axis=3)
        return column * row

    def _along(self, image: Tensor, sigma: float, order: int, axis: int) -> Tensor:
        """Blur, or its derivative for order 1, along axis 2 (y) or 3 (x)."""
        kernel = gaussian_kernel(sigma, order, image.dtype, image.device)
        return self.correlate(image, kernel, axis)


def _correlate(image: Tensor, kernel: Tensor, axis: int) -> Tensor:
    """Correlate images [B, C, H, W] along axis 2 (y) or 3 (x) with a kernel of odd length; outside there are zeros."""
    channels = image.shape[1]
    size = image.shape[axis]
    radius = kernel.numel() // 2
    if radius >= size:
        # The other taps can only meet zeros.
        kernel = kernel[radius - size + 1 : radius + size]
        radius = size - 1
    if axis == 2:
        shape = (1, 1, -1, 1)
        padding = (radius, 0)
    else:
        shape = (1, 1, 1, -1)
        padding = (0, radius)
    weight = kernel.view(shape).expand(channels, -1, -1, -1)
    # Full float32, and no search for the fastest algorithm.
    with torch.backends.cudnn.flags(enabled=True, benchmark=False, deterministic=False, allow_tf32=False):
        return F.conv2d(image, weight, padding=padding, groups=channels)


def _differentiate(
    blurs: tuple[Tensor, Tensor, Tensor],  # the image's blur and its derivatives along x and y, each [B, C, H, W]
    totals: tuple[Tensor, Tensor, Tensor],  # the same of the weights, the first positive, each [1 or B, 1, H, W]
    weight: Tensor,  # [1 or B, 1, H, W]
    previous: Tensor,  # I_{l−1} [B, C, H, W]
) -> tuple[Tensor, Tensor, Tensor]:
    """Level I_l from blurs of the image, with the integrands of eq. 2 and 4.

    Returns:
        I_l [B, C, H, W]; and, times the weights, the products xx, xy, yy of its gradient, summed over the channels
        [B, 3, H, W], and the squared difference from I_{l−1}, summed likewise [B, 1, H, W].
    """
    blurred, blurred_x, blurred_y = blurs
    total, total_x, total_y = totals
    smoothed = blurred / total
    # The derivative of the quotient.
    gradient_x = (blurred_x - smoothed * total_x) / total
    gradient_y = (blurred_y - smoothed * total_y) / total
    products = _summed_products(gradient_x, gradient_y)
    energy = (previous - smoothed).square().sum(1, keepdim=True)
    return smoothed, products * weight, energy * weight


def _summed_products(gradient_x: Tensor, gradient_y: Tensor) -> Tensor:
    """Products xx, xy, yy of gradients [B, C, H, W], summed over the channels. [B, 3, H, W]"""
    xx = gradient_x.square().sum(1)
    xy = (gradient_x * gradient_y).sum(1)
    yy = gradient_y.square().sum(1)
    return torch.stack([xx, xy, yy], dim=1)


def _aggregate(
    tensor: tuple[Tensor, Tensor],  # blurred products [B, 3, H, W], the same blur of the weights [1 or B, 1, H, W]
    energy: tuple[Tensor, Tensor],  # blurred energy [B, 1, H, W], the same blur of the weights
    trace_floor: Tensor,  # ε of eq. 3 [B, 1, 1, 1]
    numerator: Tensor,  # [B, 3, H, W]
    denominator: Tensor,  # [B, 1, H, W]
    exponent: float,  # γ / 2
    frequency: float,  # ω_l in 1/px
) -> None:
    """Add a level to the sums of eq. 5, in place."""
    structure = tensor[0] / tensor[1]  # S_l, eq. 2
    trace = structure[:, :1] + structure[:, 2:]
    normalised = structure / (trace + trace_floor)  # Ŝ_l, eq. 3
    mean_energy = energy[0] / energy[1]  # E_l², eq. 4
    weight = mean_energy.clamp_min(0) ** exponent  # E_l^γ
    numerator += weight * frequency**2 * normalised
    denominator += weight
