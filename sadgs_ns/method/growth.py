"""Rules that propose splits and clones, and their application under one budget."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal, Protocol

import torch
import torch.nn.functional as F
from gsplat.strategy.ops import duplicate, split
from torch import Tensor

from sadgs_ns.method.ops import Optimizers, Params, State, opacities
from sadgs_ns.method.schedule import Windows, due
from sadgs_ns.method.split import MAX_CHILDREN_PER_AXIS, children_per_axis, grid_split, num_children
from sadgs_ns.method.statistics import consistent

SMALL_SCALE = 0.001
"""Largest scale, relative to the scene's extent, at which AbsGS counts a Gaussian as small (3DGS)."""
FAINT_NEED = 1e-6
"""Factor on η where what fills the cap is ranked: gradients decide, and η where there are none."""
_OTHER_AXES = 0.8
"""Factor on the other axes of a Gaussian whose longest axis is halved (docs/results.md)."""


class Options(Protocol):
    """The options that rules and the running strategy read; `StructureAwareStrategy` has and documents them."""

    max_gaussians: int
    tau_split: float
    min_observations: int
    split_min_opacity: float
    child_scale: float
    clone_grad2d: float
    split_absgrad2d: float
    absgs_long_axis: bool
    min_opacity: float

    def check(self) -> None:
        """Raise ValueError if an option is out of its range."""


@dataclass(frozen=True)
class Proposal:
    """How N Gaussians would grow, each as a whole or not at all."""

    children: Tensor
    """Into how many a Gaussian is split along each of its axes; 1, 1, 1 leaves it whole. int64 [N, 3]"""
    priority: Tensor
    """Those of the largest grow first, ≥ 0. [N]
    Rules that are ranked together measure by how many times their threshold is exceeded."""
    split: Callable[[Any, Any, Any, Tensor], None] = grid_split
    """Puts children in the place of parents, in place, given parameters, optimizers, state and `children`."""
    clone: Tensor | None = None
    """Gaussians that stay whole and get a copy in the same place. bool [N]"""

    @property
    def growth(self) -> Tensor:
        """Gaussians that each one would add. int64 [N]"""
        growth = num_children(self.children) - 1
        if self.clone is None:
            return growth
        return growth + self.clone


Propose = Callable[[Options, Params, Mapping[str, Any]], Proposal]
"""Takes the options, the parameters and the strategy's state."""


@dataclass(frozen=True)
class Rule:
    """A way to grow, and when it is asked."""

    every: Callable[[Windows], int]
    """Iterations between its steps inside the densification window; 0 turns it off."""
    propose: Propose
    reads: Literal["statistics", "gradients"] | None = None
    """The part of the state that its steps read, and that is emptied after each. A rule that reads η's statistics
    prunes by them before it grows, and empties the gradients, too; others prune the faint afterwards."""


def structure_aware(options: Options, params: Params, state: Mapping[str, Any]) -> Proposal:
    """Split the axes on which η violated consistently (paper, section 3.5).

    An axis needs about √η children. A Gaussian's priority is the sum of √η over the axes that are split, divided by the
    number of Gaussians that the split adds.
    """
    violates = consistent(state["n_high"], state["n_total"], options.tau_split, options.min_observations)  # [N, 3]
    is_opaque = opacities(params) >= options.split_min_opacity  # [N]
    violates &= is_opaque[:, None]
    eta_max = state["eta_max"]  # [N, 3]
    counts = children_per_axis(eta_max, violates)
    needed = torch.where(counts > 1, eta_max.sqrt(), 0.0).sum(dim=1)  # [N]
    added = num_children(counts) - 1  # [N]
    split_into_grid = partial(grid_split, child_scale=options.child_scale)
    priority = needed / added.clamp_min(1)
    return Proposal(counts, priority, split_into_grid)


def absgs(options: Options, params: Params, state: Mapping[str, Any]) -> Proposal:
    """Clone small Gaussians by their mean gradient, split large ones in two by their absolute gradient.

    Those with the largest gradients, relative to the thresholds, come first. A large one is halved along its longest
    axis. Without `absgs_long_axis` two Gaussians, 1.6 times as small on all axes, take its place; their centres are
    drawn at random, as in 3DGS.
    """
    is_small, steepness = _steepness(options, params, state)
    grows = (steepness >= 1) & steepness.isfinite()  # A sum that overflowed says nothing.
    is_split = grows & ~is_small
    longest = F.one_hot(params["scales"].detach().argmax(dim=-1), 3)  # [N, 3]
    halved = longest * is_split[:, None]
    split_in_two = _split_at_random
    if options.absgs_long_axis:
        split_in_two = _halve
    return Proposal(1 + halved, steepness, split_in_two, clone=grows & is_small)


def _steepness(options: Options, params: Params, state: Mapping[str, Any]) -> tuple[Tensor, Tensor]:
    """Return which Gaussians AbsGS counts as small, bool [N], and their gradients relative to its thresholds [N]."""
    scales = params["scales"].detach()
    count = state["grad_count"].clamp_min(1)
    is_small = scales.exp().amax(dim=-1) <= SMALL_SCALE * state["scene_scale"]
    mean_gradient = state["grad2d"] / count
    mean_absolute = state["absgrad2d"] / count
    clone_ratio = mean_gradient / options.clone_grad2d
    split_ratio = mean_absolute / options.split_absgrad2d
    return is_small, torch.where(is_small, clone_ratio, split_ratio)


def refill(options: Options, params: Params, state: Mapping[str, Any], share: float) -> Proposal:
    """Let all Gaussians grow as AbsGS does, so that their number can grow by a share of itself.

    Those with the largest gradients come first, and among those without gradients, those with the largest η. Up to a
    share of 1, small Gaussians are cloned and large ones are halved along their longest axis. Above it, all are cut
    into more than two parts along that axis.
    """
    is_small, steepness = _steepness(options, params, state)
    parts = min(1 + math.ceil(share), MAX_CHILDREN_PER_AXIS)
    is_cloned = is_small & (parts == 2)
    longest = F.one_hot(params["scales"].detach().argmax(dim=-1), 3)  # [N, 3]
    added = (parts - 1) * longest * ~is_cloned[:, None]
    by_gradient = torch.nan_to_num(steepness, nan=0.0, posinf=0.0)
    by_eta = FAINT_NEED * state["eta_max"].amax(dim=1)
    priority = torch.maximum(by_gradient, by_eta)
    return Proposal(1 + added, priority, _halve, clone=is_cloned)


RULES: dict[str, Rule] = {
    "structure": Rule(lambda windows: windows.structure_every, structure_aware, reads="statistics"),
    "absgs": Rule(lambda windows: windows.absgs_every, absgs, reads="gradients"),
}
"""The rules by their names. Those that are due together share the step's budget, in this order."""


def rivals(rule: Rule) -> list[Rule]:
    """Return the rules that are ranked together with a rule if not all of its proposal fits.

    Those are the rules that read the other part of the state, which is then kept, too.
    """
    if rule.reads is None:
        return []
    return [other for other in RULES.values() if other.reads not in (None, rule.reads)]


def due_rules(iteration: int, windows: Windows) -> list[Rule]:
    """Return the rules that are asked at the end of an iteration inside the densification window.

    A step reads one part of the state: the first due rule that reads a part takes the place of those of the other
    part. So a structure step takes the place of an AbsGS step.
    """
    rules = [rule for rule in RULES.values() if due(iteration, rule.every(windows))]
    parts = [rule.reads for rule in rules if rule.reads is not None]
    return [rule for rule in rules if rule.reads is None or rule.reads == parts[0]]


@torch.no_grad()
def apply(proposal: Proposal, allowed: Tensor, params: Params, optimizers: Optimizers, state: State) -> None:
    """Let the `allowed` Gaussians, bool [N], grow as proposed, in place; new ones have empty rows in `state`."""
    counts = torch.where(allowed[:, None], proposal.children, 1)
    if proposal.clone is not None:
        num_clones = _clone(allowed & proposal.clone, params, optimizers, state)
        counts = F.pad(counts, (0, 0, 0, num_clones), value=1)  # Clones are not split.
    if (counts > 1).any():
        proposal.split(params, optimizers, state, counts)


def best_of(proposals: Sequence[Proposal]) -> tuple[Tensor, Tensor, Tensor]:
    """Choose for each Gaussian the proposal by which it grows with the largest priority.

    Returns:
        The index of its proposal, int64 [N], its growth, int64 [N], and its priority [N].
    """
    growths = torch.stack([proposal.growth for proposal in proposals])  # [P, N]
    priorities = torch.stack([proposal.priority for proposal in proposals])  # [P, N]
    priorities = torch.where(growths > 0, priorities, -1.0)
    priority, chosen = priorities.max(dim=0)
    growth = growths.gather(0, chosen[None])[0]
    return chosen, growth, priority.clamp_min(0)


@torch.no_grad()
def apply_best(
    proposals: Sequence[Proposal],
    chosen: Tensor,  # int64 [N]
    allowed: Tensor,  # bool [N]
    params: Params,
    optimizers: Optimizers,
    state: State,
) -> None:
    """Let the `allowed` Gaussians grow, each as its `chosen` proposal says, in place."""
    # Each proposal that is applied moves Gaussians to other rows and adds new ones. The state's rows move with them, so
    # the later proposals wait in the state. New Gaussians get zeros there, which must mean that they do not grow.
    for index, proposal in enumerate(proposals):
        state[f"grows {index}"] = allowed & (chosen == index)
        state[f"children besides one {index}"] = proposal.children - 1
        if proposal.clone is not None:
            state[f"clone {index}"] = proposal.clone
    for index, proposal in enumerate(proposals):
        grows = state.pop(f"grows {index}")
        children = state.pop(f"children besides one {index}") + 1
        clone = state.pop(f"clone {index}", None)
        moved = replace(proposal, children=children, clone=clone)
        apply(moved, grows, params, optimizers, state)


def _clone(is_cloned: Tensor, params: Any, optimizers: Any, state: Any) -> int:
    """Append a copy of some Gaussians, bool [N], with empty rows in `state`; return how many."""
    num_clones = int(is_cloned.sum())
    if num_clones > 0:
        duplicate(params, optimizers, state, is_cloned)
        _forget_last(state, num_clones)
    return num_clones


def _halve(params: Any, optimizers: Any, state: Any, counts: Tensor) -> None:
    """Halve Gaussians along the axes of two children, int64 [N, 3], and shorten their other axes."""
    is_split = (counts > 1).any(dim=1, keepdim=True)
    is_other = is_split & (counts == 1)
    # The parents are shortened; then their children take their place.
    params["scales"].data += math.log(_OTHER_AXES) * is_other
    grid_split(params, optimizers, state, counts)


def _split_at_random(params: Any, optimizers: Any, state: Any, counts: Tensor) -> None:
    """Split Gaussians of more than one child, counted in int64 [N, 3], in two smaller ones at random places."""
    is_split = (counts > 1).any(dim=1)
    split(params, optimizers, state, is_split)
    _forget_last(state, 2 * int(is_split.sum()))


def _forget_last(state: State, num_children: int) -> None:
    """Empty the rows of the newest Gaussians, which gsplat's operations append as copies of their parents' rows."""
    for value in state.values():
        if isinstance(value, Tensor):
            value[-num_children:] = 0
