"""Triton kernels for CUDA; each computes what a torch function beside it computes, and a test holds both together."""

from __future__ import annotations

from importlib.util import find_spec

import torch


def available(device: torch.device) -> bool:
    """Whether tensors on this device can go through the kernels: it is CUDA, and Triton came with torch."""
    return device.type == "cuda" and find_spec("triton") is not None
