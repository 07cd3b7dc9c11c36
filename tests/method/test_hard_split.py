"""Hard cases of splitting, pruning and optimizing.

`FusedAdam`, which optimizes every parameter of this method, takes a gradient as 0 if it is NaN or its magnitude is 1e18
or more: its square would fill Adam's second moment with infinity, and the parameter would never move again. It does so
at the step itself, number by number; the finite numbers of the same gradient are used. The report follows at most 100
iterations later. With several views in an iteration it names all of them, since their loss is one mean.

The guard does not catch gradients and losses that are wrong but finite; a parameter that is already NaN, as from a
damaged checkpoint; optimizers other than `FusedAdam` put into a config (their losses are still watched); or NaN in
depth, evaluation or viewer, which train nothing.
"""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.scene_box import SceneBox
from torch import Tensor
from torch.testing import assert_close
from torch.utils._python_dispatch import TorchDispatchMode

from helpers.closeness import assert_within
from helpers.generators import seeded
from helpers.kill_and_resume import set_up
from helpers.short_runs import configure, is_finite
from helpers.small_scenes import CHECKER_SIZE, adam, camera, random_params, train_on_checker
from sadgs_ns import kernels
from sadgs_ns.distributed.ranking import limit_growth
from sadgs_ns.distributed.world import World
from sadgs_ns.errors import RunError
from sadgs_ns.geometry.initialization import bounding_box_points, neighbour_scales
from sadgs_ns.gsplat_compat import NEAR_PLANE
from sadgs_ns.method import running_strategy as strategy_module
from sadgs_ns.method.budget import growth_share
from sadgs_ns.method.growth import absgs
from sadgs_ns.method.screen_gradients import accumulate_gradients, empty_gradients
from sadgs_ns.method.split import children_per_axis
from sadgs_ns.method.statistics import empty_statistics
from sadgs_ns.method.strategy import StructureAwareStrategy
from sadgs_ns.render import step_memory
from sadgs_ns.render.step_memory import StepSize
from sadgs_ns.render.types import Cameras
from sadgs_ns.training.config import SadgsModelConfig
from sadgs_ns.training.model import SadgsModel
from sadgs_ns.training.step import nonfinite, train_step
from sadgs_ns.training.step.optimizers import AdamUpdate, FusedAdam
from sadgs_ns.training.step.train_step import ViewGroup

CPU = torch.device("cpu")
WIDTH, HEIGHT = CHECKER_SIZE


def short(**changes: Any) -> StructureAwareStrategy:
    """Densification within 26 steps."""
    defaults: dict[str, Any] = {
        "structure_every": 10, "absgs_every": 4, "refine_start_iter": 2, "refine_stop_iter": 24, "reset_every": 0,
        "eta_every": 1, "split_min_opacity": 0.0, "min_observations": 1, "min_opacity": 0.0, "clone_grad2d": 0.0,
    }  # fmt: skip
    return StructureAwareStrategy(**{**defaults, **changes})


def train(strategy: StructureAwareStrategy, params: dict[str, torch.nn.Parameter], steps: int = 22) -> list[int]:
    """Train in a plain loop on a fine checker, in place; the number of Gaussians after each step."""
    _, counts = train_on_checker(strategy, params, steps)
    return counts


def finite_or_infinite_logits(params: Any) -> bool:
    """Opacities of exactly 0 and 1 are infinite logits; nothing else may be infinite, and nothing NaN."""
    others = all(bool(p.isfinite().all()) for name, p in params.items() if name != "opacities")
    return others and not params["opacities"].isnan().any()


def observed(n: int, eta_max: float) -> dict[str, Any]:
    """A strategy's state in which every axis was seen ten times with one η."""
    state: dict[str, Any] = {"scene_scale": 1.0, **empty_statistics(n, CPU), **empty_gradients(n, CPU)}
    state["n_total"] += 10
    state["n_high"] += 10 * (eta_max > 1)
    state["n_low"] += 10 * (eta_max < 0.1)
    state["eta_max"] += eta_max
    return state


# --- split ---


@pytest.fixture(autouse=True)
def no_final_prune(monkeypatch: pytest.MonkeyPatch) -> None:
    """Faint Gaussians stay at the end of densification, where a test does not say otherwise."""
    monkeypatch.setattr(strategy_module, "FINAL_PRUNE_OPACITY", 0.0)


@pytest.mark.hard_case(
    "η of 10¹², 3·10³⁸ or ∞, on every axis of every Gaussian",
    "the cap is filled as far as whole parents fit, all numbers are finite",
)
@pytest.mark.parametrize("eta_max", [1e12, 3e38, math.inf])
def test_all_violate_beyond_measure_and_fill_the_cap(eta_max: float):
    params = random_params(50)
    state = observed(50, eta_max)
    before = {name: p.detach().clone() for name, p in params.items()}
    cap = 50 + math.ceil((3 * 511 + 100) / growth_share(10 / 24))  # This step may use so much of it.
    short(max_gaussians=cap).for_run(3000).densify(params, adam(params, lr=0.0), state, 9, [])
    assert len(params["means"]) == 50 + 3 * 511, "three parents of 8³ children fit, a fourth does not"
    for p in params.values():
        assert p.isfinite().all()
    actual = params["scales"][47:].amin()
    expected = before["scales"][:3].amin() - math.log(8 / 1.5)
    assert_close(actual, expected)
    assert not any(value.any() for value in state.values() if isinstance(value, Tensor))


@pytest.mark.hard_case("no Gaussian violates", "nothing is split")
@pytest.mark.parametrize("eta_max", [0.5, math.nan])
def test_where_none_violates_nothing_is_split(eta_max: float):
    params = random_params(50)
    state = observed(50, eta_max)
    before = params["means"].detach().clone()
    short().for_run(3000).densify(params, adam(params, lr=0.0), state, 9, [])
    assert torch.equal(params["means"], before)


@pytest.mark.hard_case("η is NaN", "no violation; its axis is not split")
def test_an_eta_that_is_no_number_splits_nothing_even_where_it_counts_as_a_violation():
    eta_max = torch.tensor([[math.nan, 9.0, math.inf]])
    actual = children_per_axis(eta_max, torch.ones(1, 3, dtype=torch.bool)).tolist()
    assert actual == [[1, 3, 8]]


@pytest.mark.hard_case("a huge parent near the cap", "is passed over if it does not fit, and blocks nobody")
def test_a_parent_that_does_not_fit_does_not_block_the_smaller_ones():
    growth = torch.tensor([511, 1, 7, 511, 3])
    priority = torch.tensor([9.0, 1.0, 5.0, 7.0, 6.0])
    actual = limit_growth(World(), growth, priority, 11).tolist()
    expected = [False, True, True, False, True]
    assert actual == expected
    actual = limit_growth(World(), growth, priority, 10).tolist()
    expected = [False, False, True, False, True]
    assert actual == expected
    actual = limit_growth(World(), growth, priority, 520).tolist()
    expected = [True, True, False, False, True]
    assert actual == expected
    assert limit_growth(World(), growth, priority, math.inf).all()


@pytest.mark.hard_case(
    "more violations than the cap allows",
    "each parent is taken, in the order of η, that fits into the room which those before it left over",
)
def test_growth_is_chosen_one_by_one_from_the_largest_violation():
    generator = seeded(0)
    sizes = torch.tensor([0, 1, 2, 3, 7, 26, 63, 511])
    for budget in [-3, 0, 1, 5, 50, 512, 700, 3000, 10**6]:
        growth = sizes[torch.randint(0, 8, (200,), generator=generator)]
        priority = torch.randint(0, 20, (200,), generator=generator).float()  # with ties
        left = budget
        expected = torch.zeros(200, dtype=torch.bool)
        for i in sorted(range(200), key=lambda i: -priority[i]):
            if 0 < growth[i] <= left:
                expected[i] = True
                left = left - int(growth[i])
        assert torch.equal(limit_growth(World(), growth, priority, budget), expected)


@pytest.mark.hard_case("a cap smaller than the initial count, in your own loop", "nothing is added, training goes on")
def test_a_cap_under_the_initial_number_stops_growth_only():
    params = random_params(30)
    start = params["means"].detach().clone()
    actual = train(short(max_gaussians=20), params)
    assert actual == [30] * 22
    assert not torch.equal(params["means"], start)
    for p in params.values():
        assert p.isfinite().all()


@pytest.mark.hard_case("a cap of 0", "refused: `strategy.max_gaussians must be at least 1, got 0.`")
def test_a_cap_that_allows_no_gaussian_is_refused():
    with pytest.raises(ValueError, match=r"strategy\.max_gaussians must be at least 1, got 0\."):
        StructureAwareStrategy(max_gaussians=0).initialize_state()


@pytest.mark.hard_case(
    "`eta_every` or `min_observations` of 0, negative intervals of densification, thresholds NaN", "refused by name"
)
def test_an_interval_of_zero_is_refused_at_the_start():
    with pytest.raises(ValueError, match=r"strategy\.eta_every must be at least 1, got 0\."):
        StructureAwareStrategy(eta_every=0).initialize_state()
    with pytest.raises(ValueError, match=r"strategy\.min_observations must be at least 1, got 0\."):
        StructureAwareStrategy(min_observations=0).initialize_state()
    for option, value in (("structure_every", -1), ("reset_every", -100), ("split_absgrad2d", math.nan)):
        with pytest.raises(ValueError, match=rf"strategy\.{option} must not be negative, got {value}\."):
            dataclasses.replace(StructureAwareStrategy(), **{option: value}).initialize_state()


@pytest.mark.hard_case("a fraction or an opacity out of its range", "refused by name")
@pytest.mark.parametrize(
    ("option", "value", "allowed"),
    [
        ("tau_split", 1.5, r"in \[0, 1\], got 1\.5"), ("split_min_opacity", math.nan, r"in \[0, 1\], got nan"),
        ("min_opacity", -0.1, r"in \[0, 1\], got -0\.1"),
    ],
)  # fmt: skip
def test_an_option_out_of_its_range_is_refused_at_the_start(option: str, value: float, allowed: str):
    with pytest.raises(ValueError, match=rf"strategy\.{option} must be {allowed}\."):
        dataclasses.replace(StructureAwareStrategy(), **{option: value}).initialize_state()


@pytest.mark.hard_case(
    "children as large as their parent, or smaller than the paper's (`child_scale` not in [1, 2))",
    "refused in one sentence",
)
@pytest.mark.parametrize("child_scale", [0.5, 2.0, math.nan])
def test_children_smaller_than_the_papers_or_as_large_as_a_parent_are_refused(child_scale: float):
    with pytest.raises(ValueError, match=r"child_scale must be at least 1 and less than 2, got (0\.5|2|nan)\."):
        StructureAwareStrategy(child_scale=child_scale).initialize_state()


# --- memory ---


@pytest.mark.hard_case("a run without CUDA", "no limit of memory is assumed")
def test_without_cuda_memory_is_not_planned():
    params = random_params(5)
    actual = step_memory.affordable_growth(params, {}, step_memory.free_bytes(CPU), StepSize())
    assert actual == math.inf


@pytest.mark.hard_case("what a new Gaussian keeps in memory", "is counted")
def test_what_is_kept_of_each_new_gaussian_is_counted():
    """Adam's state, the statistics and the parameters with gradients, as they are after a split."""
    params = random_params(50)
    state = observed(50, 4.0)
    optimizers = adam(params)
    for optimizer in optimizers.values():
        optimizer.step()

    def bytes_kept() -> int:
        tensors = [v for v in state.values() if isinstance(v, Tensor)]
        for p, optimizer in zip(params.values(), optimizers.values(), strict=True):
            tensors += [p, p]  # and its gradient
            tensors += [value for value in optimizer.state[p].values() if value.dim() > 0]
        return sum(tensor.numel() * tensor.element_size() for tensor in tensors)

    before = bytes_kept()
    short().for_run(3000).densify(params, optimizers, state, 9, [])
    grown = len(params["means"]) - 50
    assert grown == 50 * 7
    size = StepSize(views=1)
    at_first = max(step_memory.step_bytes(50, size, CPU).values())
    later = max(step_memory.step_bytes(50 + grown, size, CPU).values())
    pairs = step_memory.PAIRS_PER_GAUSSIAN * grown * step_memory.PAIR_SORT_BYTES
    widest = 16  # quaternions
    lists = step_memory.step_bytes(50 + grown, size, CPU)["tile lists"] + pairs
    needed = bytes_kept() - before + (50 + grown) * widest + max(lists, later)
    original = random_params(50)
    assert step_memory.affordable_growth(original, observed(50, 4.0), needed, size) == grown
    assert step_memory.affordable_growth(original, observed(50, 4.0), needed - 1, size) == grown - 1
    assert step_memory.affordable_growth(original, observed(50, 4.0), at_first, size) == 0


@pytest.mark.hard_case(
    "a split that would not fit in the device's memory",
    "is estimated before anything is made, from the views, pixels and tile pairs of the step before; fewer are "
    "added, the largest violations first; a warning says how many and what to do; training goes on",
)
@pytest.mark.parametrize("room", [0, 20])
def test_a_split_that_would_not_fit_in_memory_is_reduced_with_a_warning_and_training_goes_on(
    room: int, monkeypatch: pytest.MonkeyPatch
):
    asked: list[StepSize] = []

    def scarce(params: Any, state: Any, free: float, size: StepSize) -> int:
        asked.append(size)
        return room

    monkeypatch.setattr(strategy_module, "affordable_growth", scarce)
    params = random_params(30)
    params["scales"].data += 1.0
    with pytest.warns(UserWarning, match=rf"Iteration 10: the device's memory holds {room} more Gaussians") as told:
        numbers = train(short(absgs_every=0, tau_split=0.3, refine_stop_iter=19), params)
    assert numbers[8] == 30
    assert 30 + room // 2 <= numbers[9] <= 30 + room
    assert len(set(numbers[9:])) == 1
    actual = [(size.views, size.pixels) for size in asked]
    assert actual == [(1, WIDTH * HEIGHT)]
    assert asked[0].pairs > 0
    assert len(told) == 1
    for p in params.values():
        assert p.isfinite().all()


@pytest.mark.hard_case("growth by AbsGS that would not fit in memory", "fewer are added, with a warning")
def test_absgs_is_reduced_to_what_fits_in_memory_too(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(strategy_module, "affordable_growth", lambda *arguments: 7)
    params = random_params(30)
    with pytest.warns(UserWarning, match=r"Iteration 4: the device's memory holds 7 more Gaussians"):
        numbers = train(short(structure_every=0, refine_stop_iter=5), params, steps=6)
    assert numbers == [30, 30, 30, 37, 37, 37]


@pytest.mark.hard_case("enough memory", "no warning")
def test_enough_memory_gives_no_warning(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(strategy_module, "free_bytes", lambda device: 1e9)
    params = random_params(30)
    assert train(short(), params)[-1] > 30  # a warning would be an error


# --- few Gaussians ---


@pytest.mark.hard_case("one Gaussian from the start", "trains and splits")
def test_one_gaussian_trains_and_splits():
    params = random_params(1)
    params["means"].data = torch.tensor([[0.0, 0.0, 4.0]])
    params["scales"].data.fill_(0.0)
    numbers = train(short(tau_split=0.3), params)
    assert numbers[0] == 1 < numbers[-1]
    for p in params.values():
        assert p.isfinite().all()


@pytest.mark.hard_case("pruning that leaves one Gaussian", "training goes on")
def test_pruning_may_leave_one():
    params = random_params(5)
    state = observed(5, 0.01)
    params["opacities"].data = torch.logit(torch.tensor([0.01, 0.02, 0.9, 0.03, 0.04]))
    kept = params["means"].detach()[2:3].clone()
    short().for_run(3000).densify(params, adam(params, lr=0.0), state, 9, [])
    assert torch.equal(params["means"], kept)


@pytest.mark.hard_case("a prune that would leave no Gaussian", "is left out, training goes on")
def test_a_prune_that_would_leave_none_is_left_out(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(strategy_module, "FINAL_PRUNE_OPACITY", 0.5)
    params = random_params(6)
    params["opacities"].data.fill_(-9.0)
    numbers = train(short(min_opacity=0.5, clone_grad2d=math.inf), params, steps=26)
    assert numbers == [6] * 26
    for p in params.values():
        assert p.isfinite().all()


@pytest.mark.hard_case(
    "opacities of exactly 0 and 1 (logits ±200, ±∞)",
    "finite everywhere else; 1 is clamped by the next structure step or reset, 0 is pruned",
)
def test_opacities_of_exactly_zero_and_one():
    """Logits of ±200 are 0 and 1 in float32, as are infinite ones."""
    params = random_params(12)
    logits = torch.tensor([200.0, -200.0, math.inf, -math.inf]).repeat(3)
    params["opacities"].data = logits.clone()
    assert set(torch.sigmoid(logits).tolist()) == {0.0, 1.0}
    numbers = train(short(absgs_every=0, structure_every=9, tau_split=1.0), params, 12)
    assert numbers[-1] == 12
    assert finite_or_infinite_logits(params)
    opacities = torch.sigmoid(params["opacities"].detach())
    expected = strategy_module.CLAMP_OPACITY * (logits > 0)
    assert_within(opacities, expected, 0.01)

    params["opacities"].data = logits.clone()
    numbers = train(short(absgs_every=0, tau_split=1.0, min_opacity=0.005, reset_every=11), params, 11)
    assert numbers[-1] == 6, "those of opacity 0 are pruned"
    assert params["opacities"].isfinite().all()
    actual = torch.sigmoid(params["opacities"].detach())
    assert_within(actual, torch.full((6,), 0.1 * strategy_module.CLAMP_OPACITY), 0.01)


# --- initial points ---

CLOUDS = {
    "one": [[0.3, -0.2, 0.1]],
    "two": [[0.0, 0, 0], [1.0, 0.5, 0]],
    "three": [[0.0, 0, 0], [1.0, 0, 0], [0, 1.0, 0.5]],
    "duplicates": [[0.3, -0.2, 0.1]] * 40,
    "pairs of duplicates": [[float(i // 2), i // 2 % 3, i // 2 % 2] for i in range(40)],
    "collinear": [[0.1 * i, 0.0, 0.0] for i in range(40)],
    "coplanar": [[0.1 * (i % 7), 0.1 * (i // 7), 0.5] for i in range(42)],
}


@pytest.mark.hard_case(
    "1, 2 or 3 SfM points",
    "they start with finite scales (one alone: 0.01 units) and train; a single point has no bounding box, so "
    "no face points",
)
@pytest.mark.hard_case(
    "duplicate points, all or in pairs", "a scale of a millionth of the cloud's extent instead of log 0"
)
@pytest.mark.parametrize("name", CLOUDS)
def test_few_duplicate_and_collinear_points_start_and_train(name: str):
    points = torch.tensor(CLOUDS[name])
    config = SadgsModelConfig()
    colors = torch.full_like(points, 128)
    model: SadgsModel = config.setup(
        scene_box=SceneBox(torch.ones(2, 3)), num_train_data=1, seed_points=(points, colors)
    )
    model.plan = SimpleNamespace(near_plane=NEAR_PLANE, max_off_axis=config.max_off_axis)  # type: ignore[assignment]
    params = model.gauss_params
    assert len(params["means"]) >= len(points)
    for p in params.values():
        assert bool(p.isfinite().all())
    optimizers = {key: FusedAdam([p], lr=0.01) for key, p in params.items()}
    model.train()
    viewmats, Ks = camera(WIDTH, HEIGHT, focal=30.0)
    viewmats[:, 2, 3] = 4.0
    cameras = Cameras(viewmats, Ks, WIDTH, HEIGHT)
    noted = torch.zeros(1)
    data = [{"image": torch.full((HEIGHT, WIDTH, 3), 0.5)}]
    tensors = torch.ones(1, HEIGHT, WIDTH, 3)
    for _ in range(2):
        group = ViewGroup([0], cameras, model.step_options(cameras, [0]), data, structure_tensors=tensors)
        update = AdamUpdate(optimizers)
        result = train_step.training_step(model, [group], model.opacity_reg_now, update, update.factors(), noted)
        assert result.loss.isfinite(), "gradients are finite, too"
        assert noted == 0, "gradients are finite, too"
    assert is_finite(model)


@pytest.mark.hard_case("collinear and coplanar points", "a flat box gets each face point once")
def test_a_flat_box_has_each_face_point_once_and_a_point_has_no_box():
    for name, number in {"one": 0, "duplicates": 0, "collinear": 16 + 2, "coplanar": 256 + 4 * 16}.items():
        faces, spacing = bounding_box_points(torch.tensor(CLOUDS[name]))
        assert len(faces) == len(faces.unique(dim=0)) == number, name
        assert spacing > 0


@pytest.mark.hard_case("no point", "refused in one sentence")
def test_no_points_at_all_are_refused():
    with pytest.raises(ValueError, match=r"There are no points to start from: give SfM points"):
        neighbour_scales(torch.zeros(0, 3))


# --- numbers that are not finite ---

WRONG = [math.nan, math.inf, -math.inf, 1e30]


@pytest.mark.hard_case(
    "gradients of NaN, ±∞ or 10³⁰ in torch's Adam and in our kernel", "count as 0, to the bit as if they had been 0"
)
@pytest.mark.parametrize("triton", [False, True])
def test_adam_counts_gradients_it_could_not_recover_from_as_zero(triton: bool, monkeypatch: pytest.MonkeyPatch):
    if triton:
        pytest.importorskip("triton")
    monkeypatch.setattr(kernels, "available", lambda device: triton)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    results = []
    for wrong in (torch.zeros(4), torch.tensor(WRONG)):
        parameter = torch.nn.Parameter(torch.linspace(-1, 1, 1500, device=device))
        optimizer = FusedAdam([parameter], lr=0.01, eps=1e-15)
        noted = torch.zeros(1, device=device)
        for step in range(4):
            gradient = torch.linspace(-1, 2, 1500, device=device)
            if step == 1:
                gradient[[3, 40, 1030, 1499]] = wrong.to(device)
            update = AdamUpdate({"means": optimizer})
            update.launch({"means": gradient}, update.factors().to(device), noted)
            assert noted.isnan().item() == (step >= 1 and bool(wrong.any()))
        moments = [optimizer.state[parameter][name] for name in ("exp_avg", "exp_avg_sq")]
        results.append([parameter.detach(), *moments])
    for value, expected in zip(*results, strict=True):
        assert torch.equal(value, expected)
        assert value.isfinite().all()


@pytest.mark.hard_case("a gradient just under the bound of 10¹⁸", "Adam stays finite")
def test_a_gradient_just_under_the_bound_keeps_adam_finite():
    parameter = torch.nn.Parameter(torch.zeros(2))
    optimizer = FusedAdam([parameter], lr=0.01, eps=1e-15)
    parameter.grad = torch.tensor([0.99 * nonfinite.MAX_GRADIENT, -0.99 * nonfinite.MAX_GRADIENT])
    optimizer.step()
    for value in optimizer.state[parameter].values():
        assert value.isfinite().all()
    expected = torch.tensor([-0.01, 0.01])
    assert_close(parameter.detach(), expected)


@pytest.mark.hard_case(
    "NaN or ∞ in AbsGS's screen gradients",
    "NaN adds nothing; a Gaussian whose sum overflowed does not grow until the sums start anew",
)
def test_absgs_sums_skip_what_is_no_number_and_ignore_what_overflowed():
    means2d = torch.zeros(2, 4, 2)
    means2d.grad = torch.full((2, 4, 2), 1e-3)
    means2d.grad[0, 1] = math.nan
    means2d.grad[0, 2] = math.inf
    means2d.absgrad = means2d.grad.clone()  # type: ignore[attr-defined]
    gradients = empty_gradients(4, CPU)
    info = {"means2d": means2d, "radii": torch.ones(2, 4), "width": 64, "height": 64}
    accumulate_gradients(gradients, info, num_views=2)
    assert gradients["grad2d"].isfinite().tolist() == [True, True, False, True]
    actual = gradients["grad2d"][1]
    expected = gradients["grad2d"][0] / 2
    assert_close(actual, expected)
    params = random_params(4)
    state = {**gradients, "scene_scale": 1e4}  # all are small
    proposal = absgs(StructureAwareStrategy(clone_grad2d=1e-6, split_absgrad2d=1e-6), params, state)
    assert proposal.growth.tolist() == [1, 1, 0, 1]
    assert (proposal.children == 1).all()


class HostWaits(TorchDispatchMode):
    """Counts operations that would make the host wait for a device, and names all."""

    def __init__(self) -> None:
        super().__init__()
        self.number = 0
        self.names: set[str] = set()

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.names.add(func.__name__.split(".")[0])
        self.number += func.__name__.split(".")[0] in ("_local_scalar_dense", "nonzero", "is_nonzero", "equal")
        return func(*args, **(kwargs or {}))


@pytest.mark.hard_case(
    "the cost of the guard against NaN",
    "one copy of a number on the device each step, and a comparison inside Adam's kernel; the host reads the "
    "log every 100 steps and at the end",
)
def test_the_guard_never_waits_within_a_step():
    log = nonfinite.NonFiniteLog(CPU, capacity=10)
    gradient = torch.tensor(WRONG)
    loss = torch.tensor(math.nan)
    with HostWaits() as waits:
        for step in range(10):
            assert not log.full
            nonfinite.leave_out_nonfinite(gradient, log.nonfinite_flag)
            log.record(step, [step], loss)
    assert waits.number == 0
    assert log.full
    assert not gradient.any()
    with HostWaits() as waits:
        float(loss)
    assert waits.number == 1


def test_noting_a_loss_gives_the_device_no_work():
    log = nonfinite.NonFiniteLog(CPU, capacity=2)
    loss = torch.tensor(math.nan)
    with HostWaits() as operations:
        log.record(0, [0], loss)
    assert not operations.names
    assert log.read() == [(0, [0], "the loss was nan")]


@pytest.mark.hard_case("the log of bad steps", "names steps, and forgets them once they are read")
def test_the_log_names_steps_and_forgets_them_once_read():
    log = nonfinite.NonFiniteLog(CPU, capacity=4)
    log.record(7, [3], torch.tensor(0.5))
    log.record(8, [1, 2], torch.tensor(math.inf))
    log.nonfinite_flag.fill_(math.nan)
    log.record(9, [0], torch.tensor(0.5))
    expected = [(8, [1, 2], "the loss was inf"), (9, [0], "gradients were not finite")]
    assert log.read() == expected
    log.record(10, [0], torch.tensor(0.5))
    assert log.read() == []
    assert log.read() == []


ITERATIONS = 16


@pytest.mark.hard_case(
    "NaN in one image's pixels",
    "the model and Adam's moments stay finite, densification goes on, a line names iteration and image",
    "image-*",
)
@pytest.mark.hard_case(
    "NaN in one image's gradient while its loss is finite",
    "the model and Adam's moments stay finite, densification goes on, a line names iteration and image",
    "gradient-*",
)
@pytest.mark.parametrize("views", [1, 2])
@pytest.mark.parametrize("where", ["image", "gradient"])
def test_an_image_that_makes_nan_is_named_and_does_not_poison_the_model(
    where: str,
    views: int,
    colmap: ColmapDataParserConfig,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
):
    """In the image: everything it shows gets NaN. In the gradient: the loss is fine, but not what flows back."""
    config = configure(tmp_path, colmap, iterations=ITERATIONS)
    config.pipeline.views_per_iteration = views
    config.cuda_graphs = False  # A graph would not ask what is replaced below.
    trainer = set_up(config)
    pipeline = trainer.pipeline
    bad = 5
    pipeline.structure_cache.fill()  # before the image breaks
    name = pipeline.datamanager.train_dataset.image_filenames[bad].name
    next_views = pipeline.next_views
    before_background = pipeline.model.before_background
    hit = []
    drawn: list[int] = []

    def noted(step: int) -> list[ViewGroup]:
        groups = next_views(step)
        drawn[:] = groups[0].indices
        hit.extend([step + 1] * (bad in drawn))
        return groups

    def poisoned(*args: Any) -> torch.Tensor:
        rgb = before_background(*args)
        if where == "gradient" and bad in drawn:
            rows = torch.tensor(drawn, device=rgb.device) == bad
            rgb.register_hook(lambda g: torch.where(rows[:, None, None, None], torch.nan, g))
        return rgb

    pipeline.next_views = noted  # type: ignore[method-assign]
    pipeline.model.before_background = poisoned  # type: ignore[method-assign]
    if where == "image":
        _ = pipeline.views.cameras  # which looks for such images, once
        image = pipeline.datamanager.cached_train[bad]["image"]
        pipeline.datamanager.cached_train[bad]["image"] = torch.full(image.shape, math.nan)
    before = pipeline.model.num_points
    trainer.train()
    printed = " ".join(capsys.readouterr().out.split())
    assert len(hit) == 2 * views
    what = "the loss was nan" if where == "image" else "gradients were not finite"
    for iteration in hit:
        (line,) = [part for part in printed.split("Iteration ") if part.startswith(f"{iteration}, ")]
        assert name in line
        assert what in line
        assert line.count(".png") == views
    assert printed.count("training goes on") == len(hit)
    assert is_finite(pipeline.model)
    assert pipeline.model.num_points > before
    for optimizer in trainer.optimizers.optimizers.values():
        for slots in optimizer.state.values():
            for value in slots.values():
                assert value.isfinite().all()


@pytest.mark.hard_case("many iterations with NaN", "the first five of every hundred are named, the rest counted")
def test_many_bad_iterations_are_summed_up(
    colmap: ColmapDataParserConfig,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
):
    trainer = set_up(configure(tmp_path, colmap))
    for step in range(9):
        trainer.pipeline.log.record(step, [step % 8], torch.tensor(math.nan))
    trainer.pipeline._report_nonfinite()
    printed = " ".join(capsys.readouterr().out.split())
    assert printed.count("the loss was nan") == 5
    assert "The same in 4 more of the last iterations." in printed


@pytest.mark.hard_case("more iterations with NaN than the log holds", "the log is read before it overflows")
def test_the_log_is_read_before_it_overflows(
    colmap: ColmapDataParserConfig,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
):
    config = configure(tmp_path, colmap, iterations=5)
    config.pipeline.model.strategy.refine_stop_iter = 0
    trainer = set_up(config)
    trainer.pipeline.log.capacity = 2
    _ = trainer.pipeline.views.cameras  # which looks for such images, once
    image = trainer.pipeline.datamanager.cached_train[0]["image"]
    for data in trainer.pipeline.datamanager.cached_train:
        data["image"] = torch.full(image.shape, math.nan)
    with pytest.raises(RunError, match=r"^Nothing was learned in the last 5 iterations, .*: the loss was nan \(images"):
        trainer.train()
    printed = capsys.readouterr().out
    assert printed.count("the loss was nan") == 5
