"""The kernel that quantizes structure tensors against torch."""

from __future__ import annotations

import math

import pytest
import torch

from helpers.recorded_calls import record_calls
from sadgs_ns import kernels
from sadgs_ns.method.quantization import quantize

quantization = pytest.importorskip("sadgs_ns.kernels.quantization", reason="Triton is not installed")

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")


def test_quantized_tensors_are_the_references_or_their_neighbours(monkeypatch):
    tensor = torch.rand((3, 100, 3), generator=torch.Generator().manual_seed(0)) ** 8 * torch.tensor([16.0, 1.0, 16.0])
    tensor[0, :4] = torch.tensor([[0.0, 0, 0], [64, 0, 1e-12], [0, 0.1, 1], [8, -9, 8]])
    tensor[1, :4] = torch.tensor([[math.nan] * 3, [math.nan, 0, 1], [1, math.nan, 1], [1, 0, math.nan]])  # masked
    with kernels.triton_switched(False):
        expected = quantize(tensor).int()
    calls = record_calls(monkeypatch, quantization, "quantize")
    with kernels.triton_switched(True):
        actual = quantize(tensor.to(DEVICE)).cpu().int()
    assert len(calls) == 1
    assert (actual - expected).abs().max() <= 1
    assert (actual != expected).float().mean() < 0.01
    assert torch.equal(actual[:2, :4], expected[:2, :4])
