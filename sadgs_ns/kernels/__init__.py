"""Triton kernels for CUDA. Each computes what a torch function of the same name does; tests hold both together."""

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

OLDEST_TRITON = (3, 5)
"""Older versions do not compile all of the kernels: Triton 3.4 has no matrix products with 8 columns."""

TILE_SIZE = 8
"""Size of our rasterizer's tiles in px. gsplat's default of 16 saves list entries; with exact lists, saved pixels
matter more (docs/results.md#parts-of-a-step). Each lane of the one warp that a tile gets has two pixels."""
SWITCH = "SADGS_TRITON"
"""Environment variable that keeps a process from using the kernels where it is 0."""

_forced: bool | None = False if os.environ.get(SWITCH) == "0" else None
"""What `use_triton` answers; None where the device decides."""
_working: set[torch.device] = set()
"""Devices on which a kernel has run."""
_asked: Counter[torch.device] = Counter()
"""How often `available` was asked about a device while no kernel had run there."""


def cdiv(number: int, block: int) -> int:
    """Return how many blocks cover a number. `triton.cdiv` takes the host some 5 µs, twenty times a step."""
    return -(-number // block)


def switched_off() -> bool:
    """Whether this process does without the kernels wherever it computes."""
    return _forced is False


def use_triton(place: torch.device | Tensor) -> bool:
    """Whether to compute with the kernels of this package. Otherwise torch and gsplat compute the same, more slowly.

    Args:
        place: The device on which is computed, or a tensor that a kernel would read: the kernels know float32 alone.
    """
    if isinstance(place, Tensor):
        if place.dtype != torch.float32:
            return False
        place = place.device
    return available(place) if _forced is None else _forced


@contextmanager
def triton_switched(on: bool) -> Iterator[None]:
    """Use the kernels on every device, or on none, within a block of code.

    Without CUDA, Triton runs them in its interpreter if `TRITON_INTERPRET` is 1 when they are imported.

    Args:
        on: What `use_triton` answers, to tensors of float32 at least.
    """
    global _forced
    before, _forced = _forced, on
    try:
        yield
    finally:
        _forced = before


def available(device: torch.device) -> bool:
    """Whether the kernels run on a device.

    They do if it is CUDA's current device, on which Triton launches whatever tensors it is given, and if Triton, which
    comes with torch, compiles for it: Triton also needs a C compiler, Python's headers and a GPU that it knows. One
    small kernel is tried. Success is remembered. A failure may pass, as that of a full memory does, so the kernel is
    tried again when the question is asked for the 2nd, 4th, 8th, … time; a warning tells the first failure.
    """
    if device.type != "cuda" or device.index not in (None, torch.cuda.current_device()):
        return False
    return _compiles(torch.device("cuda", torch.cuda.current_device()))


@cache
def _has_triton() -> bool:
    """Whether Triton is installed and new enough, which does not change while Python runs."""
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
    """Whether a small kernel has run on a device, or does so now."""
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
