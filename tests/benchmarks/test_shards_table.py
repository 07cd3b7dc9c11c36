"""`python -m benchmarks shards` as far as it runs without CUDA: its steps, alone and in two processes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from ranks import run_ranks

from benchmarks import shards as bench
from sadgs_ns.distributed.shards import Shards
from sadgs_ns.render.rasterization import visible

CPU = torch.device("cpu")


def train_together(shards: Shards) -> dict[str, Any]:
    step = bench.Step(300, 48, 32, 3, CPU, shards)
    before = step.params["means"].detach().clone()
    milliseconds, _ = bench.measure(step, CPU, 1)
    moved = not torch.equal(step.params["means"], before)
    sums = {name: float(step.state[name].sum()) for name in ("n_total", "absgrad2d", "grad_count")}
    return {"milliseconds": milliseconds, "moved": moved, **sums}


def test_processes_train_what_they_have(tmp_path: Path):
    results = run_ranks(train_together, 2, tmp_path)
    for result in results:
        assert result["moved"] and result["milliseconds"] > 0
        assert result["n_total"] > 0 and result["absgrad2d"] > 0 and result["grad_count"] > 0


def test_a_view_sees_one_block(monkeypatch: pytest.MonkeyPatch):
    seen = []
    monkeypatch.setattr(bench, "accumulate_gradients", lambda state, info, views: seen.append(visible(info)))
    bench.Step(300, 48, 32, 4, CPU, None, blocks=2)()
    for view, gaussians in enumerate(seen[0]):
        blocks = gaussians.nonzero()[:, 0] % 2
        assert len(blocks) > 50 and bool((blocks == view % 2).all())


@pytest.mark.skipif(torch.cuda.is_available(), reason="here it would measure")
def test_one_process_prints_a_row_for_each_size(capsys: pytest.CaptureFixture[str]):
    sizes = ["--gaussians", "200", "--megapixels", "0.001", "0.002", "--views", "1", "--repeats", "1"]
    assert bench.main(sizes) == 0
    rows = [line for line in capsys.readouterr().out.splitlines() if line.startswith("| 1 | 200 |")]
    assert [row.split(" | ")[2] for row in rows] == ["0.001", "0.002"]


def test_no_block_at_all_is_refused(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit):
        bench.main(["--blocks", "0"])
    assert "--blocks must be at least 1, got 0." in capsys.readouterr().err
