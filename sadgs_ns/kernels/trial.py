"""The smallest kernel, which shows whether Triton works on a device."""

from __future__ import annotations

import torch
import triton
import triton.language as tl


@triton.jit
def _write_one(target):
    tl.store(target, 1.0)


def run_trial(device: torch.device) -> None:
    """Run a kernel on a device and wait for it; raise whatever Triton raises, or RuntimeError if it did nothing."""
    target = torch.zeros(1, device=device)
    _write_one[1,](target)
    if float(target) != 1:
        raise RuntimeError("a kernel ran and changed nothing")
