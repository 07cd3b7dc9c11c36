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


def children_per_axis(
    eta_max: Tensor,  # [N, 3] largest η observed on each axis; NaN splits nothing
    violates: Tensor,  # bool [N, 3]
) -> Tensor:
    """Split factor n_k = ⌈√η_k⌉ on the axes that violate consistently, 1 elsewhere (paper, eq. 8). int64 [N, 3]

    It is at most MAX_CHILDREN_PER_AXIS.
    """
    counts = eta_max.clamp_min(1.0).sqrt().ceil().clamp_max(MAX_CHILDREN_PER_AXIS)
    # NaN is no violation: as an integer it could be anything.
    return torch.where(violates & (counts >= 1), counts, 1.0).long()


def num_children(
    counts: Tensor,  # int64 [N, 3]
) -> Tensor:
    """Children of each parent: the product n_x · n_y · n_z. int64 [N]"""
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
    indices = torch.arange(len(counts), device=counts.device)  # [P]
    parents = torch.repeat_interleave(indices, totals)  # [Q]
    firsts = torch.cumsum(totals, 0) - totals  # Place of each parent's first child. [P]
    places = torch.arange(len(parents), device=counts.device)  # [Q]
    local = places - firsts[parents]  # Number of a child among its siblings. [Q]
    n = counts[parents]  # [Q, 3]
    n_x, n_y, _ = n.unbind(1)
    cell_x = local % n_x
    cell_y = local // n_x % n_y
    cell_z = local // (n_x * n_y)
    cells = torch.stack([cell_x, cell_y, cell_z], dim=1)  # [Q, 3]
    from_middle = (2 * cells - n + 1).to(dtype)  # In half cells
    half_cell = VARIANCE_EXTENT / n.to(dtype)
    return parents, from_middle * half_cell


def _narrowing(n: Tensor, child_scale: float) -> Tensor:
    """Factor on the grid of n [Q, 3] children that are `child_scale` times as large, so that the covariance stays.

    The grid's variance is 1 − 1/n² of the parent's, and the children's (k/n)². An axis that is not split has one cell
    in the middle, so its factor does not matter. [Q, 3]
    """
    wanted = 1 - (child_scale / n) ** 2
    present = 1 - (1 / n) ** 2
    return (wanted / present.clamp_min(0.75)).clamp_min(0).sqrt()


def _share_opacity(
    logits: Tensor,  # [Q, ...]
    log_share: Tensor,  # log q, ≤ 0 [Q]
) -> Tensor:
    """Return logit(q σ(x)) of logits x without overflow or cancellation; x itself where q is 1. [Q, ...]"""
    log_q = log_share.view(-1, *[1] * (logits.dim() - 1))
    log_rest = torch.log(-torch.expm1(log_q))  # log(1 − q)
    return log_q - torch.logaddexp(log_rest, -logits)


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
    grid = grid * _narrowing(n, child_scale)  # g [Q, 3]
    quats = F.normalize(params["quats"][parents], dim=-1)
    rotmats = normalized_quat_to_rotmat(quats)  # R [Q, 3, 3]
    along_axes = params["scales"][parents].exp() * grid  # s ⊙ g [Q, 3]
    # R (s ⊙ g) of eq. 9. It is no batched matrix product, because cuBLAS takes 3×3 matrices 65,535 at a time.
    offsets = (rotmats * along_axes[:, None]).sum(dim=-1)  # [Q, 3]
    shrink = torch.where(is_axis_split, (n / child_scale).log(), 0.0)  # log(n / k) [Q, 3]
    num_split_axes = is_axis_split.sum(dim=1).to(n.dtype)  # [Q]
    log_share = -math.log(child_scale) * num_split_axes  # log of the children's share of the opacity [Q]

    def param_fn(name: str, p: Tensor) -> Tensor:
        children = p[parents]
        if name == "means":
            children = children + offsets
        elif name == "scales":
            children = children - shrink
        elif name == "opacities":
            children = _share_opacity(children, log_share)
        return torch.cat([p[rest], children])

    def with_empty_children(key: str, v: Tensor) -> Tensor:
        empty = v.new_zeros((len(parents), *v.shape[1:]))
        return torch.cat([v[rest], empty])

    update_param_with_optimizer(param_fn, with_empty_children, params, optimizers)  # type: ignore[arg-type]
    for key, value in state.items():
        if isinstance(value, Tensor):
            state[key] = with_empty_children(key, value)
