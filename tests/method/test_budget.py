"""The budget of a capped run, over densification and at its end."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest
import torch

from examples.drawn_scene import demonstration
from examples.drawn_scene.scene import write_scene
from helpers.gloo_ranks import run_ranks
from helpers.kill_and_resume import configure, set_up
from helpers.small_scenes import adam, random_params, train_on_checker
from sadgs_ns.distributed.world import World
from sadgs_ns.method import budget
from sadgs_ns.method import running_strategy as strategy_module
from sadgs_ns.method.budget import STATE_KEYS, Budget, growth_share
from sadgs_ns.method.growth import MAX_CHILDREN_PER_AXIS, apply, refill
from sadgs_ns.method.running_strategy import empty_state
from sadgs_ns.method.strategy import StructureAwareStrategy

START = 60


def options(**changes: Any) -> StructureAwareStrategy:
    """Densification within 24 steps, which asks for much."""
    defaults: dict[str, Any] = {
        "structure_every": 10, "absgs_every": 4, "refine_start_iter": 2, "refine_stop_iter": 24, "reset_every": 0,
        "eta_every": 1, "split_min_opacity": 0.0, "min_observations": 1, "min_opacity": 0.0,
        "clone_grad2d": 1e-6, "split_absgrad2d": 1e-6,
    }  # fmt: skip
    return StructureAwareStrategy(**{**defaults, **changes})


def train(strategy: StructureAwareStrategy, steps: int = 26) -> tuple[dict[str, Any], dict[str, Any], list[int]]:
    """Train on a fine checker; return parameters, the strategy's state, and the number of Gaussians after each step."""
    params = random_params(START)
    params["scales"].data += 1.0
    state, counts = train_on_checker(strategy, params, steps)
    return params, state, counts


def test_the_allowed_growth_rises_from_nothing_to_all_and_ever_more_slowly():
    shares = torch.tensor([growth_share(part / 16) for part in range(17)])
    assert shares[0] == 0
    assert shares[-1] == 1
    steps = shares.diff()
    assert (steps > 0).all()
    assert (steps.diff() < 0).all()


def test_the_budget_grows_from_the_first_count_and_never_exceeds_the_cap():
    of_run = Budget(1000, {})
    assert of_run.room(200, 0, 0.0) == 0
    assert of_run.room(200, 0, 0.5) == 600
    assert of_run.room(900, 0, 1.0) == 100
    assert Budget(100, {}).room(300, 50, 0.5) == -200, "more at the start than the cap"


def test_what_is_denied_is_followed_to_tell_a_run_that_would_outgrow_its_cap():
    """Half of 400 is denied when 600 are allowed, so that there would be a third more of all that follows."""
    of_run = Budget(1000, {})
    of_run.room(200, 0, 0.0)
    assert of_run.room(400, 400, 0.293) == 200
    assert not of_run.outgrew_cap, "a budget that binds for a time is no cap that does"
    assert of_run.room(600, 140, 0.9) > 140
    assert not of_run.outgrew_cap
    of_run.room(600, 160, 0.9)
    assert of_run.outgrew_cap


@pytest.mark.parametrize("cap", [100, 150, 400])
@pytest.mark.parametrize("gone", ["few", "most"])
def test_a_capped_run_ends_with_its_cap_whatever_the_final_prune_takes(
    cap: int, gone: str, monkeypatch: pytest.MonkeyPatch
):
    """Opacities are drawn between .2 and .9."""
    monkeypatch.setattr(strategy_module, "FINAL_PRUNE_OPACITY", {"few": 0.3, "most": 0.6}[gone])
    _, state, counts = train(options(max_gaussians=cap))
    assert max(counts) == counts[-1] == cap
    assert len(set(counts[3:23])) > 2, "it was not full from the first step on"
    assert not set(STATE_KEYS) & set(state)


def test_a_cap_that_is_never_reached_changes_nothing(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(strategy_module, "FINAL_PRUNE_OPACITY", 0.4)
    slow = {"clone_grad2d": 1e9, "split_absgrad2d": 1e9, "tau_split": 0.9, "structure_every": 20}
    free, _, counts = train(options(max_gaussians=10**9, **slow))
    assert START < max(counts) > counts[-1]
    capped, _, same = train(options(max_gaussians=4 * max(counts), **slow))
    assert counts == same
    for name, parameter in free.items():
        assert torch.equal(parameter, capped[name])


@pytest.mark.parametrize(("room", "grown"), [(5, [1, 2, 3, 4, 5]), (4, [0, 1]), (3, [1, 2, 3]), (1, [1])])
def test_both_rules_are_ranked_together_where_not_all_fits(
    room: int, grown: list[int], monkeypatch: pytest.MonkeyPatch
):
    """An AbsGS step lets five grow by one each, and where one has no room, another by η, which needs three: √16 / 3."""
    monkeypatch.setattr(budget, "growth_share", lambda progress: 1.0)
    params = random_params(7)
    before = params["means"].detach().clone()
    state: dict[str, Any] = {"scene_scale": 1e-3, **empty_state(7, torch.device("cpu"))}
    state["n_total"] += 10
    state["n_high"][0, 0] = 10.0
    state["eta_max"][0, 0] = 16.0
    state["absgrad2d"] += 1e-6 * torch.tensor([0.0, 2.0, 1.24, 1.23, 1.22, 1.21, 0.9])
    state["grad_count"] += 1
    strategy = options(max_gaussians=7 + room)
    strategy.for_run(3000).densify(params, adam(params, lr=0.0), state, 3, [])
    stayed = (before[:, None] == params["means"].detach()[None]).all(dim=2).any(dim=1)
    assert (~stayed).nonzero()[:, 0].tolist() == grown


@pytest.mark.parametrize(("share", "parts"), [(0.3, 2), (1.0, 2), (1.5, 3), (50.0, MAX_CHILDREN_PER_AXIS)])
def test_what_fills_the_cap_cuts_the_longest_axis_into_as_many_parts_as_it_takes(share: float, parts: int):
    params = random_params(20)
    state = {"scene_scale": 1.0, **empty_state(20, torch.device("cpu"))}
    proposal = refill(options(), params, state, share)
    assert proposal.growth.tolist() == [parts - 1] * 20
    apply(proposal, torch.ones(20, dtype=torch.bool), params, adam(params), state)
    assert len(params["means"]) == 20 * parts
    for p in params.values():
        assert p.isfinite().all()


def test_what_fills_the_cap_starts_with_the_steepest_and_ends_with_the_smallest_eta():
    params = random_params(5)
    state: dict[str, Any] = {"scene_scale": 1.0, **empty_state(5, torch.device("cpu"))}
    state["absgrad2d"] += torch.tensor([1.0, torch.nan, 3.0, 0.0, 0.0])
    state["eta_max"][3:, 0] = torch.tensor([20.0, 30.0])
    state["grad_count"] += 1
    priority = refill(options(), params, state, 0.5).priority
    actual = priority.argsort(descending=True).tolist()
    expected = [2, 0, 4, 3, 1]
    assert actual == expected


def densify_together(world: World, cap: int) -> tuple[list[int], list[int]]:
    """Densify without training, by statistics that follow from the places of Gaussians.

    Returns:
        The numbers of Gaussians of all processes after each step, and the largest one of a process at the end.
    """
    params = random_params(START)
    part = slice(0, START)
    if not world.is_single:
        part = world.take_even_part(START)
    params = {name: torch.nn.Parameter(value.detach()[part].clone()) for name, value in params.items()}
    optimizers = adam(params, lr=0.0)
    strategy = options(max_gaussians=cap).for_run(3000, world)
    state: dict[str, Any] = {"scene_scale": 1.0, **empty_state(len(params["means"]), torch.device("cpu"))}
    counts = []
    for step in range(24):
        distance = params["means"].detach().norm(dim=1)
        if "n_total" in state:
            state["absgrad2d"] = distance * 1e-3
            state["grad_count"] = torch.ones_like(distance)
            state["n_total"] = torch.full_like(distance, 10.0)
            state["n_high"] = 10.0 * (params["means"].detach() > 0.5)
            state["eta_max"] = params["means"].detach().abs() * 4
        strategy.densify(params, optimizers, state, step, [])
        counts.append(world.sums(len(params["means"]))[0])
    return counts, world.sizes


def test_several_processes_agree_on_the_budget(tmp_path: Path):
    counts, _ = densify_together(World(), 300)
    assert counts[-1] == 300
    assert len(set(counts)) > 4
    for together, sizes in run_ranks(densify_together, 2, tmp_path / "meet", 300):
        assert together == counts
        assert sum(sizes) == 300


def test_a_resumed_run_goes_on_with_its_budget(scene: Path, tmp_path: Path):
    """Checkpoints are after 8, 16 and 24 iterations; densification ends after 15."""
    config = configure(scene, tmp_path / "whole", 24, save_every=8)
    config.save_only_latest_checkpoint = False
    strategy = config.pipeline.model.strategy
    strategy.clone_grad2d /= 100
    strategy.split_absgrad2d /= 100
    strategy.max_gaussians = 2100
    whole = set_up(config)
    start = whole.pipeline.model.num_points
    whole.train()
    again = copy.deepcopy(config)
    again.output_dir = tmp_path / "resumed"
    again.load_dir = config.get_checkpoint_dir()
    again.load_step = 8
    resumed = set_up(again)
    state = resumed.pipeline.model.strategy_state
    assert state["first_count"] == start < 2000
    assert set(STATE_KEYS) <= set(state)
    resumed.train()
    assert 1995 <= whole.pipeline.model.num_points <= 2100
    for name, parameter in whole.pipeline.model.gauss_params.items():
        assert torch.equal(parameter, resumed.pipeline.model.gauss_params[name])


@pytest.mark.hard_case("a cap at which growth stops early", "it is filled again after the last prune")
def test_a_capped_run_on_the_drawn_scene_ends_with_its_cap(tmp_path: Path):
    write_scene(tmp_path / "scene", width=80, height=60, views=10)
    config = demonstration.run_config(tmp_path, "sadgs", iterations=60, max_gaussians=3000)
    config.pipeline.model.strategy.clone_grad2d /= 10
    config.pipeline.model.strategy.split_absgrad2d /= 10
    run = demonstration.train(config, lambda step: None)
    assert 2850 <= run.pipeline.model.num_points <= 3000
