"""What is counted in a profile of training steps."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
import torch
from torch.autograd import profiler

from benchmarks import launches


def event(name: str, start: float, end: float, device: str, annotation: bool = False) -> SimpleNamespace:
    span = SimpleNamespace(start=start, end=end)
    return SimpleNamespace(
        name=name, time_range=span, device_type=SimpleNamespace(name=device), is_user_annotation=annotation
    )


def test_launches_waits_and_load_of_two_steps():
    cpu, cuda = "CPU", "CUDA"
    counted = launches.summarize(
        [
            event(launches._STEP, 0, 1000, cpu, annotation=True),
            event(launches._STEP, 1000, 2000, cpu, annotation=True),
            event(launches._STEP, 100, 2200, cuda, annotation=True),
            event("a kernel", 100, 300, cuda),
            event("another, beside it", 200, 600, cuda),
            event("Memcpy DtoH (Device -> Pinned)", 700, 800, cuda),
            event("a kernel that outlasts the steps", 1900, 2300, cuda),
            event("cudaEventSynchronize", 250, 650, cpu),
            event("cudaLaunchKernel", 90, 95, cpu),
            event("cuLaunchKernelEx", 1100, 1105, cpu),
            event("cudaMemcpyAsync", 1200, 1205, cpu),
            event("cudaLaunchKernel", 2000, 2005, cpu),  # after the steps
            event("cudaDeviceSynchronize", 2000, 2300, cpu),  # the profile's own
        ]
    )
    assert counted.pop("calls") == {"cudaLaunchKernel": 0.5, "cuLaunchKernelEx": 0.5, "cudaMemcpyAsync": 0.5}
    assert counted == pytest.approx({"launches": 1.5, "waits": 0.5, "wait_milliseconds": 0.2, "busy": 0.35})


def test_a_real_profile_has_the_fields_that_are_read():
    profile = profiler.profile()
    with profile:
        for _ in range(3):
            with profiler.record_function(launches._STEP):
                torch.ones(1000).exp()
    counted = launches.summarize(profile.function_events or ())
    assert counted == {"launches": 0, "calls": {}, "waits": 0, "wait_milliseconds": 0, "busy": None}


def test_without_cuda_nothing_is_trained_or_counted():
    assert launches.measure(SimpleNamespace(device="cpu")) is None
