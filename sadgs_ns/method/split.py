"""Statistics → split plan → new parameters (paper, section 3.5, eq. 8 and 9)."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from gsplat.utils import normalized_quat_to_rotmat
from torch import Tensor

from sadgs_ns.method.ops import Optimizers, Params, State, update_param_with_optimizer

MAX_CHILDREN_PER_AXIS = 8
"""Bound on n_k, which η > 64 would exceed: no parent has more than 8³ = 512 children."""
VARIANCE_EXTENT = math.sqrt(3.0)
"""Half-width of the child grid in parent standard deviations that keeps the parent's covariance exactly: n cells over
[−√3, √3] have variance 1 − 1/n², and each child adds 1/n²."""


def children_per_axis(eta_max: Tensor, violates: Tensor) -> Tensor:
    """Split factor n_k = ⌈√η_k⌉ on the axes that violate consistently, 1 elsewhere (paper, eq. 8). int64 [N, 3]

    It is at most MAX_CHILDREN_PER_AXIS. `eta_max` is the largest η observed per axis [N, 3]; NaN splits nothing.
    """
    counts = eta_max.clamp_min(1.0).sqrt().ceil().clamp_max(MAX_CHILDREN_PER_AXIS)
    # NaN is no violation: as an integer it could be anything.
    return torch.where(violates & (counts >= 1), counts, 1.0).long()


def num_children(counts: Tensor) -> Tensor:
    """Children of each parent: the product n_x · n_y · n_z. int64 [N, 3] → [N]"""
    # For `prod` of integers on CUDA torch compiles a kernel at its first use, which takes half a second.
    n_x, n_y, n_z = counts.unbind(1)
    return n_x * n_y * n_z


def grid_offsets(
    counts: Tensor,  # int64 [P, 3]
    dtype: torch.dtype = torch.float32,
) -> tuple[Tensor, Tensor]:
    """Place the cell centres of regular grids of n_x × n_y × n_z cells, centred on their parents.

    Returns:
        Index of each child's parent, int64 [Q], and the grid coordinate g in parent standard deviations [Q, 3],
        children of one parent in a row, the first axis running fastest.
    """
    totals = num_children(counts)  # [P]
    parents = torch.repeat_interleave(torch.arange(len(counts), device=counts.device), totals)  # [Q]
    local = torch.arange(len(parents), device=counts.device) - (torch.cumsum(totals, 0) - totals)[parents]  # [Q]
    n_x, n_y, n_z = counts[parents].unbind(1)
    cells = torch.stack([local % n_x, local // n_x % n_y, local // (n_x * n_y)], dim=1)  # [Q, 3]
    n = torch.stack([n_x, n_y, n_z], dim=1)
    return parents, (2 * cells - n + 1).to(dtype) * (VARIANCE_EXTENT / n.to(dtype))


@torch.no_grad()
def grid_split(params: Params, optimizers: Optimizers, state: State, counts: Tensor, child_scale: float = 1.0) -> None:
    """Replace every Gaussian with more than one child by its grid of children, in place, as gsplat's `split` does.

    μ_child = μ + R (s ⊙ g) and s_child = s ⊘ n (paper, eq. 9); rotation, colour and opacity are copied. The order
    afterwards is [unsplit, children grouped by parent]. Children start with zero optimizer moments and empty rows of
    every tensor in `state`: the parent was longer, so its observations do not hold for them.

    Children k times as large (not in the paper) fill the gaps between them: their grid is narrower, so that the
    covariance stays, and their opacity 1/k for each axis that is split, so that the integral of opacity stays.

    Args:
        params: `means`, log `scales`, `quats` and any others with leading dimension N.
        state: The strategy's state; its tensors have leading dimension N.
        counts: n per axis. int64 [N, 3]
        child_scale: k in [1, 2).
    """
    is_split = (counts > 1).any(dim=1)
    rest = torch.where(~is_split)[0]
    selected = torch.where(is_split)[0]
    local_parents, grid = grid_offsets(counts[selected], params["scales"].dtype)
    parents = selected[local_parents]  # [Q]
    n = counts[parents].to(params["scales"].dtype)  # [Q, 3]
    is_axis_split = n > 1  # [Q, 3]
    # An axis that is not split has one cell in the middle, so the factor does not matter.
    grid = grid * ((1 - (child_scale / n) ** 2) / (1 - (1 / n) ** 2).clamp_min(0.75)).clamp_min(0).sqrt()
    rotmats = normalized_quat_to_rotmat(F.normalize(params["quats"][parents], dim=-1))  # [Q, 3, 3]
    # Not a batched matrix product: cuBLAS takes 3×3 matrices 65,535 at a time.
    offsets = (rotmats * (params["scales"][parents].exp() * grid)[:, None]).sum(dim=-1)  # [Q, 3]
    shrink = torch.where(is_axis_split, (n / child_scale).log(), 0.0)  # [Q, 3]
    log_share = -math.log(child_scale) * is_axis_split.sum(dim=1).to(n.dtype)  # [Q]

    def param_fn(name: str, p: Tensor) -> Tensor:
        children = p[parents]
        if name == "means":
            children = children + offsets
        elif name == "scales":
            children = children - shrink
        elif name == "opacities":
            log_q = log_share.view(-1, *[1] * (children.dim() - 1))
            # logit(q σ(x)) without overflow or cancellation; x itself where q is 1.
            children = log_q - torch.logaddexp(torch.log(-torch.expm1(log_q)), -children)
        return torch.cat([p[rest], children])

    def with_empty_children(key: str, v: Tensor) -> Tensor:
        return torch.cat([v[rest], v.new_zeros((len(parents), *v.shape[1:]))])

    update_param_with_optimizer(param_fn, with_empty_children, params, optimizers)  # type: ignore[arg-type]
    for key, value in state.items():
        if isinstance(value, Tensor):
            state[key] = with_empty_children(key, value)
