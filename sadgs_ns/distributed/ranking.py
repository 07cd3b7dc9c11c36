"""Choose which Gaussians may grow under one cap, in one process or several."""

from __future__ import annotations

import torch
from torch import Tensor

from sadgs_ns.distributed.world import World

_DIGITS = ((20, 11), (10, 10), (0, 10))  # Shifts and widths of the parts of a positive float's 31 bits, highest first


@torch.no_grad()
def limit_growth(world: World, growth: Tensor, priority: Tensor, budget: float) -> Tensor:
    """Choose which Gaussians may grow so that the hard cap holds, those of the largest priority first.

    Each one is taken if it fits into the budget that those before it left. Equal priorities are taken in the order of
    the ranks and their rows. A Gaussian that does not fit is passed over: otherwise a single parent of 512 children
    would block all others near the cap.

    Each round takes the Gaussians before the first that does not fit. The next round leaves out all that would add more
    than the budget that is left. Histograms of the priorities, summed over the processes, find the first that does not
    fit. They take less time than a sort, in one process, too.

    Args:
        world: The processes, which call this together.
        growth: The number of Gaussians that each one of this process would add, ≥ 0. int64 [N]
        priority: ≥ 0. [N]
        budget: The number that may be added in all, the same in all processes; ≤ 0 allows none.

    Returns:
        Whether each Gaussian may grow, False if it would add none. bool [N]
    """
    # The bits of floats that are not negative have the order of the floats.
    bits = priority.float().contiguous().view(torch.int32)
    allowed = torch.zeros_like(growth, dtype=torch.bool)
    while True:
        fits = (growth > 0) & (growth <= budget) & ~allowed
        wanted = torch.where(fits, growth, 0)
        total = world.sum(wanted.sum())
        if int(total) <= max(budget, 0):
            return allowed | fits
        taken = _up_to_first_that_does_not_fit(world, wanted, bits, budget)
        allowed |= taken
        spent = world.sum(growth[taken].sum())
        budget -= int(spent)


def _up_to_first_that_does_not_fit(world: World, growth: Tensor, bits: Tensor, budget: float) -> Tensor:
    """Choose by priority all Gaussians before the first that exceeds the budget, which must exist. bool [N]"""
    equal = growth > 0  # These agree in the digits so far with the first that does not fit.
    growth_before = 0  # By Gaussians whose priority is surely larger
    threshold = 0
    for shift, width in _DIGITS:
        largest = (1 << width) - 1
        digits = ((bits >> shift) & largest).long()
        growth_of_equal = torch.where(equal, growth, 0)
        histogram = growth.new_zeros(1 << width)
        histogram.scatter_add_(0, digits, growth_of_equal)
        from_top = world.sum(histogram).flip(0).cumsum(0)  # It grows as the digit falls.
        index = int((growth_before + from_top <= budget).sum())
        if index > 0:
            growth_before += int(from_top[index - 1])
        digit = largest - index
        equal &= digits == digit
        threshold |= digit << shift
    ties = torch.where(equal, growth, 0)
    totals = world.gather(ties.sum()[None])[:, 0]  # [R]
    growth_before += int(totals[: world.rank].sum())
    ties_that_fit = equal & (growth_before + ties.cumsum(0) <= budget)
    return (growth > 0) & ((bits > threshold) | ties_that_fit)
