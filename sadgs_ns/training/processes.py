"""The processes of a run on several devices: how they find each other, and what a run on several devices cannot do."""

from __future__ import annotations

import os
import random
import signal
import socket
import tempfile
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

_REAPED_SECONDS = 5.0
"""Longest time from a message that fails because its process has ended to the operating system's forgetting that."""
_TIMEOUT = timedelta(minutes=30)
"""Longest time that one process waits for another, as in nerfstudio: rank 0 may write a large checkpoint meanwhile."""


def number_of_processes() -> int:
    """Return how many processes train together, as torchrun or nerfstudio started them; 1 outside of both."""
    return dist.get_world_size() if dist.is_initialized() else int(os.environ.get("WORLD_SIZE", "1"))


def is_rank_zero() -> bool:
    """Tell whether this process is the one that prints and writes files."""
    return (dist.get_rank() if dist.is_initialized() else int(os.environ.get("RANK", "0"))) == 0


def processes_on_this_machine() -> int:
    """Return how many of the processes share this machine's memory."""
    return int(os.environ.get("LOCAL_WORLD_SIZE", number_of_processes()))


def least(number: float, device: torch.device) -> float:
    """Return the least of the numbers, which may be infinite, that all processes of the run pass: they decide alike."""
    return World(device if dist.is_initialized() else None).least(number)


def check_devices(machine: MachineConfig) -> bool:
    """Return whether the devices that a run is to take are several.

    Raises:
        InputError: If one is not there, or the processes cannot be started in this way.
    """
    if machine.num_machines != 1:
        raise InputError(
            f"machine.num_machines is {machine.num_machines}, and sadgs trains on several machines with torchrun: "
            "start `torchrun --nnodes … --nproc-per-node … -m nerfstudio.scripts.train sadgs …` on each of them."
        )
    if machine.num_devices < 1:
        raise InputError(f"machine.num_devices must be at least 1, got {machine.num_devices}.")
    if machine.num_devices > 1 and machine.device_type != "cuda":
        raise InputError(
            f"machine.num_devices is {machine.num_devices}, and nerfstudio starts several processes with CUDA only: "
            "set it to 1, or start the run with torchrun."
        )
    if machine.num_devices == 1 and number_of_processes() == 1:
        return False
    here = torch.cuda.device_count()
    if machine.device_type == "cuda" and max(machine.num_devices, processes_on_this_machine()) > here:
        raise InputError(
            f"The run is to take {max(machine.num_devices, processes_on_this_machine())} CUDA devices of this machine, "
            f"and torch finds {here}: lower machine.num_devices, or torchrun's --nproc-per-node."
        )
    return True


class Peers:
    """The processes of a run, as the operating system of this machine knows them."""

    def __init__(self, world: World) -> None:
        self._rank, number = world.rank, world.num_ranks
        with tempfile.NamedTemporaryFile() as file:
            file.write(bytes(number))
            file.flush()
            mine = (socket.gethostname(), os.getpid(), file.name)
            self._places = [mine] * number
            dist.all_gather_object(self._places, mine)
            shared = next(path for host, _, path in self._places if host == mine[0])
            try:
                # The first process's file is memory that all processes of this machine share, with a byte for each.
                self._followed = torch.from_file(shared, shared=True, size=number, dtype=torch.uint8)
                """1 for each process that ends because another has ended. uint8 [number of processes]"""
            except RuntimeError:  # This process has another folder of temporary files.
                self._followed = torch.zeros(number, dtype=torch.uint8)
            world.all(True)  # The files go, and the memory stays as long as a process has it.

    def all_here(self) -> bool:
        """Tell whether all processes run on this machine."""
        return len({host for host, _, _ in self._places}) == 1

    def exit_after_rank_zero(self) -> NoReturn:
        """Wait until the first process, of this machine, has ended; then end this process with exit code 0.

        What starts the processes would take the end of one for the end of all.
        """
        for number in (signal.SIGINT, signal.SIGHUP):
            signal.signal(number, signal.SIG_IGN)  # The first process saves, and ends.
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        while _exists(self._places[0][1]):
            time.sleep(0.2)
        raise SystemExit(0)

    def ended(self) -> list[int]:
        """Return the ranks of this machine's processes that ended by themselves, after waiting some seconds for one.

        Those that end because this method named others to them are none of these.
        """
        end, here = time.monotonic() + _REAPED_SECONDS, socket.gethostname()
        while True:
            ranks = [
                rank
                for rank, (host, pid, _) in enumerate(self._places)
                if host == here and not _exists(pid) and not self._followed[rank]
            ]
            if ranks:
                self._followed[self._rank] = 1
            if ranks or time.monotonic() > end:
                return ranks
            time.sleep(0.1)


def _exists(pid: int) -> bool:
    """Tell whether there is a process of this user, or one that ended and of which its parent has not learned yet."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:  # The number is another user's process's by now.
        return False
    return True


def join(config: TrainerConfig, local_rank: int) -> tuple[World, int]:
    """Join the other processes of the run, where there are others.

    All processes draw the same random numbers, where nerfstudio seeds each in its own way. Those after the first print
    nothing.

    Args:
        config: Its time stamp becomes that of the first process.
        local_rank: Number of this process on its machine, as nerfstudio counts it.

    Returns:
        The processes of the run, and the number of this one on its machine.
    """
    if number_of_processes() == 1:
        return World(), local_rank
    cuda = config.machine.device_type == "cuda"
    if not dist.is_initialized():
        local_rank = int(os.environ["LOCAL_RANK"])
    if cuda:
        torch.cuda.set_device(local_rank)  # NCCL, and Triton, take the current device.
    if not dist.is_initialized():
        dist.init_process_group("nccl" if cuda else "gloo", timeout=_TIMEOUT)
    random.seed(config.machine.seed)
    np.random.seed(config.machine.seed)
    torch.manual_seed(config.machine.seed)
    CONSOLE.quiet = not is_rank_zero()
    shared = [config.timestamp]
    dist.broadcast_object_list(shared, 0)
    config.timestamp = shared[0]
    return World(torch.device("cuda", local_rank) if cuda else torch.device("cpu")), local_rank


@contextmanager
def local_rank_zero_first(world: World, local_rank: int) -> Iterator[None]:
    """Let the first process of each machine do something, such as compiling, before its others; all call this.

    Triton keeps what it compiles on the disk, where the others find it. Of 24 processes that compiled the same kernels
    at once two ended with a TypeError (docs/results.md#several-devices).
    """
    if local_rank > 0:
        world.all(True)
    yield
    if local_rank == 0:
        world.all(True)


def continue_on_rank_zero(world: World, peers: Peers) -> None:
    """Let the run go on in the first process, as if it were alone; the others wait for its end, and end with code 0.

    All processes run on this machine, and nobody may use their `World` any more.
    """
    world.all(True)
    dist.destroy_process_group()
    if world.rank > 0:
        peers.exit_after_rank_zero()
    os.environ.pop("LOCAL_WORLD_SIZE", None)  # torchrun's; nobody shares the host's memory any more.
    # nerfstudio takes leave of the others at the end, and a group of one process has none.
    store = dist.HashStore()  # pyright: ignore[reportPrivateImportUsage]
    dist.init_process_group("gloo", store=store, rank=0, world_size=1)


def leave() -> None:
    """End what `join` began, where torchrun started the processes; nerfstudio does so for those that it starts."""
    if "WORLD_SIZE" in os.environ and dist.is_initialized():
        dist.destroy_process_group()
