"""Triton kernels for CUDA. Tests compare each with its twin: a torch function of the same name, or gsplat's code."""

from __future__ import annotations

import os
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib.util import find_spec

import torch
from torch import Tensor

from sadgs_ns.errors import reason

OLDEST_TRITON = (3, 5)  # Older versions do not compile all kernels: Triton 3.4 has no matrix products with 8 columns

TILE_SIZE = 8
"""Side of our rasterizer's tiles in px. gsplat's default of 16 saves list entries; with exact lists, saved pixels
matter more. A tile has one warp, and each of its lanes two pixels."""
SWITCH = "SADGS_TRITON"  # Environment variable; 0 keeps a process from using the kernels

_forced: bool | None = False if os.environ.get(SWITCH) == "0" else None  # Of `use_triton`; None: the device decides.
_working: set[torch.device] = set()  # Devices on which a kernel has run
_asked: Counter[torch.device] = Counter()  # Calls of `available` for a device on which no kernel had run


def cdiv(number: int, block: int) -> int:
    """Return how many blocks cover a number; `triton.cdiv` takes the host some 5 µs, twenty times a step."""
    return -(-number // block)


def switched_off() -> bool:
    """Return whether this process uses no kernels on any device."""
    return _forced is False


def use_triton(place: torch.device | Tensor) -> bool:
    """Return whether to use the kernels of this package; torch and gsplat compute the same, more slowly.

    `place` is the device that computes, or a tensor that a kernel would read, which must be float32. With another
    backend than Triton's, everything but projection and compositing still uses these kernels.
    """
    if isinstance(place, Tensor):
        if place.dtype != torch.float32:
            return False
        place = place.device
    if _forced is not None:
        return _forced
    return available(place)


@contextmanager
def triton_switched(on: bool) -> Iterator[None]:
    """Use the kernels for float32 on every device, or on none, within a block of code.

    Without CUDA, Triton runs them in its interpreter if `TRITON_INTERPRET` is 1 when they are imported.
    """
    global _forced
    before = _forced
    _forced = on
    try:
        yield
    finally:
        _forced = before


def available(device: torch.device) -> bool:
    """Return whether the kernels run on a device.

    It must be CUDA's current device, on which Triton launches any tensors, and Triton must compile for it, which needs
    a C compiler, Python's headers and a GPU that Triton knows. One small kernel is tried, and success is remembered. A
    failure may pass, so it is tried again at the 2nd, 4th, 8th, … call. Only the first failure warns.
    """
    if device.type != "cuda" or device.index not in (None, torch.cuda.current_device()):
        return False
    return _compiles(torch.device("cuda", torch.cuda.current_device()))


@cache
def _has_triton() -> bool:
    """Return whether Triton is installed and new enough, which does not change while Python runs."""
    if find_spec("triton") is None:
        return False
    import triton

    if tuple(map(int, triton.__version__.split(".")[:2])) >= OLDEST_TRITON:
        return True
    oldest = ".".join(map(str, OLDEST_TRITON))
    warnings.warn(
        f"Triton's kernels do not run here: {triton.__version__} is older than {oldest} (torch 2.9); "
        "training takes about twice as long.",
        stacklevel=4,
    )
    return False


def _compiles(device: torch.device) -> bool:
    """Return whether a small kernel has run on a device, or does so now."""
    if device in _working:
        return True
    if not _has_triton():
        return False
    _asked[device] += 1
    if _asked[device] & (_asked[device] - 1):  # no power of two
        return False
    try:
        from sadgs_ns.kernels.trial import run_trial

        run_trial(device)
    except Exception as error:  # Triton, the C compiler and CUDA each raise their own
        if _asked[device] == 1:
            warnings.warn(
                f"Triton's kernels do not run here ({reason(error)}); they are tried again now and then.", stacklevel=3
            )
        return False
    _working.add(device)
    return True
