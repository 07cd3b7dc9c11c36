"""`python -m benchmarks formats`: each format's renderings are of what that file holds."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch
from kill_and_resume import configure, set_up

from benchmarks import __main__ as bench
from benchmarks import formats
from examples.drawn_scene.scene import write_scene
from sadgs_ns.formats import html


def test_the_table_has_every_format_with_its_size_and_loss(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    write_scene(tmp_path / "scene", 48, 36, 10, points=300)
    trainer = set_up(configure(tmp_path / "scene", tmp_path / "runs", 12, save_every=0))
    trainer.train()
    trainer.config.write()
    page = b'<script type="application/json" id="sse-bootstrap">{"settings": {}}</script>'
    monkeypatch.setattr(html, "_page", lambda: page)
    capsys.readouterr()
    assert bench.main(["formats", str(trainer.base_dir / "config.yml"), "--output", str(tmp_path / "out")]) == 0
    head, *lines = capsys.readouterr().out.splitlines()
    assert head.startswith(f"{trainer.pipeline.model.num_points:,} Gaussians, 2 held-out views, rendered on ")
    rows = {cells[0].strip("` "): cells[1:] for cells in (line.strip("|").split("|") for line in lines[3:])}
    assert list(rows) == [".ply", ".compressed.ply", ".spz", ".sog", ".glb", ".html"]
    for suffix, (size, *_) in rows.items():
        assert float(size) == pytest.approx((tmp_path / "out" / f"splat{suffix}").stat().st_size / 1e6, abs=0.005)
    lossless = float(rows[".ply"][2].split()[0])
    for suffix in (".compressed.ply", ".spz", ".sog"):
        after, difference = (float(re.findall(r"[\d.]+", cell)[0]) for cell in rows[suffix][2:])
        assert abs(after - lossless) < 1 and 30 < difference < 100, suffix


def test_psnr_is_the_mean_of_the_images():
    dark, light = torch.zeros(2, 2, 3), torch.full((2, 2, 3), 0.1)
    assert formats.psnr([dark, dark], [light, 10 * light]) == pytest.approx((20 + 0) / 2)
