"""The processes of a run on several devices: how they start, and how they end together."""

from __future__ import annotations

import os
import random
import signal
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from typing import NoReturn

import numpy as np
import torch
import torch.distributed as dist
from nerfstudio.configs.base_config import MachineConfig
from nerfstudio.engine.trainer import TrainerConfig
from nerfstudio.utils.rich_utils import CONSOLE

from sadgs_ns.distributed.world import World
from sadgs_ns.errors import InputError
from sadgs_ns.training.options import check_ranges

_REAPED_SECONDS = 5.0  # Longest time from a message that fails, as its receiver has ended, until the system forgets it
_TIMEOUT = timedelta(minutes=30)  # Longest wait for another process: rank 0 may write a large checkpoint meanwhile


def number_of_processes() -> int:
    """Return how many processes train together; 1 if neither torchrun nor nerfstudio started several."""
    if dist.is_initialized():
        return dist.get_world_size()
    return int(os.environ.get("WORLD_SIZE", "1"))


def is_rank_zero() -> bool:
    """Tell whether this process is the one that prints and writes files."""
    if dist.is_initialized():
        return dist.get_rank() == 0
    return int(os.environ.get("RANK", "0")) == 0


def processes_on_this_machine() -> int:
    """Return how many of the processes share this machine's memory."""
    return int(os.environ.get("LOCAL_WORLD_SIZE", number_of_processes()))


def least(number: float, device: torch.device) -> float:
    """Return the smallest number, perhaps infinite, that any process of the run passes, so that all decide alike."""
    if not dist.is_initialized():
        return number
    return World(device).least(number)


def check_devices(machine: MachineConfig) -> bool:
    """Return whether a run takes several devices; raise InputError if they are missing or cannot be started."""
    torchrun = "1, since `torchrun --nnodes … -m nerfstudio.scripts.train sadgs …` on each of them starts such a run"
    ranges = [
        ("num_machines", machine.num_machines == 1, torchrun),
        ("num_devices", machine.num_devices >= 1, "at least 1"),
        ("seed", 0 <= machine.seed < 2**32, "in [0, 2³²)"),
    ]
    check_ranges("machine.", machine, ranges)
    if machine.num_devices > 1 and machine.device_type != "cuda":
        raise InputError(
            f"machine.num_devices is {machine.num_devices}, and nerfstudio starts several processes with CUDA only: "
            "set it to 1, or start the run with torchrun."
        )
    if machine.num_devices == 1 and number_of_processes() == 1:
        return False
    wanted = max(machine.num_devices, processes_on_this_machine())
    found = torch.cuda.device_count()
    if machine.device_type == "cuda" and wanted > found:
        problem = f"The run is to take {wanted} CUDA devices of this machine, and torch finds {found}"
        raise InputError(f"{problem}: lower machine.num_devices, or torchrun's --nproc-per-node.")
    return True


class Peers:
    """The processes of a run by their hosts and ids, to find out whether one of them ended."""

    def __init__(self, world: World) -> None:
        own = (socket.gethostname(), os.getpid())
        self._places = [own] * world.num_ranks
        dist.all_gather_object(self._places, own)

    def on_one_machine(self) -> bool:
        """Tell whether all processes run on the same host."""
        hosts = {host for host, _ in self._places}
        return len(hosts) == 1

    def exit_after_rank_zero(self) -> NoReturn:
        """Wait for the end of rank 0, because the end of one process would end all; then exit with code 0."""
        for number in (signal.SIGINT, signal.SIGHUP):
            signal.signal(number, signal.SIG_IGN)  # The first process saves, and ends.
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        while _exists(self._places[0][1]):
            time.sleep(0.2)
        raise SystemExit(0)

    def forget(self) -> None:
        """Look at no other process any more: they exit, and this one goes on without them."""
        self._places = []

    def ended(self) -> bool:
        """Tell whether a process of the run on this machine has ended; wait `_REAPED_SECONDS` at most for one."""
        deadline = time.monotonic() + _REAPED_SECONDS
        here = socket.gethostname()
        process_ids = [process_id for host, process_id in self._places if host == here]
        if not process_ids:
            return False
        while all(_exists(process_id) for process_id in process_ids):
            if time.monotonic() > deadline:
                return False
            time.sleep(0.1)
        return True


def _exists(process_id: int) -> bool:
    """Tell whether a process of this user exists, or has ended without being reaped by its parent yet."""
    try:
        os.kill(process_id, 0)
    except (ProcessLookupError, PermissionError):  # Another user's process may have the number by now.
        return False
    return True


def join(config: TrainerConfig, local_rank: int) -> tuple[World, int]:
    """Join the other processes, if there are any; return them and the local rank.

    All processes then have one seed and one time stamp, which is written into `config`, and only rank 0 prints.
    """
    if number_of_processes() == 1:
        return World(), local_rank
    started_by_torchrun = not dist.is_initialized()
    if started_by_torchrun:
        local_rank = int(os.environ["LOCAL_RANK"])
    device = torch.device("cpu")
    backend = "gloo"
    if config.machine.device_type == "cuda":
        torch.cuda.set_device(local_rank)  # NCCL, and Triton, take the current device.
        device = torch.device("cuda", local_rank)
        backend = "nccl"
    if started_by_torchrun:
        dist.init_process_group(backend, timeout=_TIMEOUT)
    random.seed(config.machine.seed)
    np.random.seed(config.machine.seed)
    torch.manual_seed(config.machine.seed)
    CONSOLE.quiet = not is_rank_zero()
    timestamp = [config.timestamp]
    dist.broadcast_object_list(timestamp, 0)
    config.timestamp = timestamp[0]
    return World(device), local_rank


@contextmanager
def local_rank_zero_first(world: World, local_rank: int) -> Iterator[None]:
    """Run the body, such as compiling, on the first process of each machine before the others; all call this.

    The others then find Triton's kernels on the disk. Of 24 processes that compiled at once, two ended by a TypeError.
    """
    if local_rank > 0:
        world.all(True)
    yield
    if local_rank == 0:
        world.all(True)


def continue_on_rank_zero(world: World, peers: Peers) -> None:
    """Continue in rank 0 without `world`; the other processes, of the same machine, exit with 0 after it."""
    world.all(True)
    dist.destroy_process_group()
    if world.rank > 0:
        peers.exit_after_rank_zero()
    peers.forget()
    os.environ.pop("LOCAL_WORLD_SIZE", None)  # torchrun set it; nobody shares the host's memory any more.
    # nerfstudio leaves a process group at the end, so there must be one.
    store = dist.HashStore()  # pyright: ignore[reportPrivateImportUsage]
    dist.init_process_group("gloo", store=store, rank=0, world_size=1)


def leave() -> None:
    """Leave the process group if torchrun started the processes; nerfstudio does so for those that it starts."""
    if "WORLD_SIZE" in os.environ and dist.is_initialized():
        dist.destroy_process_group()
