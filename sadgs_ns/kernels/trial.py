"""The smallest kernel, which shows whether Triton works on a device, and the order in which Triton hashes kernels."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import torch
import triton
import triton.language as tl


@triton.jit
def _write_one(target):
    tl.store(target, 1.0)


def run_trial(device: torch.device) -> None:
    """Run a kernel on a device and wait for it; raise whatever Triton raises, or RuntimeError if it did nothing."""
    hash_kernels()
    target = torch.zeros(1, device=device)
    _write_one[1,](target)
    if float(target) != 1:
        raise RuntimeError("a kernel ran and changed nothing")


def hash_kernels() -> None:
    """Have Triton hash all kernels in a fixed order, before the first launch, so that processes share Triton's cache.

    In Triton 3.6 a kernel's hash, its key in the cache, depends on whether the functions it calls were hashed before.
    """
    for path in sorted(Path(__file__).parent.glob("[!_]*.py")):
        for value in vars(import_module(f"sadgs_ns.kernels.{path.stem}")).values():
            if isinstance(value, triton.JITFunction):
                _ = value.cache_key  # Reading this property computes the hash.
