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
        self.rank = 0
        self.num_ranks = 1
        self.device = torch.device("cpu")
        if device is not None:
            self.rank = dist.get_rank()
            self.num_ranks = dist.get_world_size()
            self.device = device
        self.sizes: list[int] = [0] * self.num_ranks
        self.flags_out = 0
        self.flags_in = 0

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
        ends = [rank * total // self.num_ranks for rank in range(self.num_ranks + 1)]
        return [end - start for start, end in pairwise(ends)]

    def take_even_part(self, total: int) -> slice:
        """Share Gaussians out that all processes have, and return this one's; raise InputError if they are too few."""
        if total < self.num_ranks:
            raise InputError(f"{self.num_ranks} processes cannot share out {total} Gaussians: start fewer processes.")
        self.sizes = self.even_sizes(total)
        start = sum(self.sizes[: self.rank])
        return slice(start, start + self.sizes[self.rank])

    def count(self, number: int) -> None:
        """Update `sizes`, given the number of Gaussians of this process."""
        own = torch.tensor([number], device=self.device)
        self.sizes = self.gather(own)[:, 0].tolist()

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
        if self.is_single:
            return list(numbers)
        own = torch.tensor(numbers, device=self.device)
        return self.sum(own).tolist()

    def broadcast(self, values: Tensor, rank: int) -> None:
        """Overwrite a contiguous tensor, of one shape everywhere, with that of one process."""
        if not self.is_single:
            dist.broadcast(values, rank)

    def least(self, number: float) -> float:
        """Return the least of the numbers of all processes, which may be infinite."""
        if self.is_single:
            return number
        own = torch.tensor([number], dtype=torch.float64, device=self.device)
        return float(self.gather(own).min())

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
            for rank, size in enumerate(self.sizes):
                drawn = torch.rand((size, 2), device=like.device)
                if rank == self.rank:
                    kept.append(drawn)
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
        width = rows.shape[1:]
        is_empty = math.prod(width) == 0  # Then there is nothing to send.
        if self.rank > 0:
            if not is_empty:
                for start in range(0, self.sizes[self.rank], _ROWS_AT_ONCE):
                    dist.send(rows[start : start + _ROWS_AT_ONCE].contiguous(), 0)
            return rows
        gathered = torch.empty((self.total, *width), dtype=rows.dtype)
        if is_empty:
            return gathered
        gathered[: len(rows)] = rows.cpu()
        end = len(rows)
        for rank, size in enumerate(self.sizes[1:], start=1):
            for start in range(0, size, _ROWS_AT_ONCE):
                number = min(size - start, _ROWS_AT_ONCE)
                part = rows.new_empty((number, *width))
                dist.recv(part, rank)
                first = end + start
                gathered[first : first + number] = part.cpu()
            end += size
        return gathered


def _overlaps(ours: Sequence[int], theirs: Sequence[int], rank: int) -> list[int]:
    """Return how many of the rows that `rank` has by `ours` each rank has by `theirs`."""
    start = sum(ours[:rank])
    end = sum(ours[: rank + 1])
    overlaps = []
    for their_start, their_end in pairwise(accumulate(theirs, initial=0)):
        overlap = min(end, their_end) - max(start, their_start)
        overlaps.append(max(overlap, 0))
    return overlaps
