"""`python -m benchmarks views`: spread and worst views, those far behind and collapsed ones, from made-up rows."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks import __main__ as bench

NAMED = {"view_names": ["a", "b"], "view_angles": [4.0, None]}


def row(label: str, seed: int, psnr: list[float] | None, scene: str = "fox", **changes: Any) -> dict[str, Any]:
    measured = {} if psnr is None else {"view_psnr": psnr}
    key = f"{scene}/{label}/{seed}/{psnr}"
    return {"key": key, "scene": scene, "label": label, "seed": seed, "status": "ok", **measured, **changes}


def write(path: Path, *rows: dict[str, Any]) -> str:
    path.write_text("".join(json.dumps(line) + "\n" for line in rows))
    return str(path)


BASE = [row("base", seed, [30.1, psnr], **NAMED) for seed, psnr in enumerate((20.0, 21.0, 28.0))]
OURS = [row("ours", 0, [27.1, 21.0], **NAMED), row("ours", 1, [27.11, 17.5], **NAMED)]


def test_spread_worst_view_and_losses_of_each_label(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    fold = [row("ours", 0, [25.0], "fox-2"), row("ours", 1, [21.0], "fox-2")]
    files = [write(tmp_path / "1.jsonl", *BASE), write(tmp_path / "2.jsonl", *OURS, *fold)]
    status = bench.main(["views", *files])
    assert status == 0
    printed = capsys.readouterr().out
    assert (
        printed
        == """## fox

| View | Angle ° | base | ours |
| --- | ---: | ---: | ---: |
| a | 4.0 | 30.10 ± 0.00 | 27.11 ± 0.01 |
| b | – | 23.00 ± 4.36 | 19.25 ± 2.47 |

- base: median 26.55 dB; worst view b, 20.00 dB; far behind: none; collapsed: b (seed 0), b (seed 1)
- ours: median 23.18 dB; worst view b, 17.50 dB; far behind: a (seed 0), b (seed 1); collapsed: b (seed 1)

## fox-2

| View | Angle ° | ours |
| --- | ---: | ---: |
| 0 | – | 23.00 ± 2.83 |

- ours: median 23.00 dB; worst view 0, 21.00 dB; far behind: none; collapsed: 0 (seed 1)

base: 0 of 6 (view, run) pairs are far behind; 2 of 6 whose label has other seeds collapsed
ours: 2 of 6 (view, run) pairs are far behind; 2 of 6 whose label has other seeds collapsed
"""
    )


def test_frozen_references_alone_count_and_may_be_older(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    results = write(tmp_path / "r.jsonl", *BASE, *OURS, row("ours", 0, [25.0], "tree"))
    old = [row("old", 0, [24.0, 23.5]), row("old", 1, [24.0, 24.5]), row("worse", 0, [9.0, 9.0])]
    status = bench.main(["views", results, "--references", write(tmp_path / "f.jsonl", *old)])
    assert status == 0
    told = capsys.readouterr().out
    assert "worst view b, 20.00 dB; far behind: b (seed 0), b (seed 1); " in told
    assert "25.00 dB; there is no reference\n" in told
    assert "base: 2 of 6 (view, run) pairs are far behind; " in told
    assert "ours: 2 of 4 (view, run) pairs are far behind; " in told
    assert "old" not in told


def test_runs_without_views_are_skipped_and_older_ones_number_them(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    rows = [row("ours", 0, [1.0, 1.0]), row("ours", 0, [26.0, 20.0]), row("ours", 1, None), row("base", 0, None)]
    status = bench.main(["views", write(tmp_path / "r.jsonl", *rows)])
    assert status == 0
    out, error = capsys.readouterr()
    assert "| 0 | – | 26.00 |\n| 1 | – | 20.00 |\n" in out
    assert "base" not in out
    assert "20.00 dB; far behind: none\n" in out  # A single seed cannot collapse.
    assert "0 of 0 whose label has other seeds collapsed\n" in out
    assert error == "Runs without view_psnr are skipped, 2 of them, such as fox/ours/1/None.\n"


def test_wrong_files_are_one_sentence(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    good = write(tmp_path / "r.jsonl", *OURS)
    missing = str(tmp_path / "no.jsonl")
    others = write(tmp_path / "o.jsonl", row("base", 0, [1.0, 2.0], view_names=["a", "c"]))
    fewer = write(tmp_path / "p.jsonl", row("base", 0, [1.0]))
    different = "the runs of fox hold out different views; give files of one split at a time."
    for arguments, sentence in (
        ([good, "--references", missing], "no.jsonl is not a file; give one that python -m benchmarks wrote."),
        ([good, others], different),
        ([good, "--references", fewer], different),
    ):
        status = bench.main(["views", *arguments])
        assert status == 2
        told = capsys.readouterr().err
        assert told.startswith("python -m benchmarks views: ")
        assert told.endswith(f"{sentence}\n")
        assert told.count("\n") == 1
