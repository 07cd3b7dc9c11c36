"""The network that LPIPS is measured with."""

from __future__ import annotations

import torch

from sadgs_ns.training.run.progress import warn


def load_lpips(device: torch.device) -> torch.nn.Module | None:
    """Return LPIPS (AlexNet), or None with a warning if its weights cannot be loaded."""
    from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity

    try:
        with torch.random.fork_rng(devices=[]):  # Drawing weights must not change training's random state.
            return LearnedPerceptualImagePatchSimilarity(normalize=True).to(device)
    except Exception as error:
        warn(f"LPIPS is not reported: its AlexNet weights could not be loaded ({error}).")
        return None
