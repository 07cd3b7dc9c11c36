"""The kernel that adds up screen gradients against torch."""

from __future__ import annotations

import math

import pytest
import torch

from helpers.recorded_calls import record_calls
from sadgs_ns import kernels
from sadgs_ns.method.screen_gradients import accumulate_gradients, empty_gradients

screen_gradients = pytest.importorskip("sadgs_ns.kernels.screen_gradients", reason="Triton is not installed")

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")


@pytest.mark.parametrize("layout", ["parts of rows", "apart", "transposed"])
@pytest.mark.parametrize("per_axis_radii", [False, True], ids=["gsplat 1.4", "gsplat 1.5"])
def test_screen_gradients_add_up_as_in_the_reference(monkeypatch, per_axis_radii, layout):
    views = 3
    n = 300
    generator = torch.Generator().manual_seed(0)
    rows = torch.randn((views, n, 12), generator=generator)
    rows[0, 1, :2] = math.nan
    rows[1, 2, 10] = math.nan
    rows[2, 3, 9] = math.inf
    radii = torch.randint(-1, 4, (views, n, 2), generator=generator, dtype=torch.int32)
    radii[:, 1:4] = 1
    radii[:, 5] = 0
    radii = radii if per_axis_radii else radii[..., 1].contiguous()
    rows = rows.to(DEVICE)  # before it is cut: a copy of a part would lie apart
    parts = [rows[..., :2], rows[..., 9:11]]
    if layout == "apart":
        parts = [part.contiguous() for part in parts]
    elif layout == "transposed":
        parts = [part.mT.contiguous().mT for part in parts]
    results = []
    calls = record_calls(monkeypatch, screen_gradients, "accumulate_gradients")
    for fused in (False, True):
        means2d = torch.zeros((views, n, 2), device=DEVICE)
        means2d.grad, means2d.absgrad = parts  # type: ignore[attr-defined]
        info = {"means2d": means2d, "radii": radii.to(DEVICE), "width": 64, "height": 48}
        sums = empty_gradients(n, DEVICE)
        for _ in range(2):
            with kernels.triton_switched(fused):
                accumulate_gradients(sums, info, num_views=views)
        results.append(sums)
        assert len(calls) == 2 * fused
    reference, fast = results
    actual = set(reference["grad_count"].unique().tolist())
    assert actual == {0, 2, 4, 6}
    assert reference["grad2d"][5] == 0
    assert reference["absgrad2d"].isinf().nonzero().tolist() == [[3]]
    assert not reference["grad2d"].isnan().any()
    assert torch.equal(fast.pop("grad_count"), reference["grad_count"])
    for name, value in fast.items():
        torch.testing.assert_close(value, reference[name], atol=1e-5, rtol=1e-6)
