"""Processes that hold one splat together, for tests: each is forked, joins a gloo group and calls a function."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
import torch.distributed as dist

from helpers.forked_python import start
from sadgs_ns.distributed.world import World

TIMEOUT = 400.0
"""Seconds after which processes are killed, so that no test waits for ever for a message that does not come."""


def run_ranks(
    function: Callable[..., Any], number: int, folder: Path, *arguments: Any, doomed: tuple[int, ...] = ()
) -> list[Any]:
    """Call a function of a module in several processes.

    Args:
        function: It is called with the process's `World` and the arguments; what it returns is written by torch.save.
        number: Of processes.
        folder: For the files by which they meet and answer.
        arguments: What can be pickled.
        doomed: Ranks of processes that the function kills.

    Returns:
        What the function returned, in the order of the ranks; None of those that are doomed.
    """
    folder.mkdir(parents=True, exist_ok=True)
    processes = [start(_run, function, rank, number, str(folder), arguments) for rank in range(number)]
    end = time.monotonic() + TIMEOUT
    try:
        for process in processes:
            process.join(max(end - time.monotonic(), 0))
        expected = [-9 if r in doomed else 0 for r in range(number)]
        exitcodes = [process.exitcode for process in processes]
        assert exitcodes == expected
    finally:
        for process in processes:
            process.kill()
            process.join()
    return [None if rank in doomed else torch.load(folder / f"{rank}.pt", weights_only=False) for rank in range(number)]


def _run(function: Callable[..., Any], rank: int, number: int, folder: str, arguments: tuple[Any, ...]) -> None:
    torch.set_num_threads(1)
    dist.init_process_group("gloo", init_method=f"file://{folder}/meeting", rank=rank, world_size=number)
    result = function(World(torch.device("cpu")), *arguments)
    torch.save(result, Path(folder, f"{rank}.pt"))
    if not dist.is_initialized():  # The function has left the others.
        return
    with contextlib.suppress(RuntimeError):  # It waits for the others, unless one was killed.
        dist.barrier()
    dist.destroy_process_group()
