"""What a training step asks of the GPU, counted by torch's profiler: launches, waits of the host, and its load."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import Any

import torch
from torch.autograd import profiler

from benchmarks.phases import WARMUP, steps_after_run, train_step, within_densification

STEPS = 20
"""Steps that are counted, at least."""
_STEP = "benchmarks.launches"
"""Name of a step's range in the profile."""
_WAITS = ("cudaStreamSynchronize", "cudaEventSynchronize", "cudaDeviceSynchronize", "cudaMemcpy", "cuStreamSynchronize")
"""Calls in which the host waits for the device."""
_LAUNCHES = ("cudaLaunchKernel", "cudaLaunchKernelExC", "cuLaunchKernel", "cuLaunchKernelEx", "cudaGraphLaunch")
_LAUNCHES += ("cudaMemcpyAsync", "cudaMemsetAsync")
"""Calls in which the host gives the device something to do."""


def measure(trainer: Any, steps: int = STEPS) -> dict[str, Any] | None:
    """Train some steps as `phases.measure` does, under torch's profiler, and `summarize` them; None without CUDA.

    The profiler makes the host slower, so without it the device is busier than `busy` says.
    """
    if torch.device(trainer.device).type != "cuda":
        return None
    measured = steps_after_run(trainer, steps)
    with within_densification(trainer.pipeline.model):
        for step in range(measured.start - WARMUP, measured.start):
            train_step(trainer, step)
        profile = profiler.profile(use_device="cuda")
        with profile:
            for step in measured:
                with profiler.record_function(_STEP):
                    train_step(trainer, step)
            torch.cuda.synchronize()
    return summarize(profile.function_events or ())


def summarize(events: Iterable[Any]) -> dict[str, Any]:
    """Return means of a step in a profile of torch's, whose events have times in µs.

    `launches` counts kernels, copies and fills that the host asked for, a graph as one, and `calls` the same by the
    name of CUDA's function. `waits` counts calls in which the host waited for the device, for `wait_milliseconds`.
    `busy` is the share of all steps' time in which the device worked; None where the profiler saw nothing of it, which
    some drivers forbid.
    """
    events = list(events)
    ranges = [e.time_range for e in events if e.name == _STEP and e.device_type.name == "CPU"]
    steps, start, end = len(ranges), min(r.start for r in ranges), max(r.end for r in ranges)
    # The profiler draws the host's named ranges on the device's timeline, too.
    work = [e for e in events if e.device_type.name == "CUDA" and not e.is_user_annotation]
    calls = [e for e in events if start <= e.time_range.start < end]
    waits = [e for e in calls if e.name in _WAITS]
    busy, until = 0.0, start
    for span in sorted((e.time_range for e in work), key=lambda span: span.start):
        busy += max(min(span.end, end) - max(span.start, until), 0.0)
        until = max(until, span.end)
    launched = Counter(e.name for e in calls if e.name in _LAUNCHES)
    return {
        "launches": launched.total() / steps,
        "calls": {name: number / steps for name, number in launched.items()},
        "waits": len(waits) / steps,
        "wait_milliseconds": sum(e.time_range.end - e.time_range.start for e in waits) / steps / 1000,
        "busy": busy / (end - start) if work else None,
    }
