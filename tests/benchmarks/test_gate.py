"""A benchmark's gate: what it lets pass, what it says, and what it writes; nothing is trained."""

from __future__ import annotations

import importlib
import json
import re
import subprocess
import warnings
from pathlib import Path
from typing import Any

import pytest

from benchmarks import __main__ as bench
from benchmarks import gate, protocol, side_by_side
from benchmarks.gate import Metric
from benchmarks.protocol import Job, Row, Scene
from helpers.json_files import write_json

CONFIGS = Path(__file__).parents[2] / "configs/bench"
BASELINES = sorted(path.stem for path in CONFIGS.glob("baselines/*.json"))


def job(label: str = "ours", seed: int = 0) -> Job:
    return Job(Scene("fox", "fox", "colmap"), Row(label, "sadgs"), seed)


def result(job: Job, **measured: Any) -> dict[str, Any]:
    return {"key": job.key, "status": "ok", "error": None, "psnr": 30.0, "lpips": 0.1, "gaussians": 1000, **measured}


def entry(value: float, direction: str, tolerance: float) -> dict[str, Any]:
    return {"value": value, "direction": direction, "tolerance": tolerance}


@pytest.fixture
def baseline(tmp_path: Path) -> Path:
    path = tmp_path / "baseline.json"
    psnr = entry(30.0, "higher", 0.5)
    count = entry(1000, "near", 50)
    write_json(path, {"fox/ours": {"psnr": psnr, "lpips": entry(0.1, "lower", 0.01), "gaussians": count}})
    return path


@pytest.mark.parametrize(
    ("direction", "value", "fails"),
    [
        ("higher", 9.0, False), ("higher", 8.9, True), ("higher", 99.0, False),
        ("lower", 11.0, False), ("lower", 11.1, True), ("lower", -99.0, False),
        ("near", 11.0, False), ("near", 9.0, False), ("near", 11.1, True), ("near", 8.9, True),
        ("higher", float("nan"), True), ("lower", float("nan"), True), ("near", float("nan"), True),
    ],
)  # fmt: skip
def test_a_metric_fails_when_it_is_worse_by_more_than_the_tolerance(direction: str, value: float, fails: bool):
    assert Metric(10.0, direction, 1.0).fails(value) is fails


def test_means_over_seeds_are_compared(baseline: Path):
    jobs = [job(seed=0), job(seed=1)]
    assert not gate.regressions(gate.read(baseline), jobs, [result(jobs[0], psnr=29.0), result(jobs[1], psnr=30.2)])
    lines = gate.regressions(gate.read(baseline), jobs, [result(jobs[0], psnr=29.0), result(jobs[1], psnr=29.8)])
    assert lines == ["fox/ours: psnr moved by -0.6, from 30 to 29.4; tolerance 0.5 (higher is better)."]


def test_a_regression_names_row_metric_move_and_tolerance(baseline: Path):
    worse = result(job(), lpips=0.2, gaussians=900)
    actual = gate.regressions(gate.read(baseline), [job()], [worse])
    assert actual == [
        "fox/ours: lpips moved by +0.1, from 0.1 to 0.2; tolerance 0.01 (lower is better).",
        "fox/ours: gaussians moved by -100, from 1000 to 900; tolerance 50 (either way).",
    ]


def test_what_was_not_measured_fails(baseline: Path):
    jobs = [job(seed=0), job(seed=1)]
    content = gate.read(baseline)
    failed = {"key": jobs[1].key, "status": "failed", "error": "no memory."}
    for results in ([result(jobs[0])], [result(jobs[0]), failed]):
        (line,) = gate.regressions(content, jobs, results)
        assert line == "fox/ours is missing from the results: 1 of 2 runs ended well."
    lines = gate.regressions(content, [job("other")], [result(job("other"))])
    assert lines[1:] == ["fox/ours is missing from the results: no such run was asked for."]
    (line,) = gate.regressions(content, [job()], [result(job(), lpips=None)])
    assert line == "fox/ours: lpips was not measured; the baseline has 0.1."


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ("{", "b.json is no baseline (Expecting"),
        ("[]", "b.json is no baseline ('list' object"),
        ('{"a/b": 3}', "b.json is no baseline ('int' object"),
        ('{"a/b": {"psnr": {"value": 3}}}', "missing 2 required positional arguments"),
        (json.dumps({"a/b": {"psnr": entry(3, "up", 1)}}), "direction must be one of higher, lower, near"),
        (json.dumps({"a/b": {"psnr": entry(3, "near", -1)}}), "tolerance one from 0"),
        (
            '{"a/b": {"psnr": {"value": NaN, "direction": "near", "tolerance": 1}}}',
            "value must be a number",
        ),
        (
            '{"a/b": {"psnr": {"value": true, "direction": "near", "tolerance": 1}}}',
            "value must be a number",
        ),
    ],
)
def test_wrong_baselines_say_what_is_wrong(tmp_path: Path, content: str, sentence: str):
    path = tmp_path / "b.json"
    path.write_text(content)
    with pytest.raises(ValueError, match=re.escape(sentence)):
        gate.read(path)


# The command


@pytest.fixture
def command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """`python -m benchmarks` on a protocol of one row, whose run measures at once what it is told."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        importlib.import_module("nerfstudio.configs.method_configs")
    (tmp_path / "fox").mkdir()
    scene = {"data": "fox", "dataparser": "nerfstudio-data"}
    content = {"scenes": {"fox": scene}, "seeds": [0], "rows": [{"label": "ours", "method": "sadgs"}]}
    write_json(tmp_path / "p.yaml", content)
    monkeypatch.setattr(side_by_side, "POLL_SECONDS", 0.01)
    started: list[str] = []

    def run(*options: str, **measured: Any) -> int:
        times = {"loop_seconds": 1.0, "ssim": 0.9, "peak_gb": None}

        def launch(job: Job, gpu: str | None, folder: Path) -> subprocess.Popen[bytes]:
            started.append(job.key)
            write_json(folder / "result.json", result(job, **times, **measured))
            return subprocess.Popen(["true"], start_new_session=True)

        monkeypatch.setattr(bench, "launcher", lambda root: launch)
        output = tmp_path / f"{len(started)}.jsonl"
        return bench.main([str(tmp_path / "p.yaml"), "--scenes", str(tmp_path), "--output", str(output), *options])

    run.started = started  # type: ignore[attr-defined]
    return run


def test_the_command_exits_with_1_on_a_regression(command: Any, baseline: Path, capsys: pytest.CaptureFixture[str]):
    status = command("--gate", str(baseline), psnr=29.6)
    assert status == 0
    printed = capsys.readouterr().out
    assert f"Gate: passed, 3 metrics of 1 rows in {baseline}." in printed
    status = command("--gate", str(baseline), psnr=29.4)
    assert status == 1
    said = capsys.readouterr().out
    assert "Gate: fox/ours: psnr moved by -0.6, from 30 to 29.4; tolerance 0.5 (higher is better)." in said
    assert "Gate: FAILED" in said


def test_rows_that_nothing_judges_are_told(command: Any, baseline: Path, capsys: pytest.CaptureFixture[str]):
    baseline.write_text(baseline.read_text().replace("fox/ours", "fox/theirs"))
    status = command("--gate", str(baseline))
    assert status == 1
    said = capsys.readouterr().out
    assert "fox/theirs is missing from the results" in said
    assert "fox/ours is not in the baseline" in said


def test_a_wrong_baseline_is_told_before_anything_runs(
    command: Any, baseline: Path, capsys: pytest.CaptureFixture[str]
):
    status = command("--gate", str(baseline.with_name("no.json")))
    assert status == 2
    errors = capsys.readouterr().err
    assert "no.json is no baseline ([Errno 2] No such file" in errors
    assert not command.started


# The baselines in configs/bench


@pytest.mark.parametrize("name", BASELINES)
def test_every_baseline_has_the_rows_of_its_protocol(name: str):
    jobs = protocol.load(CONFIGS / f"{name}.yaml").jobs()
    baseline = gate.read(CONFIGS / "baselines" / f"{name}.json")
    assert set(baseline) == {f"{job.scene.name}/{job.row.label}" for job in jobs}


def test_the_demo_gate_judges_no_times():
    for metrics in gate.read(CONFIGS / "baselines/demo-gate.json").values():
        assert set(metrics) == {"psnr", "ssim", "gaussians"}
