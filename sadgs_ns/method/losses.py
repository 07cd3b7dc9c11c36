"""The photometric loss L1 + SSIM + ℓ2 (paper, section 3.6)."""

from __future__ import annotations

from functools import lru_cache

import torch
from pytorch_msssim import ssim
from pytorch_msssim.ssim import _fspecial_gauss_1d
from torch import Tensor

from sadgs_ns.kernels import use_triton

WINDOW = tuple(_fspecial_gauss_1d(11, 1.5).flatten().tolist())
"""SSIM's window along one axis: a Gaussian of σ = 1.5 px on 11 px."""
L2_LAMBDA = 2.0
"""Factor on the mean square error in the loss."""


@lru_cache(maxsize=8)
def _window(device: torch.device, dtype: torch.dtype) -> Tensor:
    """SSIM's window on the device, for each channel [3, 1, 1, 11]. Copying it in every step would stop the host."""
    weights = torch.tensor(WINDOW, dtype=dtype, device=device)
    return weights.repeat(3, 1, 1, 1)


def photometric_loss(
    predicted: Tensor,  # [C, H, W, 3]
    target: Tensor,  # [C, H, W, 3]
    *,
    ssim_lambda: float = 0.2,
    l2_lambda: float = L2_LAMBDA,
    parts: Tensor | None = None,  # [P]
    clipped_from: float | None = None,
) -> tuple[Tensor, Tensor]:
    """(1 − λ) L1 + λ (1 − SSIM) + λ_2 ℓ2, each a mean over views, pixels and channels.

    The paper gives no weights; these defaults are the released code's.

    Args:
        predicted: Rendered views, not clamped, so that gradients reach colours outside [0, 1]. [C, H, W, 3]
        target: Training views, floats in [0, 1] or uint8. [C, H, W, 3]
        ssim_lambda: λ in [0, 1].
        l2_lambda: λ_2 ≥ 0.
        parts: Numbers whose sum is added to the loss, such as a penalty from `render.activations.activate`. [P]
        clipped_from: Value of the target from which something brighter is no error (`excuse_clipped`); None counts all.

    Returns:
        The loss, and PSNR in dB for values in [0, 1], without gradient; both are scalars.

    Raises:
        ValueError: From pytorch_msssim, if views are one pixel high or wide.
        InputError: If the views have more pixels than the Triton kernels can address (kernels/limits.py).
    """
    has_suitable_type = target.dtype in (torch.float32, torch.uint8)
    is_large_enough = min(predicted.shape[1:3]) >= len(WINDOW)
    if has_suitable_type and is_large_enough and use_triton(predicted):
        from sadgs_ns.kernels import losses as kernel

        return kernel.photometric_loss(
            predicted, target, WINDOW,
            ssim_lambda=ssim_lambda, l2_lambda=l2_lambda, parts=parts, clipped_from=clipped_from,
        )  # fmt: skip
    target = as_floats(target)
    if clipped_from is not None:
        predicted = excuse_clipped(predicted, target, clipped_from)
    difference = predicted - target
    l1 = difference.abs().mean()
    l2 = difference.square().mean()
    similarity = _similarity(predicted, target)
    loss = (1 - ssim_lambda) * l1 + ssim_lambda * (1 - similarity) + l2_lambda * l2
    if parts is not None:
        loss = loss + parts.sum()
    psnr = -10 * l2.detach().log10()
    return loss, psnr


def as_floats(
    target: Tensor,  # [C, H, W, 3]
) -> Tensor:
    """Return an image in bytes as floats in [0, 1], and others as they are. [C, H, W, 3]"""
    if target.dtype == torch.uint8:
        return target / 255.0
    return target


def excuse_clipped(
    predicted: Tensor,  # At the exposure of its target, not clamped [C, H, W, 3]
    target: Tensor,  # Floats in [0, 1] [C, H, W, 3]
    clipped_from: float,
) -> Tensor:
    """Return a rendering with the target's values wherever these are clipped and the rendering is brighter.

    A clipped pixel tells only that the scene is no darker. Its loss, and the gradient of a brighter rendering, is 0.
    Otherwise long exposures would darken the sky that short ones show as it is. [C, H, W, 3]
    """
    is_excused = (target >= clipped_from) & (predicted > target)
    return torch.where(is_excused, target, predicted)


def _similarity(
    predicted: Tensor,  # [C, H, W, 3]
    target: Tensor,  # [C, H, W, 3]
) -> Tensor:
    """Mean SSIM of views in [0, 1], a scalar.

    The copies are contiguous: with channels-last strides cuDNN convolves at a third of the speed, above all backward.
    """
    window = _window(predicted.device, predicted.dtype)
    x = predicted.permute(0, 3, 1, 2).contiguous()
    y = target.permute(0, 3, 1, 2).contiguous()
    return ssim(x, y, data_range=1.0, win=window)


def photometric_part(
    predicted: Tensor,  # [1, H', W, 3]
    target: Tensor,  # [1, H', W, 3]
    *,
    rows: tuple[int, int],
    top: int,
    height: int,
    ssim_lambda: float = 0.2,
    clipped_from: float | None = None,
) -> tuple[Tensor, Tensor]:
    """Compute the part of a view's `photometric_loss` that some rows contribute; the parts of all rows sum to it.

    SSIM's windows belong to the rows in which they are centred. Raises ValueError as `photometric_loss`.

    Args:
        predicted: The rendering of `rows` and of 5 more on either side, as far as the image reaches. [1, H', W, 3]
        target: The same rows of the training view.
        rows: First row that counts and one past the last.
        top: The view's row that is the first of `predicted`.
        height: The view's in px, at least 11 unless all rows count.
        clipped_from: As for `photometric_loss`.

    Returns:
        The part of the loss, and that of the mean square error, without gradient; both are scalars.
    """
    first, last = rows
    if last - first == height:
        loss, psnr = photometric_loss(predicted, target, ssim_lambda=ssim_lambda, clipped_from=clipped_from)
        return loss, torch.pow(10, -psnr / 10)
    # SSIM of the windows that are centred in these rows, and their share of all windows.
    reach = len(WINDOW) // 2
    begin = max(first - reach, 0)
    end = min(last + reach, height)
    share_of_windows = (end - begin - 2 * reach) / (height - 2 * reach)
    in_windows = slice(begin - top, end - top)
    dissimilarity, _ = photometric_loss(
        predicted[:, in_windows], target[:, in_windows], ssim_lambda=1.0, l2_lambda=0.0, clipped_from=clipped_from
    )
    # L1 and L2 of these rows, and their share of all rows.
    share_of_rows = (last - first) / height
    own = slice(first - top, last - top)
    of_rows = predicted[:, own]
    target_of_rows = as_floats(target[:, own])
    if clipped_from is not None:
        of_rows = excuse_clipped(of_rows, target_of_rows, clipped_from)
    difference = of_rows - target_of_rows
    l1 = difference.abs().mean()
    l2 = difference.square().mean()
    of_pixels = (1 - ssim_lambda) * l1 + L2_LAMBDA * l2
    loss = share_of_rows * of_pixels + share_of_windows * ssim_lambda * dissimilarity
    return loss, share_of_rows * l2.detach()
