"""The densification schedule: a gsplat strategy that needs no nerfstudio (paper, sections 3.4–3.6)."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Any, cast

import torch
from gsplat.strategy.base import Strategy
from gsplat.strategy.ops import remove
from torch import Tensor

from sadgs_ns.distributed.ranking import limit_growth
from sadgs_ns.distributed.world import World
from sadgs_ns.method.growth import RULES, Proposal, Propose, Rule, apply, due_rule, structure_aware
from sadgs_ns.method.ops import Optimizers, Params, State, map_opacities, opacities, rebalance
from sadgs_ns.method.schedule import Windows, due, next_due, windows
from sadgs_ns.method.screen_gradients import accumulate_gradients, empty_gradients, keep_gradient
from sadgs_ns.method.statistics import consistent, empty_statistics, observe
from sadgs_ns.render.step_memory import StepSize, affordable_growth, free_bytes

Info = Mapping[str, Any]
Infos = Info | Sequence[Info]  # gsplat's info of the views of a step, or a list with one for each image size

TAU_PRUNE = 0.8  # τ_prune: share of observations that must be low on every axis to prune a faint Gaussian (section 3.4)
PRUNE_OPACITY = 0.1  # τ_α: opacity under which a Gaussian with consistently low η is pruned (paper, section 3.4)
CLAMP_OPACITY = 0.8  # Structure steps lower opacities to this, so that Gaussians behind get gradients (released code).
RESET_FACTOR = 0.1  # Factor of an opacity reset on every opacity (released code)
FINAL_PRUNE_OPACITY = 0.1  # Opacity under which Gaussians are pruned when densification ends (released code)


@dataclass
class StructureAwareStrategy(Strategy):
    """Structure-aware densification: split where η says so, in one step, into an anisotropic grid.

    A gsplat `Strategy`, whose training loop stands in docs/strategy.md. Iterations are counted from 1: `step` s is
    iteration s + 1. `info` is gsplat's of the C views of a step, unpacked, with `structure_tensors` [C, H, W, 3],
    `viewmats` [C, 4, 4] and `Ks` [C, 3, 3]. Where views of different sizes are rendered, it lists their infos.
    """

    max_gaussians: int = 4_000_000
    """Hard cap on the number of Gaussians, never exceeded; the largest violations are split first.
    On CUDA fewer are added, with a warning, if the device's memory cannot hold more."""
    structure_every: int | None = None
    """Iterations between structure-aware split and prune steps; None is a sixth of the run, 0 turns them off."""
    absgs_every: int | None = None
    """Iterations between AbsGS steps, skipped where a structure step falls.
    None is a thirtieth of the run, 0 turns them off."""
    refine_start_iter: int | None = None
    """First iteration at which densification may run; None is a thirtieth of the run."""
    refine_stop_iter: int | None = None
    """Last iteration at which densification may run; Gaussians less than 0.1 opaque are pruned there.
    None is 16/30 of the run, and 19/30 are the most; 0 adds and removes none at all."""
    eta_every: int | None = None
    """Iterations between η observations; None is a three-hundredth of the run.
    The paper observes at every iteration, which takes time and improves nothing."""
    tau_split: float = 0.8
    """Fraction of a Gaussian's observations that must violate (η > 1) before an axis is split."""
    min_observations: int = 3
    """Observations of η that a Gaussian needs before a structure step splits it, or prunes it for low η.
    With 1, as in the paper, one violation of one observation is enough."""
    split_min_opacity: float = 0.3
    """Opacity in [0, 1] that a Gaussian needs to be split by a structure step; 0, as in the paper, splits all."""
    child_scale: float = 1.5
    """k in [1, 2): children are k times the paper's s/n long on the axes that are split, which closes their gaps.
    They stand closer and are 1/k as opaque an axis, which keeps the covariance and the mass; 1 is the paper's."""
    clone_grad2d: float = 3.75e-4
    """AbsGS: normalised mean screen gradient at which a small Gaussian is cloned; AbsGS's own is 2e-4.
    `ns-train` lowers this and the next one by up to 20 % for an effort above 1, and adds 25 % after a stereo start."""
    split_absgrad2d: float = 7.5e-4
    """AbsGS: normalised mean absolute screen gradient at which a large Gaussian is split; AbsGS's own is 4e-4."""
    absgs_long_axis: bool = True
    """AbsGS halves a large Gaussian's longest axis in its place, instead of drawing the places of two at random."""
    min_opacity: float = 0.02
    """Opacity under which every densification step prunes; AbsGS's own is 0.005."""
    reset_every: int | None = None
    """Iterations between opacity resets inside the densification window; 0 turns them off.
    None is 12/30 of the run, and 0 in runs of fewer than 600 iterations, which would not recover."""
    # An annotation would make these options.
    _fitted = cast("Windows | None", None)
    world = World()
    """The processes among which the Gaussians are shared out.
    The cap and the ranking are those of all processes, and densification ends with equal shards."""

    def fitted(self, num_iterations: int) -> StructureAwareStrategy:
        """Return these options for a run of some length, from which the windows that are None are derived."""
        return replace(self, **asdict(windows(num_iterations, **self._given)))

    def for_run(self, num_iterations: int, world: World | None = None) -> StructureAwareStrategy:
        """Return this strategy fitted to a run: windows that are None are derived from the run's length.

        `world` are the processes among which the Gaussians are shared out; None keeps this strategy's.
        """
        fitted = self.fitted(num_iterations)
        fitted._fitted = fitted.windows
        fitted.world = self.world if world is None else world
        return fitted

    @property
    def windows(self) -> Windows:
        """The times of densification; a window that is None is as in a run of 3,000 iterations."""
        if self._fitted is not None:  # Steps ask for them often.
            return self._fitted
        given = self._given
        return windows(3000, **given) if None in given.values() else Windows(**given)

    @property
    def _given(self) -> dict[str, Any]:
        return {field.name: getattr(self, field.name) for field in fields(Windows)}

    def check(self) -> None:
        """Raise ValueError if an option is out of its range."""
        for name in ("max_gaussians", "eta_every", "min_observations"):
            if (value := getattr(self, name)) is not None and value < 1:
                raise ValueError(f"strategy.{name} must be at least 1, got {value}.")
        iterations = ("structure_every", "absgs_every", "refine_start_iter", "refine_stop_iter", "reset_every")
        for name in (*iterations, "clone_grad2d", "split_absgrad2d"):
            if (value := getattr(self, name)) is not None and not value >= 0:
                raise ValueError(f"strategy.{name} must not be negative, got {getattr(self, name):g}.")
        if not 1 <= self.child_scale < 2:
            raise ValueError(f"strategy.child_scale must be at least 1 and less than 2, got {self.child_scale:g}.")
        for name in ("tau_split", "split_min_opacity", "min_opacity"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"strategy.{name} must be in [0, 1], got {getattr(self, name):g}.")

    def initialize_state(self, scene_scale: float = 1.0) -> dict[str, Any]:
        """Return the state to pass to the other methods; its tensors are made at the first step.

        Structure steps append their numbers of Gaussians to the list `structure_steps`. Densification and `prune_haze`
        remove haze near a `CameraPaths`, `camera_paths`. `scene_scale`: `camera_extent`. Raises ValueError as `check`.
        """
        self.check()
        return {"scene_scale": scene_scale}

    def check_sanity(self, params: Params, optimizers: Optimizers) -> None:
        """Check as gsplat's strategies do, and raise ValueError if a parameter that the method needs is missing."""
        super().check_sanity(params, optimizers)  # type: ignore[arg-type]
        if missing := {"means", "scales", "quats", "opacities"} - set(params):
            raise ValueError(f"params lack {sorted(missing)}: StructureAwareStrategy needs them by these names")

    def observes(self, step: int) -> bool:
        """Tell whether `step_pre_backward` will measure η at this step, and so needs structure tensors."""
        windows = self.windows
        periods = [rule.every(windows) for rule in RULES.values() if rule.reads == "statistics"]
        # Nothing reads it after the last such step.
        return step % windows.eta_every == 0 and (
            min(next_due(step + 1, every) for every in periods) <= windows.refine_stop_iter
        )

    def densifies(self, step: int) -> bool:
        """Tell whether `step_post_backward` may replace tensors of parameters or statistics at this step."""
        iteration, windows = step + 1, self.windows
        if not windows.refine_start_iter <= iteration <= windows.refine_stop_iter:
            return False
        ends, resets = iteration == windows.refine_stop_iter, due(iteration, windows.reset_every)
        return ends or resets or due_rule(iteration, windows) is not None

    def needs_absgrad(self, step: int) -> bool:
        """Tell whether an AbsGS step will read this step's absolute screen gradients; a structure step drops them."""
        windows = self.windows
        first = max(step + 1, windows.refine_start_iter)
        readers = [rule for rule in RULES.values() if rule.reads is not None]
        # Of rules that are due at once, `min` takes the first, as a step does.
        read, reads = min(((next_due(first, r.every(windows)), r.reads) for r in readers), key=lambda reader: reader[0])
        return read <= windows.refine_stop_iter and reads == "gradients"

    def step_pre_backward(self, params: Params, optimizers: Optimizers, state: State, step: int, info: Infos) -> None:
        """Keep the screen gradients and observe η, before `loss.backward()`."""
        if step >= self.windows.refine_stop_iter:
            return
        if "n_total" not in state:
            state.update(empty_state(len(params["means"]), params["means"].device))
        for view in _views(info):
            if self.needs_absgrad(step):
                keep_gradient(view["means2d"])
            if self.observes(step):
                observe(state, params, view, self.world.rand(view["means2d"]))

    def step_post_backward(
        self, params: Params, optimizers: Optimizers, state: State, step: int, info: Infos, packed: bool = False
    ) -> None:
        """Accumulate the screen gradients and densify when the schedule says so, after `loss.backward()`.

        Raise ValueError if `packed`: η and AbsGS read the unpacked meta.
        """
        if packed:
            raise ValueError("StructureAwareStrategy reads gsplat's unpacked meta: call rasterization(packed=False)")
        self.accumulate(state, step, info)
        self.densify(params, optimizers, state, step, info)

    def accumulate(self, state: State, step: int, info: Infos) -> None:
        """Add the screen gradients of a backward pass if an AbsGS step will read them."""
        if step >= self.windows.refine_stop_iter or not self.needs_absgrad(step):
            return
        views = _views(info)
        num_views = sum(view["n_cameras"] for view in views)
        for view in views:
            accumulate_gradients(state, view, num_views)

    def densify(self, params: Params, optimizers: Optimizers, state: State, step: int, info: Infos) -> None:
        """Split, clone, prune and reset Gaussians if that is due after this step."""
        iteration, windows, views = step + 1, self.windows, _views(info)
        if not windows.refine_start_iter <= iteration <= windows.refine_stop_iter:
            return
        if (rule := due_rule(iteration, windows)) is not None:
            self._grow(rule, params, optimizers, state, iteration, views)
        if iteration == windows.refine_stop_iter:
            if rule is None or rule.reads != "statistics":  # whose step has pruned
                self._prune(params, optimizers, state, FINAL_PRUNE_OPACITY)
            for key in empty_state(0, torch.device("cpu")):
                state.pop(key, None)  # Neither memory nor checkpoints should hold them.
        # A reset just before the final prune would leave nothing that had time to recover.
        elif due(iteration, windows.reset_every) and iteration <= windows.refine_stop_iter - windows.reset_every // 4:
            map_opacities(lambda alpha: alpha * RESET_FACTOR, params, optimizers)
        if self.densifies(step):
            rebalance(self.world, params, optimizers, state)

    def prune_haze(self, params: Params, optimizers: Optimizers, state: State) -> None:
        """Remove the haze near `camera_paths`, which also arises after the last densification step."""
        self._prune(params, optimizers, state, 0.0)
        rebalance(self.world, params, optimizers, state)

    def consistently_low(self, statistics: Mapping[str, Tensor]) -> Tensor:
        """Tell which Gaussians had a low η on all three axes in more than τ_prune of their observations. bool [N]"""
        n_low, n_total = statistics["n_low"], statistics["n_total"]
        return consistent(n_low, n_total, TAU_PRUNE, self.min_observations).all(dim=1)

    def planned_children(self, params: Params, statistics: Mapping[str, Tensor]) -> Tensor:
        """Return n per axis of a structure step now; 1 where nothing is split or the cap forbids it. int64 [N, 3]"""
        proposal, fits = self.planned_growth(structure_aware, params, statistics)
        return torch.where(fits[:, None], proposal.children, 1)

    def planned_growth(self, propose: Propose, params: Params, state: Mapping[str, Any]) -> tuple[Proposal, Tensor]:
        """Return a rule's present proposal, and which Gaussians the cap lets grow, bool [N]."""
        proposal = propose(self, params, state)
        room = self.max_gaussians - len(params["means"])
        return proposal, limit_growth(self.world, proposal.growth, proposal.priority, room)

    def _grow(
        self, rule: Rule, params: Any, optimizers: Any, state: Any, iteration: int, views: Sequence[Info]
    ) -> None:
        """Prune, let Gaussians grow as a rule proposes and memory allows, and empty the state that it has read."""
        n_before, n_low, n_pruned, by_eta = len(params["means"]), 0, 0, rule.reads == "statistics"
        if by_eta:
            is_low = self.consistently_low(state)
            n_low = int(is_low.sum())
            # The final prune comes before children are made: fainter than their parents, they would be pruned, too.
            faint = max(self.min_opacity, FINAL_PRUNE_OPACITY if iteration == self.windows.refine_stop_iter else 0.0)
            n_pruned = self._prune(params, optimizers, state, faint, is_low & (opacities(params) < PRUNE_OPACITY))
            map_opacities(lambda alpha: alpha.clamp_max(CLAMP_OPACITY), params, optimizers)
        proposal = rule.propose(self, params, state)
        growth, (under_cap, in_memory) = proposal.growth, self._room(params, state, views)
        allowed = limit_growth(self.world, growth, proposal.priority, min(under_cap, in_memory))
        if in_memory < min(self.world.sums(int(growth.sum()))[0], under_cap):
            warnings.warn(
                f"Iteration {iteration}: the device's memory holds {in_memory} more Gaussians, so at most these are "
                "added. Lower max_gaussians, use smaller images, or end other programs on the device.",
                stacklevel=2,
            )
        apply(proposal, allowed, params, optimizers, state)
        if by_eta:
            state.update(empty_state(len(params["means"]), params["means"].device))  # Children have none yet.
            names = ("before", "violating", "low", "split", "pruned", "after")
            of_this = (n_before, int((growth > 0).sum()), n_low, int(allowed.sum()), n_pruned, len(params["means"]))
            numbers = dict(zip(names, self.world.sums(*of_this), strict=True))
            state.setdefault("structure_steps", []).append({"iteration": iteration, **numbers})
            return
        self._prune(params, optimizers, state, self.min_opacity)
        if rule.reads == "gradients":
            state.update(empty_gradients(len(params["means"]), params["means"].device))

    def _room(self, params: Params, state: Mapping[str, Any], views: Sequence[Info]) -> tuple[int, float]:
        """Return how many Gaussians the cap lets be added, and how many fit in the devices' memory with such views."""
        free = free_bytes(params["means"].device)
        in_memory = affordable_growth(params, state, free, StepSize.of(views))
        in_memory = self.world.num_ranks * self.world.least(in_memory)  # The fullest bounds all: shards are even.
        return self.max_gaussians - self.world.sums(len(params["means"]))[0], in_memory

    def _prune(self, params: Any, optimizers: Any, state: Any, opacity: float, also: Tensor | bool = False) -> int:
        """Remove haze, Gaussians less opaque than this, and others; return how many were removed."""
        gone = (opacities(params) < opacity) | also
        if (paths := state.get("camera_paths")) is not None:
            gone |= paths.haze(params["means"].detach(), params["scales"].detach().exp())
        n_prune = int(gone.sum())
        of_all, total = self.world.sums(n_prune, len(gone))
        if total - of_all < self.world.num_ranks:  # Each process needs one.
            return 0
        if n_prune > 0:
            remove(params, optimizers, state, gone)
        return n_prune


def empty_state(num_gaussians: int, device: torch.device) -> dict[str, Tensor]:
    """Return the statistics of η and the screen gradients of Gaussians that no view has seen yet."""
    return empty_statistics(num_gaussians, device) | empty_gradients(num_gaussians, device)


def _views(info: Infos) -> Sequence[Info]:
    return [info] if isinstance(info, Mapping) else info
