"""The processes of a run, and their messages."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from itertools import accumulate, pairwise

import torch
import torch.distributed as dist
from torch import Tensor

from sadgs_ns.errors import InputError
from sadgs_ns.kernels import use_triton

REBALANCED_BEYOND = 1.1  # Shards are made equal if the largest has more than this many times the smallest's Gaussians
_ROWS_AT_ONCE = 1 << 20  # Rows that are gathered at once, so that it takes little of the device's memory


class World:
    """The R processes that train a splat together, each of which holds a shard of it.

    The Gaussians of all processes, in the order of their ranks, are those of one process. All processes must call every
    method in the same order. A world of one process sends nothing: its sums return their argument.

    `device` must be torch's current one if it is CUDA; None makes a world of this process alone.

    Attributes:
        rank, num_ranks: The number of this process, from 0, and R.
        sizes: Numbers of Gaussians of all processes, in the order of their ranks.
        flags_out: Bits by which this process asks something of all; `Exchange` sends them along.
        flags_in: All bits that any process has sent since this was last set to 0.
    """

    def __init__(self, device: torch.device | None = None) -> None:
        self.rank, self.num_ranks = (0, 1) if device is None else (dist.get_rank(), dist.get_world_size())
        self.device = torch.device("cpu") if device is None else device
        self.sizes: list[int] = [0] * self.num_ranks
        self.flags_out = self.flags_in = 0

    @cached_property
    def uses_kernels(self) -> bool:
        """Whether Triton's kernels work in all processes, which ask each other the first time."""
        return self.all(use_triton(self.device))

    @property
    def is_single(self) -> bool:
        """Whether this is the only process, which holds all Gaussians."""
        return self.num_ranks == 1

    @property
    def total(self) -> int:
        """Number of Gaussians of all processes."""
        return sum(self.sizes)

    def even_sizes(self, total: int) -> list[int]:
        """Return the sizes of equal shards, which differ by one at most."""
        return [(r + 1) * total // self.num_ranks - r * total // self.num_ranks for r in range(self.num_ranks)]

    def take_even_part(self, total: int) -> slice:
        """Share Gaussians out that all processes have, and return this one's; raise InputError if they are too few."""
        if total < self.num_ranks:
            raise InputError(f"{self.num_ranks} processes cannot share out {total} Gaussians: start fewer processes.")
        self.sizes = self.even_sizes(total)
        start = sum(self.sizes[: self.rank])
        return slice(start, start + self.sizes[self.rank])

    def count(self, number: int) -> None:
        """Update `sizes`, given the number of Gaussians of this process."""
        self.sizes = self.gather(torch.tensor([number], device=self.device))[:, 0].tolist()

    def gather(self, values: Tensor) -> Tensor:
        """Return the values of all processes, of one length, in the order of their ranks. [n] → [R, n]"""
        if self.is_single:
            return values[None]
        gathered = values.new_empty(self.num_ranks * len(values))
        dist.all_gather_into_tensor(gathered, values)
        return gathered.view(self.num_ranks, -1)

    def sum(self, values: Tensor) -> Tensor:
        """Add up the values of all processes, of one shape, in place, and return them."""
        if not self.is_single:
            dist.all_reduce(values)
        return values

    def sums(self, *numbers: int) -> list[int]:
        """Return the sums of whole numbers over the processes; one process needs no tensor for them."""
        return list(numbers) if self.is_single else self.sum(torch.tensor(numbers, device=self.device)).tolist()

    def broadcast(self, values: Tensor, rank: int) -> None:
        """Overwrite a contiguous tensor, of one shape everywhere, with that of one process."""
        if not self.is_single:
            dist.broadcast(values, rank)

    def least(self, number: float) -> float:
        """Return the least of the numbers of all processes, which may be infinite."""
        if self.is_single:
            return number
        return float(self.gather(torch.tensor([number], dtype=torch.float64, device=self.device)).min())

    def all(self, condition: bool) -> bool:
        """Return whether a condition holds in all processes."""
        return self.least(float(condition)) > 0

    def rand(self, like: Tensor) -> Tensor:
        """Draw this process's part of random numbers in [0, 1) for all Gaussians, of the tensor's shape. [V, N, 2]

        All processes draw all numbers, so that their generators stay alike; on the CPU as `torch.rand((V, total, 2))`.
        """
        if self.is_single:
            return torch.rand(like.shape, device=like.device)
        kept = []
        for _ in range(len(like)):
            drawn = (torch.rand((n, 2), device=like.device) for n in self.sizes)
            kept += [numbers for rank, numbers in enumerate(drawn) if rank == self.rank]
        return torch.stack(kept)

    def is_uneven(self) -> bool:
        """Return whether the shards should be made equal."""
        return max(self.sizes) > REBALANCED_BEYOND * min(self.sizes)

    def rebalance(self, rows: Tensor) -> Tensor:
        """Return this process's rows after all are spread evenly; `sizes` stays, for other tensors. [N, …] → [N', …]"""
        new = self.even_sizes(self.total)
        sent = _overlaps(self.sizes, new, self.rank)
        received = _overlaps(new, self.sizes, self.rank)
        result = rows.new_empty((new[self.rank], *rows.shape[1:]))
        if math.prod(rows.shape[1:]):
            dist.all_to_all_single(result, rows.contiguous(), received, sent)
        return result

    def gather_rows(self, rows: Tensor) -> Tensor:
        """Gather the rows of all Gaussians on the host of rank 0 [N, …] → [total, …]; others get their own back."""
        rows = rows.detach()
        starts = [range(0, size if math.prod(rows.shape[1:]) else 0, _ROWS_AT_ONCE) for size in self.sizes]
        if self.rank > 0:
            for start in starts[self.rank]:
                dist.send(rows[start : start + _ROWS_AT_ONCE].contiguous(), 0)
            return rows
        gathered = torch.empty((self.total, *rows.shape[1:]), dtype=rows.dtype)
        gathered[: len(rows)] = rows.cpu()
        end = len(rows)
        for rank, size in enumerate(self.sizes[1:], start=1):
            for start in starts[rank]:
                part = rows.new_empty((min(size - start, _ROWS_AT_ONCE), *rows.shape[1:]))
                dist.recv(part, rank)
                gathered[end + start : end + start + len(part)] = part.cpu()
            end += size
        return gathered


def _overlaps(ours: Sequence[int], theirs: Sequence[int], rank: int) -> list[int]:
    """Return how many of the rows that `rank` has by `ours` each rank has by `theirs`."""
    start = sum(ours[:rank])
    end = sum(ours[: rank + 1])
    ranges = pairwise(accumulate(theirs, initial=0))
    return [max(min(end, last) - max(start, first), 0) for first, last in ranges]
