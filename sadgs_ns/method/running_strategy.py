"""Densification while a run trains: observe η, keep screen gradients, split, clone, prune and reset.

The paper's sections 3.4 to 3.6. Iterations are counted from 1: `step` s is iteration s + 1.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from gsplat.strategy.base import Strategy
from gsplat.strategy.ops import remove
from torch import Tensor

from sadgs_ns.distributed.ranking import limit_growth
from sadgs_ns.distributed.world import World
from sadgs_ns.method.budget import STATE_KEYS, Budget
from sadgs_ns.method.growth import (
    RULES,
    Options,
    Proposal,
    Propose,
    Rule,
    apply,
    apply_best,
    best_of,
    due_rules,
    refill,
    rivals,
    structure_aware,
)
from sadgs_ns.method.ops import Optimizers, Params, State, map_opacities, opacities, rebalance
from sadgs_ns.method.schedule import Windows, due, next_due
from sadgs_ns.method.screen_gradients import accumulate_gradients, empty_gradients, keep_gradient
from sadgs_ns.method.statistics import STATISTICS, consistent, empty_statistics, observe
from sadgs_ns.render.step_memory import StepSize, affordable_growth, free_bytes

Info = Mapping[str, Any]
"""gsplat's unpacked info of C views, with `structure_tensors` [C, H, W, 3], `viewmats` [C, 4, 4] and `Ks` [C, 3, 3]."""
Infos = Info | Sequence[Info]
"""The info of the views of a step, or a list with one for each image size."""

TAU_PRUNE = 0.8
"""τ_prune: share of observations that must be low on every axis to prune a faint Gaussian (paper, section 3.4)."""
PRUNE_OPACITY = 0.1
"""τ_α: opacity under which a Gaussian with consistently low η is pruned (paper, section 3.4)."""
CLAMP_OPACITY = 0.8
"""Structure steps lower opacities to this, so that Gaussians behind get gradients (released code)."""
RESET_FACTOR = 0.1
"""An opacity reset multiplies every opacity by this (released code)."""
FINAL_PRUNE_OPACITY = 0.1
"""Opacity under which Gaussians are pruned when densification ends (released code)."""


@dataclass
class RunningStrategy(Strategy):
    """The densification of one run, made by `StructureAwareStrategy.for_run`. It is a gsplat strategy.

    It is not changed by a run: all that steps leave behind is in the `state` that its methods take.
    """

    options: Options
    """Thresholds and caps."""
    windows: Windows
    """The times of densification."""
    world: World = field(default_factory=World, compare=False)
    """The processes among which the Gaussians are shared out.
    The cap and the ranking are those of all processes, and densification ends with equal shards."""

    # --- gsplat's interface of a strategy ---

    def initialize_state(self, scene_scale: float = 1.0) -> dict[str, Any]:
        """Return the state to pass to the other methods; its tensors are made at the first step.

        Structure steps append their numbers of Gaussians to the list `structure_steps`. Densification and `prune_haze`
        remove haze near a `CameraPaths`, if the state holds one as `camera_paths`.

        Args:
            scene_scale: The extent of the cameras in world units (`camera_extent`).

        Raises:
            ValueError: If an option is out of its range.
        """
        self.options.check()
        return {"scene_scale": scene_scale}

    def check_sanity(self, params: Params, optimizers: Optimizers) -> None:
        """Check as gsplat's strategies do, and raise ValueError if a parameter that the method needs is missing."""
        super().check_sanity(params, optimizers)  # type: ignore[arg-type]
        missing = {"means", "scales", "quats", "opacities"} - set(params)
        if missing:
            raise ValueError(f"params lack {sorted(missing)}: StructureAwareStrategy needs them by these names")

    def step_pre_backward(self, params: Params, optimizers: Optimizers, state: State, step: int, info: Infos) -> None:
        """Observe η, and ask for the screen gradients, before `loss.backward()`."""
        if step >= self.windows.refine_stop_iter:
            return
        if not state.keys() >= STATISTICS.keys():
            # A run begins, or goes on from a checkpoint of a version that had fewer statistics.
            _empty_state(params, state)
        for view in _views(info):
            if self.needs_absgrad(step):
                keep_gradient(view["means2d"])
            if self.observes(step):
                observe(state, params, view, self.world.rand(view["means2d"]))

    def step_post_backward(
        self, params: Params, optimizers: Optimizers, state: State, step: int, info: Infos, packed: bool = False
    ) -> None:
        """Add up the screen gradients and densify when the schedule says so, after `loss.backward()`.

        Raises:
            ValueError: If `packed`, because η and AbsGS read gsplat's unpacked info.
        """
        if packed:
            raise ValueError("StructureAwareStrategy reads gsplat's unpacked meta: call rasterization(packed=False)")
        self.accumulate(state, step, info)
        self.densify(params, optimizers, state, step, info)

    # --- what a step will do ---

    def observes(self, step: int) -> bool:
        """Tell whether `step_pre_backward` will measure η at this step, and so needs structure tensors."""
        windows = self.windows
        if step % windows.eta_every != 0:
            return False
        # After the last step that reads the statistics, nothing would read an observation.
        for rule in RULES.values():
            if rule.reads != "statistics":
                continue
            next_step = next_due(step + 1, rule.every(windows))
            if next_step <= windows.refine_stop_iter:
                return True
        return False

    def needs_absgrad(self, step: int) -> bool:
        """Tell whether an AbsGS step will read this step's absolute screen gradients; a structure step drops them."""
        windows = self.windows
        first = max(step + 1, windows.refine_start_iter)
        soonest = math.inf
        reads = None
        for rule in RULES.values():
            if rule.reads is None:
                continue
            iteration = next_due(first, rule.every(windows))
            # Of rules that are due at once, the first one says which part of the state the step reads.
            if iteration < soonest:
                soonest = iteration
                reads = rule.reads
        if soonest > windows.refine_stop_iter:
            return False
        return reads == "gradients"

    def densifies(self, step: int) -> bool:
        """Tell whether `densify` may replace tensors of parameters or statistics at this step."""
        iteration = step + 1
        windows = self.windows
        if not self._is_inside(iteration):
            return False
        if iteration == windows.refine_stop_iter:
            return True
        if due(iteration, windows.reset_every):
            return True
        return len(due_rules(iteration, windows)) > 0

    def _is_inside(self, iteration: int) -> bool:
        windows = self.windows
        return windows.refine_start_iter <= iteration <= windows.refine_stop_iter

    # --- what steps do ---

    def accumulate(self, state: State, step: int, info: Infos) -> None:
        """Add the screen gradients of a backward pass to the state, if an AbsGS step will read them."""
        if step >= self.windows.refine_stop_iter or not self.needs_absgrad(step):
            return
        views = _views(info)
        num_views = sum(view["n_cameras"] for view in views)
        for view in views:
            accumulate_gradients(state, view, num_views)

    def densify(self, params: Params, optimizers: Optimizers, state: State, step: int, info: Infos) -> None:
        """Split, clone, prune and reset Gaussians if that is due after this step."""
        iteration = step + 1
        if not self._is_inside(iteration):
            return
        views = _views(info)
        rules = due_rules(iteration, self.windows)
        by_eta = any(rule.reads == "statistics" for rule in rules)
        if by_eta:
            self._structure_step(rules, params, optimizers, state, iteration, views)
        elif rules:
            self._growth_step(rules, params, optimizers, state, iteration, views)
        if iteration == self.windows.refine_stop_iter:
            # A structure step has pruned, and its children are fainter than what it kept.
            if not by_eta:
                self._prune(params, optimizers, state, FINAL_PRUNE_OPACITY)
            self._refill(params, optimizers, state, iteration, views)
            _drop_state(state)
        elif self._resets(iteration):
            map_opacities(lambda alpha: alpha * RESET_FACTOR, params, optimizers)
        if self.densifies(step):
            rebalance(self.world, params, optimizers, state)

    def _resets(self, iteration: int) -> bool:
        """Tell whether an iteration resets opacities; none does so late that the final prune would take them."""
        every = self.windows.reset_every
        if not due(iteration, every):
            return False
        latest_reset = self.windows.refine_stop_iter - every // 4
        return iteration <= latest_reset

    def prune_haze(self, params: Params, optimizers: Optimizers, state: State) -> None:
        """Remove the haze near the state's `camera_paths`, which also arises after the last densification step."""
        self._prune(params, optimizers, state, 0.0)
        rebalance(self.world, params, optimizers, state)

    # --- decisions, without a change ---

    def consistently_low(self, statistics: Mapping[str, Tensor]) -> Tensor:
        """Tell which Gaussians had a low η on all three axes in more than τ_prune of their observations. bool [N]"""
        is_low = consistent(statistics["n_low"], statistics["n_total"], TAU_PRUNE, self.options.min_observations)
        return is_low.all(dim=1)

    def planned_children(self, params: Params, statistics: Mapping[str, Tensor]) -> Tensor:
        """Return n per axis of a structure step now; 1 where nothing is split or the cap forbids it. int64 [N, 3]"""
        proposal, fits = self.planned_growth(structure_aware, params, statistics)
        return torch.where(fits[:, None], proposal.children, 1)

    def planned_growth(self, propose: Propose, params: Params, state: Mapping[str, Any]) -> tuple[Proposal, Tensor]:
        """Return a rule's present proposal, and which Gaussians the cap lets grow, bool [N]."""
        proposal = propose(self.options, params, state)
        room = self.options.max_gaussians - len(params["means"])
        return proposal, limit_growth(self.world, proposal.growth, proposal.priority, room)

    # --- parts of a densification step ---

    def _structure_step(
        self, rules: Sequence[Rule], params: Any, optimizers: Any, state: Any, iteration: int, views: Sequence[Info]
    ) -> None:
        """Prune by η, let Gaussians grow by it, and empty the state."""
        num_before = len(params["means"])
        is_low = self.consistently_low(state)
        num_low = int(is_low.sum())
        faint = self.options.min_opacity
        if iteration == self.windows.refine_stop_iter:
            # The final prune comes before children are made: fainter than their parents, they would be pruned, too.
            faint = max(faint, FINAL_PRUNE_OPACITY)
        num_pruned = self._prune(params, optimizers, state, faint, is_low & (opacities(params) < PRUNE_OPACITY))
        map_opacities(lambda alpha: alpha.clamp_max(CLAMP_OPACITY), params, optimizers)
        num_violating, num_grown = self._grow(rules, params, optimizers, state, iteration, views)
        if iteration < self.windows.refine_stop_iter:
            _empty_state(params, state)  # Children have no observations yet.
        names = ("before", "violating", "low", "split", "pruned", "after")
        numbers = (num_before, num_violating, num_low, num_grown, num_pruned, len(params["means"]))
        of_all = dict(zip(names, self.world.sums(*numbers), strict=True))
        state.setdefault("structure_steps", []).append({"iteration": iteration, **of_all})

    def _growth_step(
        self, rules: Sequence[Rule], params: Any, optimizers: Any, state: Any, iteration: int, views: Sequence[Info]
    ) -> None:
        """Let Gaussians grow by rules that do not read η, prune the faint, and empty the gradients that were read."""
        self._grow(rules, params, optimizers, state, iteration, views)
        self._prune(params, optimizers, state, self.options.min_opacity)
        # The last step keeps them for `_refill`, which reads them, too.
        was_read = any(rule.reads == "gradients" for rule in rules)
        if was_read and iteration < self.windows.refine_stop_iter:
            state.update(empty_gradients(len(params["means"]), params["means"].device))

    def _grow(
        self, rules: Sequence[Rule], params: Any, optimizers: Any, state: Any, iteration: int, views: Sequence[Info]
    ) -> tuple[int, int]:
        """Let Gaussians grow as rules propose, one after the other; each gets an equal share of the room that is left.

        Returns:
            How many Gaussians of this process violate by η, and how many of these grew.
        """
        num_violating = 0
        num_grown = 0
        for position, rule in enumerate(rules):
            num_sharing = len(rules) - position
            proposal, allowed = self._grow_by(rule, num_sharing, params, optimizers, state, iteration, views)
            if rule.reads == "statistics":
                num_violating += int((proposal.growth > 0).sum())
                num_grown += int(allowed.sum())
        return num_violating, num_grown

    def _grow_by(
        self,
        rule: Rule,
        num_sharing: int,
        params: Any,
        optimizers: Any,
        state: Any,
        iteration: int,
        views: Sequence[Info],
    ) -> tuple[Proposal, Tensor]:
        """Let Gaussians grow as a rule proposes, within the cap and the memory that views like these leave.

        The room is shared with `num_sharing` - 1 rules that are asked afterwards.

        Returns:
            The proposal, and which Gaussians grew, bool [N]; N is their number before.
        """
        proposal = rule.propose(self.options, params, state)
        num_present = self.world.sums(len(params["means"]))[0]
        wanted = self.world.sums(int(proposal.growth.sum()))[0]
        room = self._budget(state).room(num_present, wanted, iteration / self.windows.refine_stop_iter)
        room = self._room_with_memory(wanted, room, params, state, iteration, views)
        room = room // num_sharing
        proposals = [proposal]
        if wanted > room:
            for rival in rivals(rule):
                proposals.append(rival.propose(self.options, params, state))
        chosen, growth, priority = best_of(proposals)
        allowed = limit_growth(self.world, growth, priority, room)
        apply_best(proposals, chosen, allowed, params, optimizers, state)
        return proposal, allowed

    def _refill(
        self, params: Params, optimizers: Optimizers, state: State, iteration: int, views: Sequence[Info]
    ) -> None:
        """Let those grow that need it most until the cap is reached, in a run that would have outgrown it."""
        num_present = self.world.sums(len(params["means"]))[0]
        room = self.options.max_gaussians - num_present
        if room <= 0 or not self._budget(state).outgrew_cap:
            return
        proposal = refill(self.options, params, state, room / num_present)
        wanted = self.world.sums(int(proposal.growth.sum()))[0]
        in_memory = self._room_with_memory(wanted, room, params, state, iteration, views)
        allowed = limit_growth(self.world, proposal.growth, proposal.priority, in_memory)
        apply(proposal, allowed, params, optimizers, state)

    def _budget(self, state: State) -> Budget:
        """Return the budget of the run, which its state keeps."""
        return Budget(self.options.max_gaussians, state)

    def _room_with_memory(
        self, wanted: int, room: int, params: Params, state: State, iteration: int, views: Sequence[Info]
    ) -> float:
        """Return the room for more Gaussians, or less if memory lacks that; warn if it cannot hold what is wanted."""
        in_memory = self._room_in_memory(params, state, views)
        if in_memory < min(wanted, room):
            warnings.warn(
                f"Iteration {iteration}: the device's memory holds {in_memory} more Gaussians, so at most these are "
                "added. Lower max_gaussians, use smaller images, or end other programs on the device.",
                stacklevel=4,
            )
        return min(room, in_memory)

    def _room_in_memory(self, params: Params, state: Mapping[str, Any], views: Sequence[Info]) -> float:
        """Return how many Gaussians can be added in all processes so that a step of such views fits; ≥ 0, or inf."""
        free = free_bytes(params["means"].device)
        here = affordable_growth(params, state, free, StepSize.of(views))
        # The fullest device bounds all, because shards are even.
        return self.world.num_ranks * self.world.least(here)

    def _prune(self, params: Any, optimizers: Any, state: Any, opacity: float, also: Tensor | None = None) -> int:
        """Remove haze, Gaussians less opaque than this, and others, bool [N]; return how many were removed.

        Nothing is removed if that would leave less than one Gaussian for each process.
        """
        gone = opacities(params) < opacity  # [N]
        if also is not None:
            gone |= also
        paths = state.get("camera_paths")
        if paths is not None:
            gone |= paths.haze(params["means"].detach(), params["scales"].detach().exp())
        num_gone = int(gone.sum())
        gone_of_all, num_of_all = self.world.sums(num_gone, len(gone))
        if num_of_all - gone_of_all < self.world.num_ranks:
            return 0
        if num_gone > 0:
            remove(params, optimizers, state, gone)
        return num_gone


def empty_state(num_gaussians: int, device: torch.device) -> dict[str, Tensor]:
    """Return the statistics of η and the screen gradients of Gaussians that no view has seen yet."""
    return empty_statistics(num_gaussians, device) | empty_gradients(num_gaussians, device)


def _empty_state(params: Params, state: State) -> None:
    """Start the statistics and the screen gradients anew for the present Gaussians."""
    state.update(empty_state(len(params["means"]), params["means"].device))


def _drop_state(state: State) -> None:
    """Take the statistics and the screen gradients out of the state, for memory and checkpoints."""
    for key in (*empty_state(0, torch.device("cpu")), *STATE_KEYS):
        state.pop(key, None)


def _views(info: Infos) -> Sequence[Info]:
    """Return the infos of a step as a list."""
    if isinstance(info, Mapping):
        return [info]
    return info
