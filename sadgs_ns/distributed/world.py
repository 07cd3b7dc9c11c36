"""What the processes of a run know of each other: how many Gaussians each holds, and what any of them asks of all."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import torch
import torch.distributed as dist
from torch import Tensor

from sadgs_ns.errors import InputError

REBALANCED_BEYOND = 1.1
"""Shards are made equal when the largest has more than this many times the Gaussians of the smallest."""
_ROWS_AT_ONCE = 1 << 20
"""Rows that are sent at once to where they are gathered, so that gathering takes little of the device's memory."""


class World:
    """The processes that train a splat together, each of which holds a shard of it.

    The Gaussians of all processes, in the order of their ranks, are those of one process. Every method must be called
    by all processes, in the same order. A world of one process asks nobody: its sums return their argument.

    Attributes:
        rank: Number of this process, from 0.
        num_ranks: Number R of processes.
        device: Where this process computes.
        sizes: Numbers of Gaussians of all processes, in the order of their ranks.
        request: What this process asks of all, a number of bits; `Exchange` sends it along.
        heard: What any process has asked for since it was last set to 0.

    Args:
        device: Where this process computes; for CUDA it must be torch's current device. None makes a world of this
            process alone.
    """

    def __init__(self, device: torch.device | None = None) -> None:
        self.rank, self.num_ranks = (0, 1) if device is None else (dist.get_rank(), dist.get_world_size())
        self.device = torch.device("cpu") if device is None else device
        self.sizes: list[int] = [0] * self.num_ranks
        self.request = self.heard = 0
        self._agreed: dict[str, bool] = {}

    def agree_once(self, question: str, answer: Callable[[], bool]) -> bool:
        """Return whether all processes answered yes when they were first asked a question.

        Args:
            question: Its name.
            answer: Called the first time.
        """
        if question not in self._agreed:
            self._agreed[question] = self.all(answer())
        return self._agreed[question]

    @property
    def alone(self) -> bool:
        """Whether this process holds all Gaussians."""
        return self.num_ranks == 1

    @property
    def total(self) -> int:
        """Number of Gaussians of all processes."""
        return sum(self.sizes)

    def even_sizes(self, total: int) -> list[int]:
        """Return the numbers of Gaussians that the processes have where none has two more than another."""
        return [(r + 1) * total // self.num_ranks - r * total // self.num_ranks for r in range(self.num_ranks)]

    def take_even_part(self, total: int) -> slice:
        """Let every process hold an equal part of Gaussians that all of them have, and return which is this one's.

        Args:
            total: Number of the Gaussians.

        Raises:
            InputError: If they are fewer than the processes.
        """
        if total < self.num_ranks:
            raise InputError(f"{self.num_ranks} processes cannot share out {total} Gaussians: start fewer processes.")
        self.sizes = self.even_sizes(total)
        start = sum(self.sizes[: self.rank])
        return slice(start, start + self.sizes[self.rank])

    def count(self, number: int) -> None:
        """Tell the others how many Gaussians this process holds now, and learn the same of them.

        Args:
            number: Gaussians of this process.
        """
        self.sizes = self.gather(torch.tensor([number], device=self.device))[:, 0].tolist()

    def gather(self, values: Tensor) -> Tensor:
        """Return what every process passes, in the order of their ranks.

        Args:
            values: Of the same length everywhere. [n]

        Returns:
            [R, n]
        """
        if self.alone:
            return values[None]
        gathered = values.new_empty(self.num_ranks * len(values))
        dist.all_gather_into_tensor(gathered, values)
        return gathered.view(self.num_ranks, -1)

    def sum(self, values: Tensor) -> Tensor:
        """Add up, in place, what every process passes, and return it.

        Args:
            values: Of one shape everywhere.
        """
        if not self.alone:
            dist.all_reduce(values)
        return values

    def sums(self, *numbers: int) -> list[int]:
        """Return the sums of whole numbers over the processes; one process needs no tensor for them."""
        return list(numbers) if self.alone else self.sum(torch.tensor(numbers, device=self.device)).tolist()

    def broadcast(self, values: Tensor, rank: int) -> None:
        """Overwrite a tensor, in place, with what one process passes.

        Args:
            values: Contiguous, and of one shape everywhere.
            rank: That process.
        """
        if not self.alone:
            dist.broadcast(values, rank)

    def least(self, number: float) -> float:
        """Return the least of the numbers that the processes pass, of which any may be infinite."""
        if self.alone:
            return number
        return float(self.gather(torch.tensor([number], dtype=torch.float64, device=self.device)).min())

    def all(self, condition: bool) -> bool:
        """Tell whether a condition holds in all processes."""
        return self.least(float(condition)) > 0

    def rand(self, like: Tensor) -> Tensor:
        """Draw the part of this process of what one process would draw for all Gaussians.

        All processes draw all numbers, so that random generators in the same state stay so. On the CPU the numbers are
        those that `torch.rand((V, total, 2))` draws.

        Args:
            like: A tensor of this process's Gaussians in V views, for its shape and device. [V, N, 2]

        Returns:
            In [0, 1). [V, N, 2]
        """
        if self.alone:
            return torch.rand(like.shape, device=like.device)
        kept = []
        for _ in range(len(like)):
            drawn = (torch.rand((n, 2), device=like.device) for n in self.sizes)
            kept += [numbers for rank, numbers in enumerate(drawn) if rank == self.rank]
        return torch.stack(kept)

    def is_uneven(self) -> bool:
        """Tell whether the largest shard has more than `REBALANCED_BEYOND` times the Gaussians of the smallest."""
        return max(self.sizes) > REBALANCED_BEYOND * min(self.sizes)

    def even_out(self, rows: Tensor) -> Tensor:
        """Return the part of this process of rows that are spread evenly, in the order that they have.

        `sizes` stays as it is, so that several tensors can be spread.

        Args:
            rows: What this process holds. [N, …]

        Returns:
            What it will hold. [N', …]
        """
        new = self.even_sizes(self.total)
        sent, received = _overlaps(self.sizes, new, self.rank), _overlaps(new, self.sizes, self.rank)
        result = rows.new_empty((new[self.rank], *rows.shape[1:]))
        if math.prod(rows.shape[1:]):
            dist.all_to_all_single(result, rows.contiguous(), received, sent)
        return result

    def gather_rows(self, rows: Tensor) -> Tensor:
        """Gather rows of all processes in the host's memory of rank 0.

        Args:
            rows: What this process holds, `sizes[rank]` rows. [N, …]

        Returns:
            At rank 0 the rows of all, in the order of the ranks [total, …]; elsewhere this process's own.
        """
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
    """Return how many of the rows of `rank` in one division of rows lie in each part of another division."""
    start = sum(ours[:rank])
    end = start + ours[rank]
    overlaps, first = [], 0
    for size in theirs:
        overlaps.append(max(min(end, first + size) - max(start, first), 0))
        first += size
    return overlaps
