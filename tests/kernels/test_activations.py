"""The kernels of the activations against torch in float64."""

from __future__ import annotations

import pytest
import torch

from helpers.recorded_calls import record_calls
from sadgs_ns import kernels
from sadgs_ns.render.activations import activate

activations = pytest.importorskip("sadgs_ns.kernels.activations", reason="Triton is not installed")

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")


@pytest.mark.parametrize("used", ["scales", "opacities", "penalty", "scales opacities penalty"])
@pytest.mark.parametrize("n", [1, 37, 1024, 2050])
def test_activations_and_their_gradients_equal_torchs_in_float64(monkeypatch, n, used):
    generator = torch.Generator().manual_seed(n)
    log_scales = torch.randn((n, 3), generator=generator)
    logits = torch.randn((n, 1), generator=generator)
    weights = torch.randn((n, 12), generator=generator)
    logits[0] = -12.0
    log_scales[0] = torch.tensor([-9.0, 3.0, 0.0])
    penalty = 0.3 if "penalty" in used else 0.0
    calls = record_calls(monkeypatch, activations, "activate")
    results = []
    for fused, dtype in ((True, torch.float32), (False, torch.float64)):
        inputs = [value.to(DEVICE, dtype, copy=True).requires_grad_() for value in (log_scales, logits)]
        with kernels.triton_switched(fused):
            scales, opacities, penalized = activate(inputs[0], inputs[1], penalty)
        assert scales.shape == (n, 3)
        assert opacities.shape == (n,)
        assert (penalized is None) is (penalty == 0)
        rows = weights.to(DEVICE, dtype)
        outputs = {"scales": (scales, rows[:, :3]), "opacities": (opacities, rows[:, 5])}  # as compositing returns them
        if penalized is not None:
            outputs["penalty"] = penalized, torch.full_like(penalized, 1.7)
        chosen = [outputs[name] for name in used.split()]
        torch.autograd.backward([output for output, _ in chosen], [gradient for _, gradient in chosen])
        whole = [scales, opacities] if penalized is None else [scales, opacities, penalized.sum()]
        results.append([value.detach().double() for value in whole])
        results[-1] += [
            torch.zeros_like(value).double() if value.grad is None else value.grad.double() for value in inputs
        ]
    assert len(calls) == 1
    torch.testing.assert_close(*results, atol=1e-9, rtol=3e-6)
