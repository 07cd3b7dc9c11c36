"""Multiview statistics by hand-made cases, in both of gsplat's info shapes."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch.testing import assert_close

from helpers.small_scenes import camera, random_params, splat
from sadgs_ns.method import statistics as statistics_of_eta
from sadgs_ns.method.quantization import quantize
from sadgs_ns.method.statistics import consistent, empty_statistics
from sadgs_ns.method.structure_tensor import multiscale_structure_tensor

WIDTH = 64
HEIGHT = 48


def forward(params, structure_tensor: list[float], per_axis_radii: bool, views: int = 1) -> dict[str, Any]:
    """gsplat's info of a forward pass in front of images of uniform S̄."""
    viewmats, Ks = (matrix.repeat(views, 1, 1) for matrix in camera(WIDTH, HEIGHT))
    _, _, info = splat(params, viewmats, Ks, WIDTH, HEIGHT, per_axis_radii=per_axis_radii)
    tensors = torch.tensor(structure_tensor).expand(views, HEIGHT, WIDTH, 3)
    return {**info, "viewmats": viewmats, "Ks": Ks, "structure_tensors": tensors}


def observe(statistics, params, info):
    statistics_of_eta.observe(statistics, params, info, torch.rand(info["means2d"].shape))


def three_gaussians():
    """In view, behind the camera and beside the image. Axes of 15, 1.5 and 0 px on the screen (the last in depth)."""
    params = random_params(3)
    params["means"].data = torch.tensor([[0.0, 0.0, 4.0], [0.0, 0.0, -4.0], [40.0, 0.0, 4.0]])
    params["scales"].data = torch.log(torch.tensor([[1.0, 0.1, 0.01]])).repeat(3, 1)
    params["quats"].data = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(3, 1)
    return params


@pytest.mark.parametrize("per_axis_radii", [False, True])
def test_counts_by_hand(per_axis_radii: bool):
    params = three_gaussians()
    statistics = empty_statistics(3, torch.device("cpu"))
    coarse = [0.01, 0.0, 0.0]  # Λ of 10 px
    fine = [1.0, 0.0, 0.0]  # Λ of 1 px
    steps = 40
    for structure_tensor in (coarse, fine):
        for _ in range(steps // 2):
            observe(statistics, params, forward(params, structure_tensor, per_axis_radii))
    n = float(statistics["n_total"][0])
    assert 0.8 * steps < n <= steps, "a sample that falls beside the image is no observation"
    # Axis 0: η = 1.5 and 15; axis 1: 0.15 and 1.5; axis 2 points into depth: 0 and 0.
    assert statistics["n_high"][0].tolist()[0] == n
    assert statistics["n_high"][0, 2] == 0
    assert 0 < statistics["n_high"][0, 1] < n
    assert statistics["n_low"][0].tolist() == [0.0, 0.0, n]
    actual = statistics["eta_max"][0]
    expected = torch.tensor([15.0, 1.5, 0.0])
    assert_close(actual, expected, rtol=1e-3, atol=1e-3)
    for key in ("n_total", "n_high", "n_low", "eta_max"):
        assert not statistics[key][1:].any(), "the unseen have no statistics"


def test_two_views_count_twice():
    params = three_gaussians()
    one, two = (empty_statistics(3, torch.device("cpu")) for _ in range(2))
    params["scales"].data = params["scales"].data - 3  # every sample lies inside the image
    observe(one, params, forward(params, [1.0, 0.0, 0.0], False))
    observe(two, params, forward(params, [1.0, 0.0, 0.0], False, views=2))
    assert float(one["n_total"][0]) == 1
    assert float(two["n_total"][0]) == 2


@pytest.mark.hard_case(
    "Gaussians that have faded", "are observed as opaque ones are, so that they can be pruned for low η"
)
def test_faint_gaussians_are_observed_as_opaque_ones_are():
    """Pruning by low η asks about Gaussians that have faded."""
    params = three_gaussians()
    counts = []
    for opacity in (0.01, 0.9):
        params["opacities"].data = torch.logit(torch.full((3,), opacity))
        statistics = empty_statistics(3, torch.device("cpu"))
        torch.manual_seed(0)
        observe(statistics, params, forward(params, [1.0, 0.0, 0.0], False))
        counts.append(statistics["n_total"].tolist())
    assert counts[0] == counts[1]
    assert sum(counts[0]) > 0


def test_textureless_pixels_are_low_not_high():
    params = three_gaussians()
    params["scales"].data.fill_(-3.0)
    statistics = empty_statistics(3, torch.device("cpu"))
    observe(statistics, params, forward(params, [0.0, 0.0, 0.0], False))
    assert statistics["n_low"][0].tolist() == [1.0] * 3
    assert not statistics["n_high"].any()


@pytest.mark.hard_case(
    "a sample on a masked pixel of quantized S̄", "no observation, in the torch code as in the kernel"
)
@pytest.mark.parametrize("kept", [torch.Tensor.half, quantize], ids=["float16", "8 bits"])
def test_masked_pixels_are_no_observation(kept):
    """One half of a smooth image is masked: only the Gaussian over the other half gets its low response."""
    params = three_gaussians()
    params["means"].data = torch.tensor([[-1.0, 0.0, 4.0], [1.0, 0.0, 4.0], [0.0, 0.0, -4.0]])
    params["scales"].data.fill_(-3.0)
    masks = torch.ones((1, HEIGHT, WIDTH), dtype=torch.bool)
    masks[:, :, : WIDTH // 2] = False
    info = forward(params, [0.0, 0.0, 0.0], False)
    info["structure_tensors"] = kept(multiscale_structure_tensor(torch.full((1, HEIGHT, WIDTH, 3), 0.5), masks))
    statistics = empty_statistics(3, torch.device("cpu"))
    observe(statistics, params, info)
    assert statistics["n_total"].tolist() == [0.0, 1.0, 0.0]
    expected = [[0.0] * 3, [1.0] * 3, [0.0] * 3]
    assert statistics["n_low"].tolist() == expected
    assert not statistics["n_high"].any()
    assert (statistics["eta_max"] < 0.1).all()


def test_garbage_of_the_unseen_never_enters():
    """gsplat leaves means2d and conics of culled Gaussians unset: here they are NaN and inf."""
    params = three_gaussians()
    info = forward(params, [1.0, 0.2, 0.5], False)
    info["means2d"] = info["means2d"].detach().clone()
    info["conics"] = info["conics"].detach().clone()
    info["means2d"][:, 1:] = float("nan")
    info["conics"][:, 1:] = float("inf")
    statistics = empty_statistics(3, torch.device("cpu"))
    observe(statistics, params, info)
    for value in statistics.values():
        assert value.isfinite().all()


@pytest.mark.hard_case(
    "an axis that violated in 1 of 1 or 2 of 2 observations",
    "is not split: at least 3 are asked for (`min_observations`)",
)
def test_consistency_is_a_fraction_of_enough_observations():
    counts = torch.tensor([[9.0, 8.0, 0.0], [0.0, 0.0, 0.0]])
    total = torch.tensor([10.0, 0.0])
    actual = consistent(counts, total, 0.8).tolist()
    expected = [[True, False, False], [False, False, False]]
    assert actual == expected
    assert not consistent(counts, total, 0.8, min_observations=11).any(), "fewer observations say nothing"
