"""Within a training step on a GPU the host never waits for the device."""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import pytest
import torch
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig

from helpers.kill_and_resume import set_up
from helpers.short_runs import configure
from sadgs_ns.kernels import use_triton

SETTLED = 24
"""Step from which on every view was visited since the last densification, which is over at step 15."""


def set_sync_debug_mode(mode: str) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch says that the mode is a prototype.
        torch.cuda.set_sync_debug_mode(mode)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="only a GPU can be waited for")
@pytest.mark.parametrize("views", [1, 4])
def test_no_step_waits_once_every_view_was_visited(
    colmap: ColmapDataParserConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, views: int
):
    from sadgs_ns.kernels.tiles import PairCounts

    config = configure(tmp_path, colmap, iterations=SETTLED + 12)
    config.pipeline.views_per_iteration = views
    trainer = set_up(config)
    if not use_triton(trainer.pipeline.device):
        pytest.skip("Triton does not run here")
    stepping = False
    iterate = trainer.train_iteration
    wait = PairCounts.wait

    def arrived(counts: PairCounts) -> list[int]:
        assert not stepping or counts.ready()
        return wait(counts)

    def without_waiting(step: int) -> Any:
        nonlocal stepping
        stepping = step >= SETTLED
        set_sync_debug_mode("error" if stepping else "default")
        try:
            return iterate(step)
        finally:
            stepping = False
            set_sync_debug_mode("default")

    monkeypatch.setattr(PairCounts, "wait", arrived)
    trainer.train_iteration = without_waiting  # type: ignore[method-assign]
    trainer.train()
    assert trainer.step == SETTLED + 11
