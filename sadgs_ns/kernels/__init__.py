"""Triton kernels for CUDA; each computes what a torch function beside it computes, and a test holds both together."""

from __future__ import annotations

import warnings
from functools import cache
from importlib.util import find_spec

import torch

OLDEST_TRITON = (3, 5)
"""Older ones do not compile all of the kernels: 3.4 knows no matrix products with 8 columns."""


def available(device: torch.device) -> bool:
    """Whether the kernels run on this device: it is CUDA's current one, on which Triton launches whatever tensors it is
    given, and Triton, which comes with torch, compiles for it."""
    return device.type == "cuda" and device.index in (None, torch.cuda.current_device()) and _compiles(device)


@cache
def _compiles(device: torch.device) -> bool:
    """Try a small kernel once: Triton also needs a C compiler, Python's headers and a GPU that it knows."""
    if find_spec("triton") is None:
        return False
    import triton

    if tuple(map(int, triton.__version__.split(".")[:2])) < OLDEST_TRITON:
        oldest = ".".join(map(str, OLDEST_TRITON))
        warnings.warn(
            f"Triton's kernels do not run here: {triton.__version__} is older than {oldest} (torch 2.9); "
            "training takes about twice as long.",
            stacklevel=3,
        )
        return False
    try:
        from sadgs_ns.kernels.trial_kernel import probe

        probe(device)
    except Exception as error:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        warnings.warn(f"Triton's kernels do not run here: {reason}", stacklevel=3)
        return False
    return True
