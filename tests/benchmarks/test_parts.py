"""`python -m benchmarks parts`: every part of a step runs again and again, on the Gaussians and views of a run."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from interpreted import use_our_rasterizer
from kill_and_resume import configure, set_up

from benchmarks import parts, step
from examples.drawn_scene.scene import write_scene


@pytest.mark.skipif(torch.cuda.is_available(), reason="Triton's interpreter is for machines without CUDA")
def test_the_table_has_a_time_for_every_part(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    write_scene(tmp_path / "scene", 48, 36, 10, points=300)
    trainer = set_up(configure(tmp_path / "scene", tmp_path / "runs", 3, save_every=0))
    trainer.train()
    trainer.config.write()
    run = trainer.base_dir / "config.yml"
    capsys.readouterr()
    assert parts.main([str(run)]) == 1
    assert capsys.readouterr().err == "The parts are our Triton kernels, which need a CUDA device.\n"
    use_our_rasterizer(monkeypatch)
    monkeypatch.setattr(parts, "milliseconds", lambda function, rounds: 1.5 if function() is not None else 0.0)
    monkeypatch.setattr(parts.kernels, "available", lambda device: True)
    assert parts.main([str(run), "--views", "2"]) == 0
    head, _, _, _, *rows = capsys.readouterr().out.splitlines()
    assert head.startswith(f"{trainer.pipeline.model.num_points:,} Gaussians, 2 views of 48×36, 0.0")
    assert [line.split("|")[1].strip() for line in rows][-2:] == ["loss", "loss, with gradient"]
    assert len(rows) == 10 and all(float(line.split("|")[2]) == 1.5 for line in rows)
    assert parts.main([str(tmp_path)]) == 2
    assert "holds no checkpoint" in capsys.readouterr().err


def test_a_time_is_the_median_of_rounds_after_the_first(monkeypatch: pytest.MonkeyPatch):
    clock = iter([0.0, 9.0, 10.0, 10.2, 20.0, 20.4, 30.0, 30.6])
    monkeypatch.setattr("time.perf_counter", lambda: next(clock))
    calls: list[int] = []
    assert parts.milliseconds(lambda: calls.append(1), parts.ROUNDS) == pytest.approx(400 / step.REPEATS)
    assert len(calls) == 4 * step.REPEATS
