"""Image quality and rendering speed of a trained splatting model, the same for every method.

The metrics are computed here and not by the model: nerfstudio's own ones differ between methods and versions. Images
are float in [0, 1], not rounded to 8 bits; SSIM is torchmetrics' (Gaussian window of 11 px, σ = 1.5 px); LPIPS is
torchmetrics' with AlexNet.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor
from torchmetrics.functional.image import peak_signal_noise_ratio, structural_similarity_index_measure
from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

View = tuple[Any, dict[str, Any]]
"""A nerfstudio Cameras of one camera, and its batch with "image" [H, W, 3 or 4], uint8 or float."""


def now() -> float:
    """Seconds on a monotonic clock, after all work that the GPU has been given."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter()


def load_lpips(device: str) -> LearnedPerceptualImagePatchSimilarity | None:
    """The LPIPS network, or None and one printed line where its weights cannot be had."""
    try:
        return LearnedPerceptualImagePatchSimilarity(net_type="alex", normalize=True).to(device)
    except (OSError, RuntimeError) as error:
        print(f"LPIPS is left out, its AlexNet weights are not in $TORCH_HOME and not to be downloaded ({error}).")
        return None


@torch.no_grad()
def render(model: Any, view: View) -> tuple[Tensor, Tensor]:
    """Render a view with a splatting model in eval mode.

    Returns:
        The rendering and the photograph over the rendering's background, in [0, 1]. [1, 3, H, W] both
    """
    camera, batch = view
    outputs = model.get_outputs_for_camera(camera)
    truth = model.composite_with_background(model.get_gt_img(batch["image"]), outputs["background"])
    return tuple(image[..., :3].clamp(0, 1).movedim(-1, 0)[None] for image in (outputs["rgb"], truth))  # type: ignore[return-value]


@torch.no_grad()
def quality(
    model: Any, views: Iterable[View], lpips: LearnedPerceptualImagePatchSimilarity | None
) -> dict[str, float | None]:
    """Means over views of PSNR in dB, SSIM and LPIPS (None without a network)."""
    psnr, ssim, perceptual = [], [], []
    for view in views:
        image, truth = render(model, view)
        psnr.append(float(peak_signal_noise_ratio(image, truth, data_range=1.0)))
        similarity = structural_similarity_index_measure(
            image, truth, gaussian_kernel=True, sigma=1.5, kernel_size=11, data_range=1.0
        )
        ssim.append(float(similarity))  # type: ignore[arg-type]
        if lpips is not None:
            perceptual.append(float(lpips(image, truth)))
    return {
        "psnr": statistics.fmean(psnr),
        "ssim": statistics.fmean(ssim),
        "lpips": statistics.fmean(perceptual) if perceptual else None,
    }


@torch.no_grad()
def frames_per_second(model: Any, cameras: list[Any], passes: int = 3) -> float:
    """Rendering rate over all cameras, colour and depth: the median of some passes."""
    seconds = []
    for _ in range(passes):
        start = now()
        for camera in cameras:
            model.get_outputs_for_camera(camera)
        seconds.append(now() - start)
    return len(cameras) / statistics.median(seconds)
