"""Metrics of held-out views: PSNR, SSIM, and LPIPS if its weights can be loaded."""

from __future__ import annotations

import torch
from nerfstudio.models.splatfacto import SplatfactoModel
from pytorch_msssim import SSIM
from torch import Tensor

from sadgs_ns.training.progress import warn


class MeasuredModel(SplatfactoModel):
    """A splatfacto model that loads the modules and weights of metrics when they are first used."""

    def make_metrics(self) -> None:
        """Make the metrics, which splatfacto would make with its Gaussians."""
        self.ssim = SSIM(data_range=1.0, size_average=True, channel=3)
        self._lpips: list[torch.nn.Module | None] = []  # A list keeps its weights out of the checkpoint.

    def psnr(self, predicted: Tensor, target: Tensor) -> Tensor:
        """Return PSNR in dB of images in [0, 1], [1, 3, H, W] or [H, W, 3]."""
        # The import takes a second, and training does not need it.
        from torchmetrics.functional.image import peak_signal_noise_ratio

        return peak_signal_noise_ratio(predicted, target, data_range=1.0)

    def lpips(self, predicted: Tensor, target: Tensor) -> Tensor:
        """Return LPIPS (AlexNet) of images [1, 3, H, W] in [0, 1], or NaN if its weights cannot be loaded."""
        if not self._lpips:
            self._lpips = [load_lpips(self.device)]
        metric = self._lpips[0]
        return predicted.new_tensor(float("nan")) if metric is None else metric(predicted, target)

    def get_image_metrics_and_images(
        self, outputs: dict[str, Tensor], batch: dict[str, Tensor]
    ) -> tuple[dict[str, float], dict[str, Tensor]]:
        """Return PSNR, SSIM and, if its weights can be loaded, LPIPS of one held-out view."""
        metrics, images = super().get_image_metrics_and_images(outputs, batch)
        return {name: value for name, value in metrics.items() if "lpips" not in name or value == value}, images


def load_lpips(device: torch.device) -> torch.nn.Module | None:
    from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

    try:
        with torch.random.fork_rng(devices=[]):  # Drawing weights must not change training's random state.
            return LearnedPerceptualImagePatchSimilarity(normalize=True).to(device)
    except Exception as error:
        warn(f"LPIPS is not reported: its AlexNet weights could not be loaded ({error}).")
        return None
