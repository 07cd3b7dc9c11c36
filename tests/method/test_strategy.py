"""The strategy in a plain gsplat training loop, its schedule, AbsGS's two thresholds, and the cap."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch
import torch.nn.functional as F
from gsplat.strategy.base import Strategy
from torch.testing import assert_close

from helpers.small_scenes import adam, camera, random_params, training_step
from sadgs_ns.method import budget, growth
from sadgs_ns.method import running_strategy as strategy_module
from sadgs_ns.method.growth import RULES, Proposal, Rule, absgs, apply
from sadgs_ns.method.schedule import Windows
from sadgs_ns.method.screen_gradients import accumulate_gradients, empty_gradients
from sadgs_ns.method.statistics import STATISTICS, Statistic, empty_statistics
from sadgs_ns.method.strategy import StructureAwareStrategy
from sadgs_ns.method.structure_tensor import multiscale_structure_tensor

WIDTH = 64
HEIGHT = 48


@pytest.fixture(autouse=True)
def no_final_prune(monkeypatch: pytest.MonkeyPatch) -> None:
    """Faint Gaussians stay at the end of densification, where a test does not say otherwise."""
    monkeypatch.setattr(strategy_module, "FINAL_PRUNE_OPACITY", 0.0)


@pytest.fixture
def whole_cap(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first step may use all of the cap."""
    monkeypatch.setattr(budget, "growth_share", lambda progress: 1.0)


def checker_images(views: int) -> torch.Tensor:
    """[C, H, W, 3]"""
    y, x = torch.meshgrid(torch.arange(HEIGHT), torch.arange(WIDTH), indexing="ij")
    checker = ((x // 4 + y // 4) % 2).float()
    return (0.25 + 0.5 * checker)[None, ..., None].repeat(views, 1, 1, 3)


def train(
    options: StructureAwareStrategy,
    steps: int,
    *,
    strategy: Any = None,
    per_axis_radii: bool = False,
    views: int = 1,
    n: int = 60,
):
    """A training loop as gsplat's own, without nerfstudio; the hard cap is checked after every step.

    It trains with the options themselves, or with a strategy that was made of them.
    """
    strategy = options if strategy is None else strategy
    torch.manual_seed(0)
    params = random_params(n)
    params["scales"].data += 1.0  # up to 10 px, against squares of 4 px
    optimizers = adam(params)
    strategy.check_sanity(params, optimizers)
    state = strategy.initialize_state(scene_scale=1.0)
    images = checker_images(views)
    tensors = multiscale_structure_tensor(images)
    viewmats, Ks = (matrix.repeat(views, 1, 1) for matrix in camera(WIDTH, HEIGHT))
    viewmats[:, 0, 3] = torch.linspace(-0.2, 0.2, views)
    counts = []
    for step in range(steps):
        training_step(
            strategy, params, optimizers, state, step, images, tensors, viewmats, Ks, per_axis_radii=per_axis_radii
        )
        counts.append(len(params["means"]))
        assert counts[-1] <= options.max_gaussians
        assert all(len(value) == counts[-1] for value in state.values() if isinstance(value, torch.Tensor))
        for p in params.values():
            assert p.isfinite().all()
    return params, state, counts


def short(**changes: Any) -> StructureAwareStrategy:
    """The schedule of 3,000 iterations, a hundredth as long."""
    defaults: dict[str, Any] = {
        "structure_every": 10, "absgs_every": 4, "refine_start_iter": 2, "refine_stop_iter": 24, "reset_every": 0,
        "eta_every": 1, "split_min_opacity": 0.0, "min_observations": 1, "min_opacity": 0.0,
    }  # fmt: skip
    return StructureAwareStrategy(**{**defaults, **changes})


@pytest.mark.parametrize("per_axis_radii", [False, True], ids=["gsplat 1.4", "gsplat 1.5"])
@pytest.mark.parametrize("views", [1, 2])
def test_drops_into_a_plain_gsplat_loop(per_axis_radii: bool, views: int):
    _, state, counts = train(short(max_gaussians=3000), 22, per_axis_radii=per_axis_radii, views=views)
    assert counts[-1] > 120, "a fine checker under coarse Gaussians must be split"
    assert {"n_high", "n_low", "eta_max", "n_total", "grad2d", "absgrad2d", "grad_count"} <= set(state)


def test_options_densify_as_the_strategy_that_is_made_of_them():
    options = short(max_gaussians=3000)
    strategy = options.for_run(3000)
    assert isinstance(options, Strategy)
    assert isinstance(strategy, Strategy)
    params, state, counts = train(options, 26)
    same_params, same_state, same_counts = train(options, 26, strategy=strategy)
    assert counts == same_counts
    assert state == same_state
    for name, parameter in params.items():
        assert torch.equal(parameter, same_params[name])


def test_structure_step_splits_in_one_step_and_forgets_the_parents():
    _, state, counts = train(short(absgs_every=0, tau_split=0.3), 12)
    assert counts[8] == 60
    assert counts[9] > 100
    assert float(state["n_total"].max()) <= 2, "two steps since the split"


def test_over_a_run_no_gaussian_has_more_observations_than_iterations_of_life():
    """Ages are kept beside Adam's moments, which gsplat's operations and ours begin anew for every new Gaussian."""
    strategy = short(max_gaussians=3000, clone_grad2d=1e-5, split_absgrad2d=1e-5, tau_split=0.3, min_observations=3)
    params = random_params(60)
    params["scales"].data += 1.0
    optimizers = adam(params)
    state = strategy.initialize_state(scene_scale=1.0)
    optimizers["means"].state[params["means"]]["age"] = torch.zeros(60)
    images = checker_images(1)
    viewmats, Ks = camera(WIDTH, HEIGHT)
    tensors = multiscale_structure_tensor(images)
    newborn = observed = 0
    for step in range(strategy.windows.refine_stop_iter - 1):
        optimizers["means"].state[params["means"]]["age"] += 1
        training_step(strategy, params, optimizers, state, step, images, tensors, viewmats, Ks)
        age = optimizers["means"].state[params["means"]]["age"]
        assert len(age) == len(state["n_total"]) == len(params["means"])
        assert (state["n_total"] <= age).all(), f"iteration {step + 1}"
        for name in ("n_high", "n_low"):
            assert (state[name] <= state["n_total"][:, None]).all()
        assert not state["eta_max"][state["n_total"] == 0].any()
        newborn = newborn + int((age == 0).sum())
        observed = observed + int((state["n_total"] > 0).sum())
    assert newborn > 100
    assert observed > 1000


def test_a_statistic_is_added_in_one_entry_and_stays_with_its_gaussians(monkeypatch: pytest.MonkeyPatch):
    """The sum of η, which clones, splits, a structure step and pruning keep in step with the Gaussians."""
    monkeypatch.setitem(STATISTICS, "eta_sum", Statistic((3,), lambda values, eta: values.add_(eta.nansum(0))))
    growing = {"clone_grad2d": 1e-3, "split_absgrad2d": 2e-3, "min_opacity": 0.1, "refine_stop_iter": 30}
    _, state, counts = train(short(max_gaussians=3000, **growing), 24)
    assert counts[9] > 5 * counts[8], "split in a structure step, and pruned in another"
    assert counts[23] < counts[22], "split in a structure step, and pruned in another"
    eta_sum = state["eta_sum"]
    eta_max = state["eta_max"]
    n_total = state["n_total"]
    assert (n_total > 1).any(), "clones and children of the last step"
    assert (n_total == 0).any(), "clones and children of the last step"
    assert (eta_max * (1 - 1e-5) <= eta_sum).all()
    assert (eta_sum <= eta_max * n_total[:, None] * (1 + 1e-5)).all()
    _, state, _ = train(short(), 26)
    assert "eta_sum" not in state, "it ends with densification, like the others"


def test_a_state_that_lacks_a_statistic_starts_anew(monkeypatch: pytest.MonkeyPatch):
    """As of a checkpoint that a version without the statistic wrote."""
    strategy = short()
    params = random_params(60)
    optimizers = adam(params)
    state = strategy.initialize_state(scene_scale=1.0)
    images = checker_images(1)
    tensors = multiscale_structure_tensor(images)
    scene = (images, tensors, *camera(WIDTH, HEIGHT))
    for step in range(2):
        training_step(strategy, params, optimizers, state, step, *scene)
    assert state["n_total"].max() == 2
    monkeypatch.setitem(STATISTICS, "eta_sum", Statistic((3,), lambda values, eta: values.add_(eta.nansum(0))))
    training_step(strategy, params, optimizers, state, 2, *scene)
    assert state["n_total"].max() == 1
    assert torch.equal(state["eta_sum"], state["eta_max"])


def longest(options: Any, params: Any, state: Any) -> Proposal:
    """A rule of growth: halve the longest axis of all, the longest first."""
    scales = params["scales"].detach()
    return Proposal(1 + F.one_hot(scales.argmax(dim=1), 3), scales.exp().amax(dim=1))


@pytest.mark.usefixtures("whole_cap")
def test_a_rule_of_growth_is_added_in_one_entry_and_keeps_to_the_cap(monkeypatch: pytest.MonkeyPatch):
    """It leaves gradients to AbsGS."""
    monkeypatch.setitem(RULES, "longest", Rule(lambda windows: 3, longest))
    strategy = short(max_gaussians=200, structure_every=0, clone_grad2d=1e9, split_absgrad2d=1e9)
    running = strategy.for_run(3000)
    assert running.densifies(2)
    assert running.densifies(3)
    assert not running.densifies(4)
    _, state, counts = train(strategy, 11)
    assert counts == [60, 60, 120, 120, 120, *[200] * 6]
    assert state["grad_count"].any(), "AbsGS will read them at iteration 12"
    assert strategy.needs_absgrad(9), "AbsGS will read them at iteration 12"


@pytest.mark.usefixtures("whole_cap")
@pytest.mark.parametrize("reads", [None, "statistics", "gradients"])
def test_a_rule_of_growth_may_stand_alone(reads: Any, monkeypatch: pytest.MonkeyPatch):
    rules = {"longest": Rule(lambda windows: 10, longest, reads)}
    for module in (growth, strategy_module):
        monkeypatch.setattr(module, "RULES", rules)
    strategy = short(max_gaussians=100)
    _, _, counts = train(strategy, 26)
    assert counts == [60] * 9 + [100] * 17
    running = strategy.for_run(3000)
    assert running.observes(0) == (reads == "statistics")
    assert running.needs_absgrad(0) == (reads == "gradients")


def recorded(asked: list[tuple[str, int]], name: str, propose: Any) -> Any:
    """A rule's proposal, which notes its name and the number of Gaussians at that time."""

    def propose_and_record(options: Any, params: Any, state: Any) -> Proposal:
        asked.append((name, len(params["means"])))
        return propose(options, params, state)

    return propose_and_record


@pytest.mark.usefixtures("whole_cap")
def test_rules_that_are_due_together_share_the_budget_of_a_step(monkeypatch: pytest.MonkeyPatch):
    """The cap leaves room for 40: half is the first rule's, and what it leaves is the second one's."""
    asked: list[tuple[str, int]] = []
    for name, rule in list(RULES.items()):
        proposal = recorded(asked, name, absgs if name == "absgs" else longest)
        monkeypatch.setitem(RULES, name, replace(rule, propose=proposal))
    monkeypatch.setitem(RULES, "longest", Rule(lambda windows: 5, recorded(asked, "longest", longest)))
    strategy = short(max_gaussians=100, absgs_every=5, clone_grad2d=1e-9, split_absgrad2d=1e-9, structure_every=10)
    _, state, counts = train(strategy, 5)
    assert asked == [("absgs", 60), ("structure", 60), ("longest", 80)], "AbsGS's is ranked together with η's"
    assert counts[-1] == 100
    assert not state["grad_count"].any(), "AbsGS has read them"
    asked.clear()
    strategy.max_gaussians = 1000
    _, state, counts = train(strategy, 10)
    expected = [("structure", counts[8]), ("longest", 2 * counts[8])]
    assert asked[2:] == expected, "a structure step replaces AbsGS"
    (step,) = state["structure_steps"]
    assert step["split"] == counts[8]
    assert step["after"] == counts[9]


@pytest.mark.parametrize("cap", [60, 61, 150, 400])
def test_the_hard_cap_holds_at_every_step(cap: int):
    _, _, counts = train(short(max_gaussians=cap), 26)
    assert max(counts) <= cap
    if cap >= 150:
        assert max(counts) > 60


def test_nothing_happens_outside_the_window():
    _, _, counts = train(short(refine_start_iter=12, refine_stop_iter=14, absgs_every=0), 26)
    assert set(counts) == {60}
    _, _, counts = train(short(refine_start_iter=12, refine_stop_iter=20, absgs_every=0), 26)
    assert counts[18] == 60
    assert counts[19] > 60
    assert len(set(counts[19:])) == 1


def test_window_fits_short_runs_and_keeps_long_ones():
    for length, expected in ((3000, 1600), (300, 190), (30_000, 1600)):
        strategy = StructureAwareStrategy(refine_stop_iter=1600).for_run(length)
        assert strategy.windows.refine_stop_iter == expected


def test_windows_follow_the_length_of_the_run_but_for_those_that_are_given():
    strategy = StructureAwareStrategy(reset_every=0, eta_every=7)
    expected = Windows(
        structure_every=1000, absgs_every=200, refine_start_iter=200, refine_stop_iter=3200, reset_every=0, eta_every=7
    )
    assert strategy.for_run(6000).windows == expected
    fitted = strategy.fitted(3000)
    assert fitted.windows.structure_every == fitted.structure_every == strategy.windows.structure_every == 500
    assert strategy.structure_every is None
    assert fitted.fitted(3000) == fitted
    assert strategy.for_run(3000) == fitted.for_run(3000)
    assert strategy.for_run(3000).windows == fitted.windows


def test_a_run_too_short_to_densify_prepares_nothing_for_it():
    strategy = StructureAwareStrategy(structure_every=50, absgs_every=10, refine_start_iter=500)
    strategy = strategy.for_run(700)  # 443 would be before 500
    for step in range(700):
        assert not (strategy.observes(step) or strategy.needs_absgrad(step))
    assert strategy.windows.refine_stop_iter == 0


def test_eta_is_observed_only_where_a_structure_step_will_read_it():
    strategy = StructureAwareStrategy(structure_every=500, refine_stop_iter=1900, eta_every=10).for_run(3000)
    assert strategy.observes(0)
    assert strategy.observes(1490)
    assert not strategy.observes(5)
    assert not strategy.observes(1500)
    assert not strategy.observes(2500)


def test_gradients_are_kept_only_where_an_absgs_step_will_read_them():
    strategy = StructureAwareStrategy(refine_start_iter=100, absgs_every=100, structure_every=500)
    strategy.refine_stop_iter = 1600
    needed = {step + 1 for step in range(3000) if strategy.needs_absgrad(step)}  # iterations
    expected = set(range(1, 401)) | set(range(501, 901)) | set(range(1001, 1401)) | set(range(1501, 1601))
    assert needed == expected
    strategy.structure_every = 0
    for step in range(3000):
        assert strategy.needs_absgrad(step) == (step < 1600)
    strategy.absgs_every = 0
    for step in range(3000):
        assert not strategy.needs_absgrad(step)


def test_keeping_all_gradients_changes_nothing(monkeypatch: pytest.MonkeyPatch):
    thrifty = short(clone_grad2d=2e-5, split_absgrad2d=4e-5)
    plain, _, counts = train(thrifty, 26)
    hoarder = thrifty.for_run(3000)
    assert not all(hoarder.needs_absgrad(step) for step in range(24))
    monkeypatch.setattr(hoarder, "needs_absgrad", lambda step: step < hoarder.windows.refine_stop_iter)
    hoarded, _, same = train(thrifty, 26, strategy=hoarder)
    assert counts == same
    assert counts[3] > 60
    assert counts[9] > counts[8]
    for name, parameter in plain.items():
        assert torch.equal(parameter, hoarded[name])


def test_opacity_schedule(monkeypatch: pytest.MonkeyPatch):
    def opacities(**changes: Any) -> torch.Tensor:
        params, _, _ = train(short(absgs_every=0, structure_every=0, **changes), 20)
        return torch.sigmoid(params["opacities"]).detach()

    plain = opacities()
    reset = opacities(reset_every=20, refine_stop_iter=30)
    assert_close(reset, 0.1 * plain, rtol=1e-4, atol=1e-5)
    monkeypatch.setattr(strategy_module, "CLAMP_OPACITY", 0.5)
    clamped, _, _ = train(short(absgs_every=0, tau_split=1.0), 10)
    assert torch.sigmoid(clamped["opacities"]).max() <= 0.5 + 1e-6


def test_no_reset_so_late_that_the_final_prune_takes_everything():
    """1,900 iterations end densification at 1203: a reset at 1200 would leave no time to recover."""
    late, _, _ = train(short(absgs_every=0, structure_every=0, reset_every=20, refine_stop_iter=21), 20)
    plain, _, _ = train(short(absgs_every=0, structure_every=0), 20)
    assert_close(late["opacities"], plain["opacities"])


def test_statistics_end_with_densification():
    _, state, _ = train(short(max_gaussians=3000), 26)
    assert set(state) == {"scene_scale", "structure_steps"}


def test_final_prune_removes_the_faint_once(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(strategy_module, "FINAL_PRUNE_OPACITY", 0.5)
    params, _, counts = train(short(absgs_every=0, structure_every=0), 26)
    assert counts[22] == 60
    assert 0 < counts[23] < 60
    assert len(set(counts[23:])) == 1
    assert len(params["means"]) == counts[-1]


@pytest.mark.parametrize("end", ["with a structure step", "without"])
def test_the_final_prune_spares_children_of_what_it_would_have_kept(end: str, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(strategy_module, "FINAL_PRUNE_OPACITY", 0.1)
    params = random_params(4)
    params["opacities"].data = torch.logit(torch.tensor([0.05, 0.12, 0.5, 0.12]))
    state = {"scene_scale": 1.0, **empty_statistics(4, torch.device("cpu")), **empty_gradients(4, torch.device("cpu"))}
    state["n_total"] += 10
    # All but the last are split in two.
    state["n_high"][:3, 0] = 10.0
    state["eta_max"][:3, 0] = 4.0
    stop = 20 if end == "with a structure step" else 21
    strategy = short(refine_stop_iter=stop, structure_every=20, absgs_every=0, child_scale=1.5, reset_every=0)
    optimizers = adam(params, lr=0.0)
    strategy.step_post_backward(params, optimizers, state, 19, [])
    # 0.12 / 1.5 is under the final prune's 0.1: at the very end such children are new, later they had their chance.
    faint = params["opacities"].sigmoid() < 0.1
    parents = state["structure_steps"][0]["split"]
    if end == "with a structure step":
        assert parents == 2
        assert len(faint) == 5
        assert faint.sum() == 2
    else:
        assert parents == 3
        assert len(faint) == 7
        strategy.step_post_backward(params, optimizers, state, 20, [])
        assert len(params["means"]) == 3
        assert (params["opacities"].sigmoid() >= 0.1).all()


def test_low_eta_and_low_opacity_together_prune(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(strategy_module, "CLAMP_OPACITY", 1.0)
    params = random_params(4)
    params["opacities"].data = torch.logit(torch.tensor([0.05, 0.05, 0.5, 0.05]))
    state = {"scene_scale": 1.0, **empty_statistics(4, torch.device("cpu")), **empty_gradients(4, torch.device("cpu"))}
    state["n_total"] += 10
    state["n_low"][[0, 2]] = 10.0  # 0: low and faint; 1: faint only; 2: low only
    state["n_low"][3] = torch.tensor([10.0, 10.0, 0.0])  # 3: faint, but one axis is not low
    optimizers = adam(params, lr=0.0)
    keep = params["means"].detach()[1:].clone()
    short().for_run(3000).densify(params, optimizers, state, 9, [])
    actual = params["means"].detach()
    assert_close(actual, keep)


def test_pruning_never_leaves_nothing():
    params = random_params(5)
    n = short().for_run(3000)._prune(params, adam(params), {}, 1.0)
    assert n == 0
    assert len(params["means"]) == 5


def gradient_state(grad: list[float], absgrad: list[float]) -> dict[str, Any]:
    return {"grad2d": torch.tensor(grad), "absgrad2d": torch.tensor(absgrad), "grad_count": torch.ones(len(grad))}


def grow_with(params, state, budget: int = 1000, long_axis: bool = False) -> tuple[int, int]:
    """Numbers of clones and splits of an AbsGS step; Gaussians are small up to a scale of .1."""
    options = {"clone_grad2d": 2e-4, "split_absgrad2d": 4e-4, "absgs_long_axis": long_axis}
    strategy = StructureAwareStrategy(max_gaussians=len(params["means"]) + budget, **options)
    state["scene_scale"] = 100.0
    proposal, allowed = strategy.for_run(3000).planned_growth(absgs, params, state)
    apply(proposal, allowed, params, adam(params, lr=0.0), state)
    assert proposal.clone is not None
    return int((allowed & proposal.clone).sum()), int((allowed & ~proposal.clone).sum())


def test_absgs_clones_on_the_mean_and_splits_on_the_absolute_gradient():
    """The two thresholds of AbsGS: a small Gaussian looks at one gradient, a large one at the other."""
    params = random_params(4)
    params["scales"].data = torch.log(torch.tensor([[0.05], [0.05], [0.5], [0.5]])).repeat(1, 3)
    # Small: cloned by its mean gradient, not by its absolute one. Large: split by the absolute one only.
    state = gradient_state([3e-4, 1e-4, 3e-4, 0.0], [0.0, 9e-4, 3e-4, 5e-4])
    assert grow_with(params, state) == (1, 1)
    assert len(params["means"]) == 6
    scales = params["scales"].exp()[:, 0]
    actual = scales.sort().values
    expected = torch.tensor([0.05, 0.05, 0.05, 0.3125, 0.3125, 0.5])
    assert_close(actual, expected)


def test_absgs_halves_the_longest_axis_in_its_place():
    params = random_params(4)
    params["scales"].data = torch.log(torch.tensor([[0.05, 0.05, 0.05], [0.2, 0.4, 0.8], [0.5, 0.3, 0.1], [1, 1, 1]]))
    params["quats"].data = torch.tensor([[1.0, 0, 0, 0]]).repeat(4, 1)
    before = {name: parameter.detach().clone() for name, parameter in params.items()}
    state = gradient_state([3e-4, 0.0, 0.0, 0.0], [0.0, 9e-4, 5e-4, 1e-4])
    assert grow_with(params, state, long_axis=True) == (1, 2)  # the first is small, the last has too small a gradient
    children = {name: parameter.detach()[3:].unflatten(0, (2, 2)) for name, parameter in params.items()}
    parents = {name: value[[1, 2]] for name, value in before.items()}
    axes = torch.tensor([[0.0, 0, 1], [1, 0, 0]])
    actual = children["scales"].exp()
    expected = (parents["scales"].exp() * (0.8 - 0.3 * axes))[:, None].repeat(1, 2, 1)
    assert_close(actual, expected)
    actual = children["means"].mean(dim=1)
    assert_close(actual, parents["means"])
    offset = (children["means"][:, 1] - children["means"][:, 0]) / 2
    assert_close(offset.abs(), axes * parents["scales"].exp() * 0.75**0.5)  # which keeps the covariance
    for name in ("quats", "opacities", "features_dc"):
        expected = parents[name][:, None].expand_as(children[name])
        assert_close(children[name], expected)


@pytest.mark.hard_case(
    "a Gaussian that AbsGS splits or clones", "its children and its clone start with empty statistics"
)
@pytest.mark.parametrize("long_axis", [True, False])
def test_absgs_leaves_statistics_with_the_gaussians_that_were_observed(long_axis: bool):
    """A parent of η = 20, halved four times, would ask for 5 cells an axis; each child is seen anew."""
    params = random_params(3)
    params["scales"].data = torch.log(torch.tensor([[0.05], [0.8], [0.7]])).repeat(1, 3)
    state = gradient_state([3e-4, 0.0, 0.0], [0.0, 9e-4, 1e-4]) | empty_statistics(3, torch.device("cpu"))
    for name in ("n_high", "eta_max", "n_total"):
        state[name] += torch.tensor([1.0, 20.0, 3.0]).view(3, *[1] * (state[name].dim() - 1))
    actual = grow_with(params, state, long_axis=long_axis)
    assert actual == (1, 1)
    assert state["n_total"].tolist() == [1, 3, 0, 0, 0], "the cloned, the one left whole, the clone, two children"
    for name in ("n_high", "n_low", "eta_max"):
        assert not state[name][2:].any()
    assert state["eta_max"][:2, 0].tolist() == [1, 3]


def test_absgs_spends_a_budget_on_the_steepest():
    params = random_params(3)
    params["scales"].data.fill_(-5.0)
    means = params["means"].detach().clone()
    actual = grow_with(params, gradient_state([3e-4, 9e-4, 4e-4], [0.0] * 3), budget=1)
    assert actual == (1, 0)
    actual = params["means"].detach()[3]
    assert_close(actual, means[1])


def test_gradients_are_normalised_as_in_3dgs():
    """Half the image per unit, times the number of views that the loss is a mean of; only where visible."""
    means2d = torch.zeros(2, 3, 2)
    means2d.grad = torch.tensor([3.0, 4.0]).expand(2, 3, 2) / torch.tensor([32.0, 24.0]) / 2
    means2d.absgrad = 2 * means2d.grad  # type: ignore[attr-defined]
    info = {"means2d": means2d, "radii": torch.tensor([[1, 1, 0], [0, 2, 0]]), "width": 64, "height": 48}
    gradients = empty_gradients(3, torch.device("cpu"))
    accumulate_gradients(gradients, info, num_views=2)
    expected = torch.tensor([5.0, 10.0, 0.0])
    assert_close(gradients["grad2d"], expected)
    expected = torch.tensor([10.0, 20.0, 0.0])
    assert_close(gradients["absgrad2d"], expected)
    assert gradients["grad_count"].tolist() == [1, 2, 0]


def test_wrong_use_is_named():
    params = random_params(3)
    strategy = StructureAwareStrategy()
    with pytest.raises(ValueError, match=r"packed=False"):
        strategy.step_post_backward(params, adam(params), strategy.initialize_state(), 0, {}, packed=True)
    del params["quats"]
    with pytest.raises(ValueError, match="lack \\['quats'\\]"):
        strategy.check_sanity(params, adam(params))


def test_what_would_be_split_now_keeps_to_the_cap():
    statistics = empty_statistics(3, torch.device("cpu"))
    statistics["n_total"][:] = 1
    statistics["eta_max"][0, 0] = 4.0
    statistics["eta_max"][1, 1] = 9.0
    statistics["n_high"][:] = (statistics["eta_max"] > 1).to(statistics["n_high"])
    params = random_params(3)
    strategy = StructureAwareStrategy(max_gaussians=6, min_observations=1, split_min_opacity=0.0)

    def planned() -> torch.Tensor:
        return strategy.for_run(3000).planned_children(params, statistics)

    expected = [[2, 1, 1], [1, 3, 1], [1, 1, 1]]
    assert planned().tolist() == expected
    strategy.max_gaussians = 5  # room for two more: √4 for one comes before √9 for two
    expected = [[2, 1, 1], [1, 1, 1], [1, 1, 1]]
    assert planned().tolist() == expected
    strategy.max_gaussians = 2
    assert (planned() == 1).all()
    strategy.max_gaussians = 6
    strategy.min_observations = 2
    assert (planned() == 1).all(), "one observation is no consistency"
    strategy.min_observations = 1
    strategy.split_min_opacity = 0.5
    params["opacities"].data = torch.logit(torch.tensor([0.4, 0.6, 0.6]))
    expected = [[1, 1, 1], [1, 3, 1], [1, 1, 1]]
    assert planned().tolist() == expected
