"""Which processes and devices use the Triton kernels, and what happens if Triton fails."""

from __future__ import annotations

import os
import subprocess
import sys
from collections import Counter

import pytest
import torch

from sadgs_ns import kernels

triton = pytest.importorskip("triton", reason="Triton is not installed")

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")


@pytest.mark.hard_case(
    "a process started with `SADGS_TRITON=0`", "uses no Triton kernel, on whichever device it computes"
)
def test_the_environment_switches_the_kernels_off():
    code = "import torch; from sadgs_ns import kernels; kernels.available = lambda device: True; "
    code += "print(kernels.switched_off(), kernels.use_triton(torch.device('cuda')), kernels.use_triton(torch.ones(1)))"
    for value, expected in (("0", "True False False"), ("1", "False True True")):
        environment = {**os.environ, kernels.SWITCH: value}
        process = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
        assert process.stdout.split("\n")[0] == expected, process.stderr


def test_a_test_can_switch_the_kernels_either_way_but_doubles_never_reach_them():
    floats = torch.ones(1)
    doubles = torch.ones(1, dtype=torch.float64)
    for on in (True, False):
        with kernels.triton_switched(on):
            assert kernels.use_triton(floats) is kernels.use_triton(floats.device) is on
            assert not kernels.use_triton(doubles)
    assert kernels.use_triton(floats.device) is kernels.available(floats.device)


def test_kernels_are_for_the_current_cuda_device_only(monkeypatch):
    monkeypatch.setattr(kernels, "_compiles", lambda device: True)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 1)
    names = ("cpu", "cuda", "cuda:0", "cuda:1")
    actual = [kernels.available(torch.device(name)) for name in names]
    assert actual == [False, True, False, True]


@pytest.fixture
def nothing_tried(monkeypatch):
    """A process in which nobody has asked for the kernels."""
    monkeypatch.setattr(kernels, "_working", set())
    monkeypatch.setattr(kernels, "_asked", Counter())
    kernels._has_triton.cache_clear()
    yield
    kernels._has_triton.cache_clear()


def test_a_triton_that_compiles_is_found(nothing_tried):
    assert kernels._compiles(DEVICE)


@pytest.mark.hard_case("a trial of Triton that fails once", "told once, tried again")
def test_a_failure_is_told_once_and_tried_again_and_a_success_is_kept(nothing_tried, monkeypatch):
    """The trial fails twice, as while another program fills the memory, and is made at questions 1, 2 and 4."""
    outcomes = [RuntimeError("CUDA error: out of memory.\nCompile with …"), RuntimeError("out of memory"), None]

    def run_trial(device):
        outcome = outcomes.pop(0)
        if outcome is not None:
            raise outcome

    monkeypatch.setattr("sadgs_ns.kernels.trial.run_trial", run_trial)
    with pytest.warns(
        UserWarning, match=r"do not run here \(CUDA error: out of memory\); they are tried again"
    ) as told:
        answers = [kernels._compiles(DEVICE) for _ in range(20)]
    assert answers == [False] * 3 + [True] * 17
    assert len(told) == 1
    assert not outcomes


@pytest.mark.hard_case("a trial of Triton that fails for good", "told once, tried again ever more rarely")
def test_a_failure_that_lasts_is_tried_at_ever_longer_intervals(nothing_tried, monkeypatch):
    trials = []
    monkeypatch.setattr("sadgs_ns.kernels.trial.run_trial", lambda device: trials.append(device) or 1 / 0)
    with pytest.warns(UserWarning, match=r"\(division by zero\)"):
        for _ in range(1000):
            assert not kernels._compiles(DEVICE)
    assert len(trials) == 10


def test_an_old_triton_is_left_alone_and_named(nothing_tried, monkeypatch):
    monkeypatch.setattr("triton.__version__", "3.4.0")
    with pytest.warns(UserWarning, match=r"do not run here: 3\.4\.0 is older than 3\.5 \(torch 2\.9\);") as told:
        for _ in range(10):
            assert not kernels._compiles(DEVICE)
    assert len(told) == 1
