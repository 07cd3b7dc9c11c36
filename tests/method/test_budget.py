"""The budget of a capped run, over densification and at its end."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from examples.drawn_scene import demonstration
from examples.drawn_scene.scene import write_scene
from helpers.small_scenes import adam, camera, random_params, training_step
from sadgs_ns.method import running_strategy as strategy_module
from sadgs_ns.method.budget import STATE_KEYS, Budget, growth_share
from sadgs_ns.method.growth import MAX_CHILDREN_PER_AXIS, apply, refill
from sadgs_ns.method.screen_gradients import empty_gradients
from sadgs_ns.method.strategy import StructureAwareStrategy
from sadgs_ns.method.structure_tensor import multiscale_structure_tensor

WIDTH, HEIGHT = 32, 24
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
    torch.manual_seed(0)
    params = random_params(START)
    params["scales"].data += 1.0
    optimizers = adam(params)
    state = strategy.initialize_state()
    y, x = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    image = (0.25 + 0.5 * ((x // 3 + y // 3) % 2).float())[None, ..., None].repeat(1, 1, 1, 3)
    tensors = multiscale_structure_tensor(image)
    viewmats, Ks = camera(WIDTH, HEIGHT, focal=30.0)
    counts = []
    for step in range(steps):
        training_step(strategy, params, optimizers, state, step, image, tensors, viewmats, Ks)
        counts.append(len(params["means"]))
    return params, state, counts


def test_the_allowed_growth_rises_from_nothing_to_all_and_ever_more_slowly():
    shares = torch.tensor([growth_share(part / 16) for part in range(17)])
    assert shares[0] == 0 and shares[-1] == 1
    steps = shares.diff()
    assert (steps > 0).all() and (steps.diff() < 0).all()


def test_the_budget_grows_from_the_first_count_and_never_exceeds_the_cap():
    budget = Budget(1000, {})
    assert budget.room(200, 0, 0.0) == 0
    assert budget.room(200, 0, 0.5) == 600
    assert budget.room(900, 0, 1.0) == 100
    assert Budget(100, {}).room(300, 50, 0.5) == -200, "more at the start than the cap"


def test_what_is_denied_is_followed_to_tell_a_run_that_would_outgrow_its_cap():
    """400 and 450 would have made 850 of 600, and then half as many again: 975 of 1,000."""
    budget = Budget(1000, {})
    budget.room(200, 0, 0.0)
    assert budget.room(400, 450, 0.2929) < 450
    assert not budget.outgrew_cap, "a budget that binds for a time is no cap that does"
    budget.room(600, 100, 0.9)
    assert not budget.outgrew_cap
    budget.room(700, 100, 0.9)
    assert budget.outgrew_cap


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


@pytest.mark.parametrize(("share", "parts"), [(0.3, 2), (1.0, 2), (1.5, 3), (50.0, MAX_CHILDREN_PER_AXIS)])
def test_what_fills_the_cap_cuts_the_longest_axis_into_as_many_parts_as_it_takes(share: float, parts: int):
    params = random_params(20)
    state = {"scene_scale": 1.0, **empty_gradients(20, torch.device("cpu"))}
    proposal = refill(options(), params, state, share)
    assert proposal.growth.tolist() == [parts - 1] * 20
    apply(proposal, torch.ones(20, dtype=torch.bool), params, adam(params), state)
    assert len(params["means"]) == 20 * parts and all(p.isfinite().all() for p in params.values())


def test_what_fills_the_cap_starts_with_the_steepest():
    params = random_params(3)
    state = {"scene_scale": 1.0, **empty_gradients(3, torch.device("cpu"))}
    state["absgrad2d"] += torch.tensor([1.0, torch.nan, 3.0])
    state["grad_count"] += 1
    priority = refill(options(), params, state, 0.5).priority
    assert priority.argsort(descending=True).tolist() == [2, 0, 1]


@pytest.mark.hard_case("a cap at which growth stops early", "it is filled again after the last prune")
def test_a_capped_run_on_the_drawn_scene_ends_with_its_cap(tmp_path: Path):
    write_scene(tmp_path / "scene", width=80, height=60, views=10)
    config = demonstration.run_config(tmp_path, "sadgs", iterations=60, max_gaussians=3000)
    config.pipeline.model.strategy.clone_grad2d /= 10
    config.pipeline.model.strategy.split_absgrad2d /= 10
    run = demonstration.train(config, lambda step: None)
    assert 2850 <= run.pipeline.model.num_points <= 3000
