"""Split plan and grid split: factors, bounds, cap, moments, optimizer state."""

from __future__ import annotations

import math

import pytest
import torch
from gsplat.utils import normalized_quat_to_rotmat
from torch.testing import assert_close

from helpers.closeness import assert_within_share
from helpers.generators import seeded
from helpers.small_scenes import adam, camera, random_params, splat
from sadgs_ns.distributed.ranking import limit_growth
from sadgs_ns.distributed.world import World
from sadgs_ns.method.split import (
    MAX_CHILDREN_PER_AXIS,
    children_per_axis,
    grid_offsets,
    grid_split,
)


def test_split_factor_is_the_ceiling_of_the_root():
    eta_max = torch.tensor([[0.5, 1.0, 1.01], [4.0, 4.01, 9.5]])
    violates = torch.tensor([[True, True, True], [True, True, False]])
    actual = children_per_axis(eta_max, violates).tolist()
    expected = [[1, 1, 2], [2, 3, 1]]
    assert actual == expected


@pytest.mark.hard_case(
    "a parent whose η asks for any number of children", "gets 8 children an axis at most, 512 in all"
)
@pytest.mark.parametrize("eta_max", [1e3, 1e12, 3e38, math.inf])
def test_no_parent_explodes(eta_max: float):
    counts = children_per_axis(torch.full((1, 3), eta_max), torch.ones(1, 3, dtype=torch.bool))
    assert counts.tolist() == [[MAX_CHILDREN_PER_AXIS] * 3]


def test_budget_goes_to_the_largest_violations():
    growth = torch.tensor([7, 1, 0, 3, 5])
    priority = torch.tensor([2.0, 9.0, 99.0, 4.0, 3.0])
    actual = limit_growth(World(), growth, priority, 9).tolist()
    expected = [False, True, False, True, True]
    assert actual == expected
    actual = limit_growth(World(), growth, priority, 8).tolist()
    expected = [False, True, False, True, False]
    assert actual == expected
    assert not limit_growth(World(), growth, priority, 0).any()
    assert not limit_growth(World(), growth, priority, -5).any()
    actual = limit_growth(World(), growth, priority, 10**9).tolist()
    expected = [True, True, False, True, True]
    assert actual == expected


def test_the_cap_is_never_exceeded():
    generator = seeded(0)
    for budget in range(0, 400, 7):
        growth = torch.randint(0, 60, (50,), generator=generator)
        chosen = limit_growth(World(), growth, torch.rand(50, generator=generator), budget)
        assert int(growth[chosen].sum()) <= budget


def test_grid_is_centred_and_its_variance_completes_the_child_s():
    parents, grid = grid_offsets(torch.tensor([[1, 2, 3], [4, 1, 1]]))
    assert parents.tolist() == [0] * 6 + [1] * 4
    actual = grid[:6].mean(0)
    assert_close(actual, torch.zeros(3))
    expected = torch.tensor([0.0, 1 - 1 / 4, 1 - 1 / 9])  # plus 1/n² of the child itself is 1
    actual = grid[:6].square().mean(0)
    assert_close(actual, expected)
    spacing = grid[7, 0] - grid[6, 0]
    assert float(spacing) == pytest.approx(math.sqrt(12) / 4)


@pytest.mark.parametrize("child_scale", [1.0, 1.5, 1.99])
@pytest.mark.parametrize("counts", [[2, 1, 1], [2, 3, 1], [3, 3, 3], [8, 1, 5]])
def test_split_keeps_the_parent_s_mean_and_covariance(counts: list[int], child_scale: float):
    params = random_params(3, dtype=torch.float64)
    parent = {name: value.detach()[1].clone() for name, value in params.items()}
    n = torch.ones((3, 3), dtype=torch.long)
    n[1] = torch.tensor(counts)
    grid_split(params, adam(params, lr=0.0), {}, n, child_scale=child_scale)
    children = {name: value.detach()[2:] for name, value in params.items()}
    assert len(children["means"]) == math.prod(counts)
    rotation = normalized_quat_to_rotmat(torch.nn.functional.normalize(parent["quats"], dim=-1))
    covariance = rotation @ torch.diag((2 * parent["scales"]).exp()) @ rotation.T
    child_rotation = normalized_quat_to_rotmat(torch.nn.functional.normalize(children["quats"], dim=-1))
    own = child_rotation @ torch.diag_embed((2 * children["scales"]).exp()) @ child_rotation.mT
    offset = children["means"] - parent["means"]
    mixture = own.mean(0) + (offset.T @ offset) / len(offset)
    actual = children["means"].mean(0)
    assert_close(actual, parent["means"], rtol=1e-12, atol=1e-12)
    assert_close(mixture, covariance, rtol=1e-10, atol=1e-14)
    for name in ("features_dc", "quats"):
        expected = parent[name].expand_as(children[name])
        assert_close(children[name], expected)
    if child_scale == 1:  # the paper's are as opaque as the parent
        expected = parent["opacities"].expand_as(children["opacities"])
        assert_close(children["opacities"], expected)
    # And the integral of opacity: opacity times the product of scales.
    mass = [torch.sigmoid(p["opacities"].flatten()) * p["scales"].exp().prod(dim=-1) for p in (parent, children)]
    actual = mass[1].sum()
    expected = mass[0].sum()
    assert_within_share(actual, expected, 1e-12)


@pytest.mark.hard_case(
    "parents of opacity e⁻²⁰⁰ or 1 − e⁻²⁰⁰",
    "children are fainter by 1/k an axis, their logits finite and right to 10⁻⁶",
)
@pytest.mark.parametrize("logit", [-200.0, -30.0, 0.0, 30.0, 200.0])
def test_children_of_extreme_opacity_have_finite_logits(logit: float):
    params = random_params(1)
    params["opacities"].data = torch.tensor([logit])
    grid_split(params, adam(params, lr=0.0), {}, torch.tensor([[2, 3, 1]]), child_scale=1.5)
    share = 1 / 1.5**2
    expected = math.log(share) + logit if logit < 0 else math.log(share / (1 - share))
    if abs(logit) >= 30:
        assert params["opacities"].tolist() == pytest.approx([expected] * 6, rel=1e-6)
    actual = torch.sigmoid(params["opacities"]).tolist()
    assert actual == pytest.approx([share / (1 + math.exp(-logit))] * 6, rel=1e-5)


def test_larger_children_fill_the_gaps_between_them():
    """A flat, faint Gaussian across the view, 2 × 2 in its plane: the picture changes less than half as much."""
    viewmats, Ks = camera(64, 64, focal=64.0)
    errors = []
    for child_scale in (1.0, 1.5):
        params = random_params(1)
        params["means"].data = torch.tensor([[0.0, 0.0, 4.0]])
        params["scales"].data = torch.log(torch.tensor([[1.2, 1.2, 0.01]]))
        params["quats"].data = torch.tensor([[1.0, 0.0, 0.0, 0.0]])
        params["opacities"].data = torch.logit(torch.tensor([0.1]))
        before = splat(params, viewmats, Ks, 64, 64)[1].detach()
        grid_split(params, adam(params, lr=0.0), {}, torch.tensor([[2, 2, 1]]), child_scale=child_scale)
        after = splat(params, viewmats, Ks, 64, 64)[1].detach()
        errors.append(float((after - before).abs().mean() / before.mean()))
    assert errors[1] < 0.5 * errors[0], errors


def test_split_nearly_keeps_the_render():
    """One flat, faint Gaussian across the view, 2 × 2 in its plane: seen at its own resolution, the picture stays.

    Finer than that it does not: children of a grid that keeps the variance stand 3.5 of their own σ apart.
    """
    viewmats, Ks = camera(64, 64, focal=64.0)
    params = random_params(1)
    params["means"].data = torch.tensor([[0.0, 0.0, 4.0]])
    params["scales"].data = torch.log(torch.tensor([[0.5, 0.4, 0.01]]))
    params["quats"].data = torch.tensor([[1.0, 0.0, 0.0, 0.0]])
    params["opacities"].data = torch.logit(torch.tensor([0.1]))

    def alpha() -> torch.Tensor:
        return splat(params, viewmats, Ks, 64, 64)[1].detach()

    before = alpha()
    grid_split(params, adam(params, lr=0.0), {}, torch.tensor([[2, 2, 1]]))
    after = alpha()
    assert len(params["means"]) == 4
    expected = pytest.approx(float(before.sum()), rel=0.05)
    assert float(after.sum()) == expected
    coarse = [torch.nn.functional.avg_pool2d(a.permute(0, 3, 1, 2), 16) for a in (before, after)]  # 16 px: 2 parent σ
    assert float((coarse[1] - coarse[0]).abs().mean()) < 0.15 * float(before.mean())


def test_optimizer_state_and_statistics_follow():
    params = random_params(5)
    optimizers = adam(params)
    state = {"n_total": torch.arange(5.0), "eta_max": torch.arange(15.0).view(5, 3), "scene_scale": 2.0}
    counts = torch.ones((5, 3), dtype=torch.long)
    counts[1, 0] = 2
    counts[3, 2] = 3
    moments = optimizers["means"].state[params["means"]]["exp_avg"].clone()
    kept = [0, 2, 4]
    grid_split(params, optimizers, state, counts)
    for p in params.values():
        assert len(p) == 8
    expected = [0, 2, 4, 0, 0, 0, 0, 0]
    assert state["n_total"].tolist() == expected, "nobody has observed the children"
    actual = state["eta_max"][:3].tolist()
    expected = [[0, 1, 2], [6, 7, 8], [12, 13, 14]]
    assert actual == expected
    assert not state["eta_max"][3:].any()
    for name, optimizer in optimizers.items():
        assert optimizer.param_groups[0]["params"][0] is params[name]
        slots = optimizer.state[params[name]]
        assert slots["exp_avg"].shape == params[name].shape
        assert not slots["exp_avg"][3:].any()
        assert float(slots["step"]) == 1
    actual = optimizers["means"].state[params["means"]]["exp_avg"][:3]
    assert_close(actual, moments[kept])
