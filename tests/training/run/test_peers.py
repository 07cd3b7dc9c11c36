"""What the processes of a run know of each other's ends."""

from __future__ import annotations

import subprocess
from types import SimpleNamespace
from typing import cast

import pytest

from sadgs_ns.distributed.world import World
from sadgs_ns.training.run import processes


def test_a_process_that_goes_on_alone_does_not_look_at_those_that_exit(monkeypatch: pytest.MonkeyPatch):
    gone = subprocess.Popen(["true"])
    gone.wait()

    def gather(places: list[tuple[str, int]], own: tuple[str, int]) -> None:
        places[:] = [own, (own[0], gone.pid)]

    monkeypatch.setattr(processes, "dist", SimpleNamespace(all_gather_object=gather))
    peers = processes.Peers(cast(World, SimpleNamespace(num_ranks=2)))
    assert peers.ended()
    peers.forget()
    assert not peers.ended()
