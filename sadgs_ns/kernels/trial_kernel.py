"""The smallest kernel, to find out whether Triton works."""

# pyright: reportArgumentType=false, reportIndexIssue=false
# (Triton's launch syntax, kernel[grid](...), is not in its types.)

from __future__ import annotations

import torch
import triton
import triton.language as tl


@triton.jit
def _write_one(target):
    tl.store(target, 1.0)


def probe(device: torch.device) -> None:
    """Run a kernel on a device.

    Raises:
        Exception: Whatever Triton raises where it cannot compile or launch one.
        RuntimeError: If the kernel ran and did nothing.
    """
    target = torch.zeros(1, device=device)
    _write_one[1,](target)
    if float(target) != 1:
        raise RuntimeError("a kernel ran and changed nothing")
