"""Leave random Gaussians out of each training step, so that few views cannot make many Gaussians fit noise together.

Co-adapted Gaussians cancel each other's errors in the training views alone. What is left out at random cannot be relied
upon (DropGaussian, CVPR 2025). How many a run leaves out follows from how often it renders each view
(`schedule.dropout`).
"""

from __future__ import annotations

import torch

from sadgs_ns.render.types import Gaussians

MOST_OPACITY = 0.999
"""Largest opacity of a Gaussian that stays, since opacities are raised for those that are left out."""
_STEPS_OF_A_SEED = 1_000_003
"""Steps after which a run draws the numbers of the next seed's run, a prime."""
_SEEDS = 2**32
"""Number of seeds that torch's generator on the CPU tells apart."""


class Dropout:
    """Leaves each Gaussian out of a step with one probability. The step alone decides which, so that runs can resume.

    Attributes:
        rate: The probability, in [0, 1).
        generator: Draws the numbers. CUDA graphs must register it (cuda_graphs.py).
    """

    def __init__(self, rate: float, seed: int, device: torch.device) -> None:
        self.rate = rate
        self.generator = torch.Generator(device)
        self._seed = seed

    def begin(self, step: int) -> None:
        """Choose the numbers of a step; this does not wait for the device."""
        self.generator.manual_seed((self._seed * _STEPS_OF_A_SEED + step) % _SEEDS)

    def apply(self, gaussians: Gaussians) -> Gaussians:
        """Return the Gaussians with an opacity of 0, or with one that is 1 / (1 − rate) as large.

        An image's mean opacity is about the same, whichever are left out.
        """
        opacities = gaussians.opacities
        numbers = torch.rand(opacities.shape, generator=self.generator, device=opacities.device)
        factors = (numbers >= self.rate).to(opacities.dtype) / (1 - self.rate)
        return gaussians._replace(opacities=(opacities * factors).clamp(max=MOST_OPACITY))
