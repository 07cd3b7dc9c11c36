"""The kernel that observes η against torch, and the statistics that follow."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from helpers import small_scenes
from helpers.recorded_calls import record_calls
from sadgs_ns import kernels
from sadgs_ns.method.quantization import quantize
from sadgs_ns.method.statistics import STATISTICS, Statistic, empty_statistics, observe, observed_eta

observation = pytest.importorskip("sadgs_ns.kernels.statistics", reason="Triton is not installed")

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")


@pytest.mark.parametrize("per_axis_radii", [False, True], ids=["gsplat 1.4", "gsplat 1.5"])
@pytest.mark.parametrize("kept", [Tensor.half, quantize], ids=["float16", "8 bits"])
def test_observation_equals_the_reference(monkeypatch, kept, per_axis_radii):
    n = 150
    width = 40
    height = 30
    params = {name: p.detach() for name, p in small_scenes.random_params(n).items()}
    params["scales"][::9] += 3  # reaches over the border
    params["means"][::13, 2] = -1  # behind the camera
    viewmats, Ks = small_scenes.camera(width, height, focal=40.0)
    viewmats = viewmats.repeat(2, 1, 1)
    Ks = Ks.repeat(2, 1, 1)
    viewmats[1, :3, :3] = torch.linalg.qr(torch.eye(3) + 0.1)[0]
    viewmats[1, :3, 3] = torch.tensor([0.1, -0.2, 0.5])
    _, _, info = small_scenes.splat(
        {name: torch.nn.Parameter(p) for name, p in params.items()}, viewmats, Ks, width, height
    )
    radius = info["radii"] if info["radii"].dim() == 2 else info["radii"].amin(dim=-1)
    info["radii"] = torch.stack([radius, 2 * radius], dim=-1) if per_axis_radii else radius
    generator = torch.Generator().manual_seed(0)
    factors = torch.randn((2, height, width, 2, 2), generator=generator)
    tensors = factors @ factors.mT
    info |= {"viewmats": viewmats, "Ks": Ks}
    tensors = torch.stack([tensors[..., 0, 0], tensors[..., 0, 1], tensors[..., 1, 1]], -1)
    tensors[:, :, 18:22] = math.nan  # masked
    info["structure_tensors"] = kept(tensors)
    # Whoever adds a statistic adds it in one place.
    monkeypatch.setitem(STATISTICS, "log_sum", Statistic((3,), lambda values, eta: values.add_(eta.log1p().nansum(0))))
    on_device = {name: torch.nn.Parameter(value.to(DEVICE)) for name, value in params.items()}
    info = {k: value.detach().to(DEVICE) if isinstance(value, Tensor) else value for k, value in info.items()}
    jitters = torch.rand((2, 2, n, 2), generator=generator).to(DEVICE)
    results = []
    calls = record_calls(monkeypatch, observation, "observed_eta")
    for fused in (False, True):
        statistics = empty_statistics(n, torch.device(DEVICE))
        with kernels.triton_switched(fused):
            for jitter in jitters:
                observe(statistics, on_device, info, jitter=jitter)
            results.append((observed_eta(on_device, info, jitters[0]), statistics))
        assert len(calls) == 3 * fused
    (expected, reference), (eta, fast) = results
    torch.testing.assert_close(eta, expected, atol=1e-6, rtol=2e-5, equal_nan=True)
    assert torch.equal(eta.isnan().any(dim=2), eta.isnan().all(dim=2))
    assert 0 < eta.isnan().sum() < eta.numel()
    assert reference["n_total"].sum() > n / 2
    assert reference["n_low"].sum() > 0
    assert reference["n_high"].sum() > 0
    assert (reference["n_total"] == 0).any()
    assert reference["log_sum"].sum() > 0
    assert fast.keys() == reference.keys() == STATISTICS.keys()
    for name in STATISTICS:
        if name.startswith("n_"):
            assert torch.equal(fast[name], reference[name]), name
        torch.testing.assert_close(fast[name], reference[name], atol=1e-6, rtol=2e-5)
