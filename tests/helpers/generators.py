"""Random numbers that are the same in each run of a test."""

from __future__ import annotations

import torch


def seeded(seed: int) -> torch.Generator:
    """A generator of torch's random numbers on the CPU."""
    return torch.Generator().manual_seed(seed)
